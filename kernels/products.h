// Renders the products of all faces, block by block. Part of silhouette.cc.
#pragma once

#include "blocks.h"

namespace jaxfit {
namespace {

// Multiplies the factors of all faces into `products` and closes the blocks that saturate.
void accumulate_products(Scale scale, Workspace& ws) {
  const Vec at_radius = all(-scale.radius * scale.radius), saturated = all(kSaturated);
  for (int64_t c = 0; c < ws.num_chunks; ++c) {
    Faces& f = ws.faces[c];
    for (uint32_t todo = f.visible; todo; todo &= todo - 1) {
      const int lane = __builtin_ctz(todo);
      for_each_block<Reached::kUnknown>(f, lane, scale, ws, [&](const Face& face, const Block& block)
                                        __attribute__((always_inline)) {
        uint32_t open = 0;
        Vec minus_d[kLanes / kWidth];  // all of them first, because each takes long to compute
        for (int i = 0; i < kLanes / kWidth; ++i) minus_d[i] = nearest_edge(face, block, i * kWidth).minus_d;
        for (int i = 0; i < kLanes / kWidth; ++i) {
          float* place = block.place + i * kWidth;
          const Vec product = grow(load(place), exp2(minus_d[i]), greater(minus_d[i], at_radius));
          store(place, product);
          open |= bits(at_most(product, saturated));
        }
        if (!open) close(ws, block.column, block.row);
      });
    }
  }
}

// Sets every product to 1 and opens every block. Pixels of the last blocks outside the image get the value kFull.
void clear_products(int64_t size, Workspace& ws) {
  const int64_t whole = size / kBlock;
  fill(ws.products, ws.blocks * ws.blocks * kLanes, 1);
  for (int64_t row = 0; row < ws.blocks; ++row)
    for (int64_t column = row < whole ? whole : 0; column < ws.blocks; ++column)
      for (int i = 0; i < kLanes; ++i)
        if (column * kBlock + i % kBlock >= size || row * kBlock + i / kBlock >= size)
          ws.products[(row * ws.blocks + column) * kLanes + i] = kFull;
  for (int64_t i = 0; i < ws.blocks * ws.row_bytes; ++i) ws.open[i] = 0xFF;
}

// Calls visit(place in `products`, column, row) for every block.
template <typename Visit>
[[gnu::always_inline]] inline void for_each_place(const Workspace& ws, Visit visit) {
  for (int64_t row = 0; row < ws.blocks; ++row)
    for (int64_t column = 0; column < ws.blocks; ++column)
      visit(ws.products + (row * ws.blocks + column) * kLanes, column, row);
}

// The sixteen values of a block.
struct BlockValues {
  alignas(64) float at[kLanes];
};

// Returns 1 where a byte of a 4×4 block is not `value`, else 0. The bytes outside the image are `fill`.
[[gnu::always_inline]] inline BlockValues load_unequal(const uint8_t* image, int64_t size, int64_t column, int64_t row,
                                                       uint8_t value, uint8_t fill) {
  typedef float Quad __attribute__((vector_size(16)));
  typedef int32_t IntQuad __attribute__((vector_size(16)));
  const IntQuad own_byte = {0xFF, 0xFF00, 0xFF0000, INT32_MIN >> 7};
  const int64_t x0 = column * kBlock, y0 = row * kBlock;
  const bool whole = x0 + kBlock <= size && y0 + kBlock <= size;
  BlockValues values;
  for (int i = 0; i < kBlock; ++i) {
    uint8_t bytes[kBlock];
    for (int n = 0; n < kBlock && !whole; ++n)
      bytes[n] = x0 + n < size && y0 + i < size ? image[(y0 + i) * size + x0 + n] : fill;
    int32_t word;
    __builtin_memcpy(&word, whole ? image + (y0 + i) * size + x0 : bytes, sizeof word);
    const IntQuad differs = (IntQuad)(((IntQuad{} + (word ^ value * 0x01010101)) & own_byte) != 0);
    const Quad ones = (Quad)(differs & (IntQuad)(Quad{} + 1.f));
    __builtin_memcpy(values.at + i * kBlock, &ones, sizeof ones);
  }
  return values;
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
