// Finds the blocks that a face reaches and computes the distances of their pixels. Part of silhouette.cc.
#pragma once

#include "faces.h"

namespace jaxfit {
namespace {

// One face, repeated in all lanes.
struct Face {
  Vec tx[3], ty[3], half[3];
};

[[gnu::always_inline]] inline Face repeat(const Faces& f, int lane) {
  Face face;
  for (int i = 0; i < 3; ++i) {
    face.tx[i] = all(f.tx[i][lane]);
    face.ty[i] = all(f.ty[i][lane]);
    face.half[i] = all(f.half[i][lane]);
  }
  return face;
}

// Positions of sixteen points relative to the three edges of one face: the signed distance to the line of each edge
// (`across`, positive inside) and the position along each edge, measured from its middle (`along`).
struct Positions {
  alignas(64) float across[3][kLanes];
  alignas(64) float along[3][kLanes];
};

// The edge that is nearest to each of some points. `clamped` is the position of the nearest point on each edge, and
// `beyond` is the remaining distance along the edge. `d` is the smallest squared distance to an edge, negative inside.
struct Nearest {
  Vec across[3], clamped[3], beyond[3], square[3], smallest, d, minus_d;
};

[[gnu::always_inline]] inline Nearest nearest_edge(const Face& face, const Vec across[3], const Vec along[3]) {
  Nearest n;
  for (int i = 0; i < 3; ++i) {
    n.across[i] = across[i];
    n.clamped[i] = clamp_to(along[i], face.half[i]);
    n.beyond[i] = along[i] - n.clamped[i];
    n.square[i] = fma(n.beyond[i], n.beyond[i], across[i] * across[i]);
  }
  n.smallest = min(min(n.square[0], n.square[1]), n.square[2]);
  const Ints outside = ((Ints)across[0] | (Ints)across[1] | (Ints)across[2]) & INT32_MIN;  // the signs
  n.minus_d = (Vec)((Ints)n.smallest | outside);
  n.d = (Vec)((Ints)n.smallest | (outside ^ INT32_MIN));
  return n;
}

// One of three values: that of the edge that is nearest. On a tie the first edge is taken.
[[gnu::always_inline]] inline Vec pick(const Nearest& n, Vec first, Vec second, Vec third) {
  return select(at_most(n.square[0], n.smallest), first, select(at_most(n.square[1], n.smallest), second, third));
}

// Row and column of the sixteen blocks of a window, for each width of the window from 1 to 16 blocks.
struct Windows {
  alignas(64) float column[kLanes + 1][kLanes], row[kLanes + 1][kLanes];
  uint8_t column_of[kLanes + 1][kLanes], row_of[kLanes + 1][kLanes];
  constexpr Windows() : column(), row(), column_of(), row_of() {
    for (int width = 1; width <= kLanes; ++width)
      for (int i = 0; i < kLanes; ++i) {
        column[width][i] = column_of[width][i] = i % width;
        row[width][i] = row_of[width][i] = i / width;
      }
  }
};
constexpr Windows kWindows;

// Sixteen neighbouring blocks or fewer: whole rows of `width` blocks, from the block at (column, row) on.
struct Window {
  int32_t column, row;
  int width, height;
};

// Returns the bits of the open blocks of a window.
[[gnu::always_inline]] inline uint32_t open_blocks(const Workspace& ws, Window w) {
  const uint8_t* bytes = ws.open + w.row * ws.row_bytes + w.column / 8;
  uint32_t open = 0;
  for (int i = 0; i < w.height; ++i, bytes += ws.row_bytes) {
    uint32_t word;
    __builtin_memcpy(&word, bytes, sizeof word);
    open |= (word >> w.column % 8 & ((1u << w.width) - 1)) << i * w.width;
  }
  return open;
}

// A block near a face.
struct Block {
  int64_t column, row;
  float* place;                 // in `products`
  float across[3], along[3];    // position of its centre
  const Positions* to_pixel;    // from the centre to the pixels
};

// Returns the nearest edges of the pixels of a block from the pixel `at` on that fill a register.
[[gnu::always_inline]] inline Nearest nearest_edge(const Face& face, const Block& block, int at) {
  Vec across[3], along[3];
  for (int i = 0; i < 3; ++i) {
    across[i] = load(block.to_pixel->across[i] + at) + all(block.across[i]);
    along[i] = load(block.to_pixel->along[i] + at) + all(block.along[i]);
  }
  return nearest_edge(face, across, along);
}

[[gnu::always_inline]] inline void set_pixels(const Face& face, Scale scale, Positions& to_pixel) {
  for (int at = 0; at < kLanes; at += kWidth) {
    const Vec x = (load(kWindows.column[kBlock] + at) - all(1.5f)) * all(scale.k);
    const Vec y = (load(kWindows.row[kBlock] + at) - all(1.5f)) * all(scale.k);
    for (int i = 0; i < 3; ++i) {
      store(to_pixel.across[i] + at, fms(face.tx[i], y, face.ty[i] * x));
      store(to_pixel.along[i] + at, fma(face.tx[i], x, face.ty[i] * y));
    }
  }
}

// Fills the positions of the centres of a window's blocks.
[[gnu::always_inline]] inline void set_centres(const Face& face, const Faces& f, int lane, Window w, Scale scale,
                                               Positions& centre) {
  const Vec x0 = all(((static_cast<float>(w.column) + 0.5f) * kBlock - f.x0[lane]) * scale.k);
  const Vec y0 = all(((static_cast<float>(w.row) + 0.5f) * kBlock - f.y0[lane]) * scale.k);
  for (int at = 0; at < kLanes; at += kWidth) {
    const Vec x = fma(load(kWindows.column[w.width] + at), all(kBlock * scale.k), x0);
    const Vec y = fma(load(kWindows.row[w.width] + at), all(kBlock * scale.k), y0);
    for (int i = 0; i < 3; ++i) {
      const Vec across = fms(face.tx[i], y, face.ty[i] * x);
      store(centre.across[i] + at, i == 1 ? across + all(f.height[lane]) : across);
      store(centre.along[i] + at, fma(face.tx[i], x, fma(face.ty[i], y, all(f.shift[i][lane]))));
    }
  }
}

// Returns the bits of the blocks of a window that the face reaches.
[[gnu::always_inline]] inline uint32_t blocks_in_reach(const Face& face, const Faces& f, int lane, Scale scale,
                                                       const Positions& centre) {
  const float reach = scale.radius + 2.1213204f * scale.k;  // 1.5·√2 px from a block's centre to its corner pixels
  uint32_t near = 0;
  for (int at = 0; at < kLanes; at += kWidth) {
    Vec across[3], along[3];
    for (int i = 0; i < 3; ++i) {
      across[i] = load(centre.across[i] + at);
      along[i] = load(centre.along[i] + at);
    }
    const Mask in_reach = greater(all(reach * reach), nearest_edge(face, across, along).d) &
                          greater(across[0], all(f.reach[0][lane])) & greater(across[1], all(f.reach[1][lane])) &
                          greater(across[2], all(f.reach[2][lane]));
    near |= bits(in_reach) << at;
  }
  return near;
}

// Whether the blocks that a face reaches have to be found, or are known from an earlier visit.
enum class Reached { kUnknown, kKnown };

// Calls visit(face, block) for each open block in reach. The first visit stores the blocks of a face with one window; most
// faces have one.
template <Reached reached, typename Visit>
[[gnu::always_inline]] inline void for_each_block(Faces& f, int lane, Scale scale, const Workspace& ws, Visit visit) {
  const int32_t left = f.left[lane], right = f.right[lane], top = f.top[lane], bottom = f.bottom[lane];
  const bool one_window = (right - left + 1) * (bottom - top + 1) <= kLanes;
  const bool known = one_window && reached == Reached::kKnown;
  for (int32_t column = left; column <= right; column += kLanes) {
    const int width = right - column < kLanes ? right - column + 1 : kLanes;
    const int height = kLanes / width;
    for (int32_t row = top; row <= bottom; row += height) {
      const Window window = {column, row, width, bottom - row < height ? bottom - row + 1 : height};
      uint32_t todo = open_blocks(ws, window);
      if (known) todo &= f.near[lane];
      if (one_window && !known) f.near[lane] = 0;
      if (!todo) continue;
      const Face face = repeat(f, lane);
      Positions centre, to_pixel;
      set_centres(face, f, lane, window, scale, centre);
      if (!known) todo &= blocks_in_reach(face, f, lane, scale, centre);
      if (one_window && !known) f.near[lane] = todo;
      set_pixels(face, scale, to_pixel);
      for (; todo; todo &= todo - 1) {
        const int i = __builtin_ctz(todo);
        Block block;
        block.column = column + kWindows.column_of[width][i];
        block.row = row + kWindows.row_of[width][i];
        block.place = ws.products + (block.row * ws.blocks + block.column) * kLanes;
        for (int k = 0; k < 3; ++k) {
          block.across[k] = centre.across[k][i];
          block.along[k] = centre.along[k][i];
        }
        block.to_pixel = &to_pixel;
        visit(face, block);
      }
    }
  }
}

}  // namespace
}  // namespace jaxfit
