// What is seen at the pixels of an image: the nearest face, its attributes, the mask. For rows of one image at a time.
#pragma once

#include <cstddef>
#include <cstdint>

#include "mesh.h"

namespace jaxfit {

constexpr int64_t kMaxSamples = 8;

struct Frame {
  int64_t width, height;  // px, 1 to kMaxSize
  int64_t samples;        // along a pixel's side, 1 to kMaxSamples
};

struct Rows {
  int64_t first, end;  // pixel rows [first, end)
};

// The entry points of one instruction set. Results are row-major and point to their image's first pixel; only the
// given rows are written. `memory` is 64-byte aligned and of `workspace` bytes. Rows do not depend on each other.
struct Renderer {
  size_t (*workspace)(const Mesh&, Frame, Rows);
  // One sample a pixel: face (H, W), barycentric (H, W, 3), depth (H, W).
  void (*fragments)(const Mesh&, Frame, Rows, void* memory, int32_t* face, float* barycentric, float* depth);
  // One sample a pixel; writes 1 where the mesh is and leaves the rest.
  void (*mask)(const Mesh&, Frame, Rows, void* memory, uint8_t* mask);
  // attributes (V, C); values (H, W, C), coverage (H, W), face (H, W).
  void (*interpolate)(const Mesh&, Frame, Rows, void* memory, const float* attributes, int64_t channels,
                      float* values, float* coverage, int32_t* face);
  // colours (V, 3) over image (H, W, 3), of which only covered pixels are written.
  void (*draw)(const Mesh&, Frame, Rows, void* memory, const float* colours, uint8_t* image);
};

}  // namespace jaxfit
