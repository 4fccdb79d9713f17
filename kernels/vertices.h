// What both kinds of silhouettes do with coordinates, gradients of vertices and rows of floats. Part of silhouette.cc and
// filtered.cc.
#pragma once

#include "silhouette.h"
#include "simd.h"

namespace jaxfit {
namespace {

[[gnu::always_inline]] inline int64_t round_up(int64_t n) { return (n + kLanes - 1) / kLanes * kLanes; }

void fill(float* p, int64_t n, float value) {
  for (int64_t i = 0; i < n; ++i) p[i] = value;
}

[[gnu::always_inline]] inline float clamp_far(float a) { return a < -kFarAway ? -kFarAway : a > kFarAway ? kFarAway : a; }

// Sets x and y of the gradient to a value, and the depth to 0.
void set_gradient(float* gradient, int64_t vertices, float value) {
  for (int64_t i = 0; i < vertices; ++i) gradient[3 * i] = gradient[3 * i + 1] = value, gradient[3 * i + 2] = 0;
}

// Clamped coordinates have no gradient.
void clear_far_gradient(const Mesh& mesh, float* gradient) {
  for (int64_t i = 0; i < mesh.num_vertices; ++i)
    for (int c = 0; c < 2; ++c) {
      const float v = mesh.vertices[3 * i + c];
      if (v < -kFarAway || v > kFarAway) gradient[3 * i + c] = 0;
    }
}

}  // namespace
}  // namespace jaxfit
