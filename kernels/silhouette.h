// The soft silhouette of a triangle mesh, its losses against a mask and their gradients, for one image.
#pragma once

#include <cstddef>
#include <cstdint>

#include "mesh.h"

namespace jaxfit {

struct Blur {
  float sigma;   // softness s in px²: p = sigmoid(-d / s)
  float radius;  // px; a face further from a pixel than this leaves it alone
};

enum class LossKind : int32_t { kL1 = 0, kSmoothL1 = 1 };

// A mask with one byte (zero or not) or one float (in [0, 1]) a pixel; exactly one pointer is set.
struct Target {
  const uint8_t* bytes;
  const float* floats;
};

// The entry points of one instruction set. `gradient` is (V, 3) and is overwritten; the depths' part is zero.
struct Kernels {
  // Bytes of 64-byte aligned `memory` that one image at a time needs.
  size_t (*workspace)(const Mesh&, int64_t size);
  void (*silhouette)(const Mesh&, Blur, int64_t size, void* memory, float* image);
  void (*silhouette_gradient)(const Mesh&, Blur, int64_t size, void* memory, const float* cotangent,
                              float* gradient);
  // `gradient` may be null: then only the loss is computed.
  void (*mask_loss)(const Mesh&, Blur, int64_t size, void* memory, Target, LossKind, float* loss,
                    float* gradient);
};

}  // namespace jaxfit
