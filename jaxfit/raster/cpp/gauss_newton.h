// The Gauss-Newton block of the silhouette of one image. Part of silhouette.cc.
//
// The block is Jᵀ·J with one row of J = d silhouette / d parameters for each pixel of the band in which the silhouette
// is neither 0 nor 1, and the mask is not unknown. Of a band with more than kMostRows pixels, an evenly spread part
// enters with a larger weight. A row is the sum over the faces near the pixel: d silhouette / d vertex, times
// d vertex / d parameters. The second factor is computed once for each vertex that some row needs.
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

// Gives rows to the pixels of the band: to all, or to a part whose factors grow by √(band / part).
void choose_rows(const uint8_t* target, int64_t size, Scale scale, const Workspace& ws, Rows& rows) {
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
      // steps of the golden ratio spread the chosen pixels evenly along the band
      const bool chosen = every || number * 2654435769u < threshold;
      ++number;
      if (!chosen || rows.count == kMostRows) continue;
      rows.factor[rows.count] = factor / ws.products[block * kLanes + i];
      rows.of_pixel[block * kLanes + i] = static_cast<int32_t>(rows.count++);
      mine |= 1u << i;
    }
    rows.chosen[block] = static_cast<uint16_t>(mine);
  }
}

// Adds the derivatives of the chosen pixels of a block with respect to the vertices of one edge.
[[gnu::always_inline]] inline void add_edge(const Mesh& mesh, const Skin& skin, const Faces& f, int lane, int edge,
                                            uint32_t pixels, const float* pull_x, const float* pull_y,
                                            const float* along, const int32_t* of_pixel, Rows& rows) {
  const int64_t D = skin.parameters;
  const float* a = vertex_rows(mesh, skin, f.vertex[edge][lane], rows.of_vertex);
  const float* b = vertex_rows(mesh, skin, f.vertex[(edge + 1) % 3][lane], rows.of_vertex);
  for (; pixels; pixels &= pixels - 1) {
    const int i = __builtin_ctz(pixels);
    const float factor = rows.factor[of_pixel[i]], x = factor * pull_x[i], y = factor * pull_y[i];
    const float to_a = 0.5f - along[i], to_b = 0.5f + along[i];
    add_vertices(a, b, to_a * x, to_a * y, to_b * x, to_b * y, D, rows.values + of_pixel[i] * D);
  }
}

// Fills the rows. Closes the blocks without a chosen pixel; the blocks with one must be open.
void fill_rows(const Mesh& mesh, const Skin& skin, Scale scale, Workspace& ws, Rows& rows) {
  const Vec outside = all(scale.radius * scale.radius);
  for_each_place(ws, [&](const float* place, int64_t column, int64_t row) {
    if (!rows.chosen[(place - ws.products) / kLanes]) close(ws, column, row);
  });
  fill(rows.values, rows.count * skin.parameters, 0);
  for (int64_t c = 0; c < ws.num_chunks; ++c) {
    Faces& f = ws.faces[c];
    for (uint32_t todo = f.visible; todo; todo &= todo - 1) {
      const int lane = __builtin_ctz(todo);
      for_each_block<Reached::kKnown>(f, lane, scale, ws, [&](const Face& face, const Block& block)
                                      __attribute__((always_inline)) {
        const int64_t place = block.place - ws.products;
        for (int at = 0; at < kLanes; at += kWidth) {
          const uint32_t chosen = rows.chosen[place / kLanes] >> at & ((1u << kWidth) - 1);
          if (!chosen) continue;
          const Nearest n = nearest_edge(face, block, at);
          uint32_t pixels = bits(greater(outside, n.d)) & chosen;
          if (!pixels) continue;
          const Vec pull = flip_sign(reciprocal(all(1.f) + exp2(n.d)), n.d);
          for (int i = 0; i < 3; ++i) {
            const uint32_t own = i < 2 ? pixels & bits(at_most(n.square[i], n.smallest)) : pixels;
            if (!own) continue;
            pixels &= ~own;
            alignas(64) float pull_x[kWidth], pull_y[kWidth], along[kWidth];
            store(pull_x, pull * fms(face.tx[i], n.beyond[i], face.ty[i] * n.across[i]));
            store(pull_y, pull * fma(face.ty[i], n.beyond[i], face.tx[i] * n.across[i]));
            store(along, n.clamped[i] * all(f.inverse[i][lane]));
            add_edge(mesh, skin, f, lane, i, own, pull_x, pull_y, along, rows.of_pixel + place + at, rows);
          }
        }
      });
    }
  }
}

}  // namespace
}  // namespace jaxfit
