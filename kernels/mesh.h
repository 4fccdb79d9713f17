// A triangle mesh in an image.
#pragma once

#include <cstdint>

namespace jaxfit {

struct Mesh {
  const float* vertices;  // (V, 3): x, y in pixels, depth in the camera's frame
  const int32_t* faces;   // (F, 3), every index in [0, V)
  int64_t num_vertices;
  int64_t num_faces;
};

}  // namespace jaxfit
