// A triangle mesh in an image.
#pragma once

#include <cstdint>

namespace jaxfit {

constexpr int64_t kMaxSize = 1 << 14;  // px, the greatest width or height of an image

struct Mesh {
  const float* vertices;  // (V, 3): x and y in pixels, depth in the camera frame
  const int32_t* faces;   // (F, 3), every index in [0, V)
  int64_t num_vertices;
  int64_t num_faces;
};

}  // namespace jaxfit
