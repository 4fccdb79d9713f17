// The Gauss-Newton block of the silhouette of one image. Part of silhouette.cc.
//
// The block is Jᵀ·J with one row of J = d silhouette / d parameters for each pixel of the band in which the silhouette
// is neither 0 nor 1, and the mask is not unknown. Of a band with more than kMostRows pixels, an evenly spread part
// enters with a larger weight. A row is the sum over the faces near the pixel: d silhouette / d vertex, times
// d vertex / d parameters. The pass over the faces that adds the gradient adds the rows too, because both need the nearest
// points. The second factor is computed once for each vertex that some row needs.
#pragma once

#include "products.h"
#include "vertex_rows.h"

namespace jaxfit {
namespace {

constexpr int64_t kMostRows = 256;
constexpr float kBandEdge = 0.01f;  // the band holds the pixels whose silhouette is this far from 0 and from 1

struct Rows {
  float* values;        // (kMostRows, D)
  float* factor;        // (kMostRows): the factor of p · (pixel - nearest point) in d silhouette
  int32_t* of_pixel;    // for each chosen pixel of each block the index of its row
  VertexRows of_vertex;
  uint16_t* chosen;     // for each block the pixels that have a row, as bits
  int64_t count;
};

size_t block_workspace(const Mesh& mesh, const Skin& skin, Blur blur, int64_t size) {
  const Layout l(mesh, size);
  const int64_t floats = kMostRows * (skin.parameters + 1) + l.products + 2 * mesh.num_vertices * skin.parameters;
  const int64_t bytes = sizeof(float) * floats + sizeof(uint16_t) * l.blocks * l.blocks + mesh.num_vertices;
  return workspace(mesh, blur, size) + bytes;
}

[[gnu::always_inline]] inline Rows carve_rows(const Mesh& mesh, const Skin& skin, Blur blur, int64_t size, void* memory) {
  const Layout l(mesh, size);
  Rows rows;
  rows.values = reinterpret_cast<float*>(static_cast<char*>(memory) + workspace(mesh, blur, size));
  rows.factor = rows.values + kMostRows * skin.parameters;
  rows.of_vertex.values = rows.factor + kMostRows;
  rows.of_pixel = reinterpret_cast<int32_t*>(rows.of_vertex.values + 2 * mesh.num_vertices * skin.parameters);
  rows.chosen = reinterpret_cast<uint16_t*>(rows.of_pixel + l.products);
  rows.of_vertex.ready = reinterpret_cast<uint8_t*>(rows.chosen + l.blocks * l.blocks);
  for (int64_t i = 0; i < mesh.num_vertices; ++i) rows.of_vertex.ready[i] = 0;
  rows.count = 0;
  return rows;
}

// Finds the known pixels in the band, as bits of each block in `chosen`. Returns their number.
int64_t find_band(const uint8_t* target, int64_t size, const Workspace& ws, Rows& rows) {
  const Vec one = all(1.f), low = all(kBandEdge), high = all(1 - kBandEdge);
  int64_t count = 0;
  for_each_place(ws, [&](const float* place, int64_t column, int64_t row) __attribute__((always_inline)) {
    uint32_t band = 0;
    for (int at = 0; at < kLanes; at += kWidth) {
      const Vec transmitted = one / load(place + at);
      band |= bits(greater(transmitted, low) & greater(high, transmitted)) << at;
    }
    if (band) {
      const BlockValues known = load_unequal(target, size, column, row, kUnknown, kBird);
      for (int at = 0; at < kLanes; at += kWidth)
        band &= ~(bits(at_most(load(known.at + at), all(0.f))) << at);
    }
    rows.chosen[(place - ws.products) / kLanes] = static_cast<uint16_t>(band);
    count += __builtin_popcount(band);
  });
  return count;
}

// Gives rows to the pixels of the band: to all, or to a part whose factors grow by √(band / part). Reads the products, so
// it comes before the loss. Clears the rows.
void choose_rows(const uint8_t* target, int64_t size, int64_t D, Scale scale, const Workspace& ws, Rows& rows) {
  const int64_t band = find_band(target, size, ws, rows);
  const bool every = band <= kMostRows;
  // fewer than kMostRows, because the number of chosen pixels varies
  const double part = every ? 1 : 0.95 * kMostRows / static_cast<double>(band);
  const uint32_t threshold = static_cast<uint32_t>(part * 4294967295.0);
  const float factor = scale.slope * (every ? 1.f : __builtin_sqrtf(static_cast<float>(1 / part)));
  uint32_t number = 0;
  for (int64_t block = 0; block < ws.blocks * ws.blocks; ++block) {
    uint32_t mine = 0;
    for (uint32_t todo = rows.chosen[block]; todo; todo &= todo - 1) {
      const int i = __builtin_ctz(todo);
      // steps of the golden ratio spread the chosen pixels evenly over the band, in the order of the blocks
      const bool chosen = every || number * 2654435769u < threshold;
      ++number;
      if (!chosen || rows.count == kMostRows) continue;
      rows.factor[rows.count] = factor / ws.products[block * kLanes + i];
      rows.of_pixel[block * kLanes + i] = static_cast<int32_t>(rows.count++);
      mine |= 1u << i;
    }
    rows.chosen[block] = static_cast<uint16_t>(mine);
  }
  fill(rows.values, rows.count * D, 0);
}

// The pull of some pixels on the corners of a face: for each pixel p · (pixel - nearest point), with the sign of d, and
// the shares of the corners 0 and 1. The third corner has the rest. Corners that the nearest edge lacks have the share 0.
struct Pull {
  alignas(64) float x[kWidth], y[kWidth], share0[kWidth], share1[kWidth];
};

// Adds d silhouette / d parameters, through one face, to the rows of the chosen pixels.
[[gnu::always_inline]] inline void add_to_rows(const Mesh& mesh, const Skin& skin, const Faces& f, int lane, uint32_t pixels,
                                               const Pull& pull, const int32_t* of_pixel, const Rows& rows) {
  const int64_t D = skin.parameters;
  for (; pixels; pixels &= pixels - 1) {
    const int i = __builtin_ctz(pixels);
    // The two corners of the nearest edge. If the nearest point is a corner, the other one has the share 0.
    const float share[3] = {pull.share0[i], pull.share1[i], 1 - pull.share0[i] - pull.share1[i]};
    const int first = share[0] == 0 ? 1 : 0, second = share[0] == 0 || share[1] == 0 ? 2 : 1;
    const float factor = rows.factor[of_pixel[i]], x = factor * pull.x[i], y = factor * pull.y[i];
    add_vertices(vertex_rows(mesh, skin, f.vertex[first][lane], rows.of_vertex),
                 vertex_rows(mesh, skin, f.vertex[second][lane], rows.of_vertex), share[first] * x, share[first] * y,
                 share[second] * x, share[second] * y, D, rows.values + of_pixel[i] * D);
  }
}

}  // namespace
}  // namespace jaxfit
