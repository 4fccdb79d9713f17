// Renders the products of all faces, block by block. Part of silhouette.cc.
#pragma once

#include "blocks.h"

namespace jaxfit {
namespace {

// Multiplies the factors of all faces into `products` and closes the blocks that saturate.
void accumulate_products(Scale scale, Workspace& ws) {
  const Vec outside = all(-scale.radius * scale.radius);
  for (int64_t c = 0; c < ws.num_chunks; ++c) {
    const Faces& f = ws.faces[c];
    for (uint32_t todo = f.visible; todo; todo &= todo - 1) {
      for_each_block(f, __builtin_ctz(todo), scale, ws,
                     [&](const Distances&, const Nearest& n, float* place, int64_t column, int64_t row)
                         __attribute__((always_inline)) {
        const Mask in = n.minus_d > outside;
        const Vec product = grow(load(place), exp2(n.minus_d), in);
        store(place, product);
        if (!bits(product <= all(kSaturated))) close(ws, column, row);
      });
    }
  }
}

// Sets every product to 1 and opens every block. Pixels of the last blocks outside the image get the value kFull.
void clear_products(int64_t size, Workspace& ws) {
  const int64_t whole = size / kBlock;
  for (int64_t i = 0; i < ws.blocks * ws.blocks; ++i) store(ws.products + i * kLanes, all(1.f));
  for (int64_t row = 0; row < ws.blocks; ++row)
    for (int64_t column = row < whole ? whole : 0; column < ws.blocks; ++column)
      for (int i = 0; i < kLanes; ++i)
        if (column * kBlock + i % kBlock >= size || row * kBlock + i / kBlock >= size)
          ws.products[(row * ws.blocks + column) * kLanes + i] = kFull;
  for (int64_t i = 0; i < ws.blocks * ws.row_bytes; ++i) ws.open[i] = 0xFF;
}

// Calls visit(place in `products`, column, row) for every block.
template <typename Visit>
INLINE void for_each_place(const Workspace& ws, Visit visit) {
  for (int64_t row = 0; row < ws.blocks; ++row)
    for (int64_t column = 0; column < ws.blocks; ++column)
      visit(ws.products + (row * ws.blocks + column) * kLanes, column, row);
}

// Returns 1 where a byte of a 4×4 block is not `value`, else 0. The bytes outside the image are `fill`.
INLINE Vec load_unequal(const uint8_t* image, int64_t size, int64_t column, int64_t row, uint8_t value, uint8_t fill) {
  const int64_t x0 = column * kBlock, y0 = row * kBlock;
  if (x0 + kBlock <= size && y0 + kBlock <= size) return unequal(image + y0 * size + x0, size, value);
  uint8_t bytes[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    const int64_t x = x0 + i % kBlock, y = y0 + i / kBlock;
    bytes[i] = x < size && y < size ? image[y * size + x] : fill;
  }
  return unequal(bytes, kBlock, value);
}

// Computes `products`. Returns false if a coordinate is not finite.
bool render(const Mesh& mesh, int64_t size, Scale scale, Workspace& ws) {
  if (!load_vertices(mesh, ws)) return false;
  set_up_faces(mesh, scale, ws);
  clear_products(size, ws);
  accumulate_products(scale, ws);
  return true;
}

}  // namespace
}  // namespace jaxfit
