// A triangle mesh in an image.
#pragma once

#include <cstdint>

namespace jaxfit {

constexpr int64_t kMaxSize = 1 << 14;  // px, the greatest width or height of an image
constexpr float kFarAway = 1048576.f;  // px; silhouettes clamp coordinates to ± this, so that squares stay finite
constexpr float kMinDepth = 1e-8f;     // silhouettes skip faces with a vertex at or behind this depth
constexpr float kMinArea = 1e-8f;      // greatest |2·area| of a skipped face, in units of half the image

// The distinct edges of the faces. Only the filtered silhouette needs them.
struct Edges {
  const int32_t* ends;     // (E, 2): the vertices of each edge
  const int32_t* of_face;  // (F, 3): twice the index of the edge from each corner to the next, + 1 if it is reversed
  int64_t count;
};

struct Mesh {
  const float* vertices;  // (V, 3): x and y in pixels, depth in the camera frame
  const int32_t* faces;   // (F, 3), every index in [0, V)
  int64_t num_vertices;
  int64_t num_faces;
  Edges edges{};
};

}  // namespace jaxfit
