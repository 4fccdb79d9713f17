// Derivatives of the vertices with respect to the parameters of a pose, and products of rows of derivatives. Part of
// silhouette.cc and filtered.cc.
#pragma once

#include "vertices.h"

namespace jaxfit {
namespace {

struct VertexRows {
  float* values;   // (V, 2, D): d vertex / d parameters in px, for the vertices that are ready
  uint8_t* ready;  // (V)
};

// Returns d vertex / d parameters in px: D derivatives of x, then D of y. Computes them where they are not ready.
[[gnu::always_inline]] inline const float* vertex_rows(const Mesh& mesh, const Skin& skin, int64_t v, const VertexRows& rows) {
  const int64_t D = skin.parameters, P = skin.transforming, S = D - P;
  float* out = rows.values + 2 * v * D;
  if (rows.ready[v]) return out;
  rows.ready[v] = 1;
  const float* at = mesh.vertices + 3 * v;
  const float* rest = skin.rest + 3 * v;
  const float zoom = skin.focal / at[2];
  float onto[2][3];  // of x and y in px, by a displacement before the view
  for (int i = 0; i < 2; ++i)
    for (int c = 0; c < 3; ++c)
      onto[i][c] = zoom * skin.view[3 * i + c] + (skin.centre - at[i]) / at[2] * skin.view[6 + c];
  float linear[3][3] = {}, points[kMostInfluences][4];  // Σ weight · B without its last column, weight · (B · rest, 1)
  const float* moved[kMostInfluences];
  int64_t used = 0;
  for (int64_t m = v * skin.per_vertex; m < (v + 1) * skin.per_vertex; ++m) {
    const float w = skin.weight[m];
    if (w == 0) continue;
    for (int i = 0; i < 3; ++i) {
      const float* B = skin.transforms + 12 * skin.joint[m] + 4 * i;
      for (int c = 0; c < 3; ++c) linear[i][c] += w * B[c];
      points[used][i] = w * (B[0] * rest[0] + B[1] * rest[1] + B[2] * rest[2] + B[3]);
    }
    moved[used] = skin.moved + skin.joint[m] * P;
    points[used++][3] = w;
  }
  for (int64_t d = 0; d < D; d += kWidth) {
    Vec x[3] = {all(0.f), all(0.f), all(0.f)};  // d position / d parameters, before the view
    if (d < P) {
      Vec point[4] = {all(0.f), all(0.f), all(0.f), all(0.f)};  // of the joints that each parameter moves
      for (int64_t m = 0; m < used; ++m)
        for (int c = 0; c < 4; ++c) point[c] = fma(all(points[m][c]), load(moved[m] + d), point[c]);
      for (int i = 0; i < 3; ++i)
        for (int c = 0; c < 4; ++c) x[i] = fma(load(skin.generators + (4 * i + c) * P + d), point[c], x[i]);
    }
    for (int c = 0; d >= P && c < 3; ++c) {
      const Vec shape = load(skin.shape + (3 * v + c) * S + d - P);
      for (int i = 0; i < 3; ++i) x[i] = fma(all(linear[i][c]), shape, x[i]);
    }
    for (int i = 0; i < 2; ++i)
      store(out + i * D + d, fma(all(onto[i][0]), x[0], fma(all(onto[i][1]), x[1], all(onto[i][2]) * x[2])));
  }
  return out;
}

// row += ax · (x of a) + ay · (y of a) + bx · (x of b) + by · (y of b), with the rows a and b of two vertices.
[[gnu::always_inline]] inline void add_vertices(const float* a, const float* b, float ax, float ay, float bx, float by, int64_t D,
                         float* row) {
  const Vec wax = all(ax), way = all(ay), wbx = all(bx), wby = all(by);
  for (int64_t d = 0; d < D; d += kWidth) {
    Vec sum = load(row + d);
    sum = fma(wax, load(a + d), fma(way, load(a + D + d), sum));
    sum = fma(wbx, load(b + d), fma(wby, load(b + D + d), sum));
    store(row + d, sum);
  }
}

constexpr int kColumns = 5;  // registers of a row that are summed at a time

// Adds four lines of leftᵀ · right, in n registers from column d on, to the block.
template <int n>
[[gnu::always_inline]] inline void add_products(const float* left, const float* right, int64_t count, int64_t D, float* block) {
  Vec sums[4][n];
  for (int k = 0; k < 4; ++k)
    for (int c = 0; c < n; ++c) sums[k][c] = load(block + k * D + c * kWidth);
  for (int64_t r = 0; r < count; ++r)
    for (int c = 0; c < n; ++c) {
      const Vec own = load(right + r * D + c * kWidth);
      for (int k = 0; k < 4; ++k) sums[k][c] = fma(all(left[r * D + k]), own, sums[k][c]);
    }
  for (int k = 0; k < 4; ++k)
    for (int c = 0; c < n; ++c) store(block + k * D + c * kWidth, sums[k][c]);
}

// block = leftᵀ · right, which is symmetric. Some rows at a time, which stay in the cache.
void multiply_rows(const float* left, const float* right, int64_t count, int64_t D, float* block) {
  constexpr int64_t rows = 48;
  fill(block, D * D, 0);
  for (int64_t first = 0; first < count; first += rows) {
    const int64_t part = count - first < rows ? count - first : rows;
    for (int64_t i = 0; i < D; i += 4)
      for (int64_t d = i / kWidth * kWidth; d < D;) {
        const float *l = left + first * D + i, *r = right + first * D + d;
        float* to = block + i * D + d;
        const int64_t whole = (D - d) / kWidth;
        if (whole >= kColumns) add_products<kColumns>(l, r, part, D, to), d += kColumns * kWidth;
        else if (whole >= 2) add_products<2>(l, r, part, D, to), d += 2 * kWidth;
        else add_products<1>(l, r, part, D, to), d += kWidth;
      }
  }
  for (int64_t i = 0; i < D; ++i)
    for (int64_t d = 0; d < i; ++d) block[i * D + d] = block[d * D + i];
}

}  // namespace
}  // namespace jaxfit
