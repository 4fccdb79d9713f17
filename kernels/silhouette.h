// The silhouette of a triangle mesh with a soft edge, its losses against a mask and their gradients, for one image.
#pragma once

#include <cstddef>
#include <cstdint>

#include "mesh.h"

namespace jaxfit {

struct Blur {
  float sigma;   // softness s in px²: at a straight edge, the silhouette is sigmoid(-d / s), or has the same variance
  float radius;  // px; a face does not affect the pixels outside it at this distance or farther
};

// How the edge of the silhouette is drawn: silhouette.cc and filtered.cc.
enum class Edge : int32_t { kSoftRasterizer = 0, kUnbiased = 1 };

enum class LossKind : int32_t { kL1 = 0, kSmoothL1 = 1 };

constexpr uint8_t kBackground = 0, kBird = 1, kUnknown = 2;

// A mask with one byte or one float (in [0, 1]) per pixel. Exactly one pointer is set. A byte is kBackground or
// kUnknown; any other value is kBird. Unknown pixels have no loss, no gradient and no curvature.
struct Target {
  const uint8_t* bytes;
  const float* floats;
};

constexpr int64_t kMostInfluences = 8;

// A mesh posed by linear blend skinning: vertex v lies at view · Σ_m weight[v, m] · B[joint[v, m]] · (rest[v], 1), and a
// constant, in the camera frame. The derivative of B[j] with respect to parameter p is moved[j, p] · G[p] · [B[j]; 0 0 0 1],
// for P parameters. S further parameters move the vertices at rest. D = P + S.
struct Skin {
  const float* rest;        // (V, 3)
  const int32_t* joint;     // (V, M)
  const float* weight;      // (V, M); entries of weight 0 are skipped
  const float* transforms;  // (J, 3, 4): B
  const float* generators;  // (3, 4, P): G
  const float* moved;       // (J, P): 1 where a parameter moves a joint, and else 0
  const float* view;        // (3, 3)
  const float* shape;       // (V, 3, S): derivatives of the vertices at rest
  int64_t per_vertex;       // M, at most kMostInfluences
  int64_t transforming;     // P, a multiple of 16
  int64_t parameters;       // D, a multiple of 16
  float focal, centre;      // px of the silhouette
};

// The entry points of one kind of edge and one instruction set. `gradient` is (V, 3) and is overwritten. Its depth column is 0.
struct Kernels {
  // Returns the size of `memory` in bytes for one image. `memory` is 64-byte aligned.
  size_t (*workspace)(const Mesh&, Blur, int64_t size);
  void (*silhouette)(const Mesh&, Blur, int64_t size, void* memory, float* image);
  void (*silhouette_gradient)(const Mesh&, Blur, int64_t size, void* memory, const float* cotangent,
                              float* gradient);
  // Without `gradient`, only the loss is computed. With `block`, which needs `gradient`, a target of bytes and depths in
  // the camera frame, also the Gauss-Newton block Jᵀ·J (D, D) with J = d silhouette / d parameters of `skin`, without the
  // unknown pixels; `memory` then has the size that block_workspace returns.
  void (*mask_loss)(const Mesh&, Blur, int64_t size, void* memory, Target, LossKind, float* loss, float* gradient,
                    const Skin* skin, float* block);
  size_t (*block_workspace)(const Mesh&, const Skin&, Blur, int64_t size);
};

}  // namespace jaxfit
