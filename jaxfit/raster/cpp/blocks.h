// Finds the blocks that a face reaches and computes the distances of their pixels. Part of silhouette.cc.
#pragma once

#include "faces.h"

namespace jaxfit {
namespace {

// Positions of sixteen points relative to the three edges of one face: the signed distance to the line of each edge
// (`across`, positive inside) and the position along each edge, measured from its middle (`along`).
struct Distances {
  Vec across[3], along[3];
};

// `d` is the smallest squared distance to an edge, negative inside. `clamped` is the position of the nearest point on
// each edge, and `beyond` is the remaining distance along the edge.
struct Nearest {
  Vec clamped[3], beyond[3], square[3], smallest, d, minus_d;
};

INLINE Nearest nearest_edge(const Distances& at, const Vec half[3]) {
  Nearest n;
  for (int i = 0; i < 3; ++i) {
    n.clamped[i] = clamp_to(at.along[i], half[i]);
    n.beyond[i] = at.along[i] - n.clamped[i];
    n.square[i] = fma(n.beyond[i], n.beyond[i], at.across[i] * at.across[i]);
  }
  n.smallest = min(min(n.square[0], n.square[1]), n.square[2]);
  n.d = negate_unless_any_negative(n.smallest, at.across[0], at.across[1], at.across[2]);
  n.minus_d = negate_if_any_negative(n.smallest, at.across[0], at.across[1], at.across[2]);
  return n;
}

// Divides the pixels `in` between the edges by the nearest edge. On a tie the first edge takes the pixel.
INLINE void divide_pixels(const Nearest& n, Mask in, Mask of_edge[3]) {
  of_edge[0] = in & (n.square[0] <= n.smallest);
  of_edge[1] = without(in & (n.square[1] <= n.smallest), of_edge[0]);
  of_edge[2] = without(without(in, of_edge[0]), of_edge[1]);
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

// Calls visit(distances of the pixels, nearest edges, place in `products`, column, row) for each open block in reach.
template <typename Visit>
INLINE void for_each_block(const Faces& f, int lane, Scale scale, const Workspace& ws, Visit visit) {
  const int32_t left = f.left[lane], right = f.right[lane], top = f.top[lane], bottom = f.bottom[lane];
  const float reach = scale.radius + 2.1213204f * scale.k;  // 1.5·√2 px from a block's centre to its corner pixels
  const float block_size = kBlock * scale.k;
  const Vec offset_x = (load(kWindows.column[4]) - all(1.5f)) * all(scale.k);
  const Vec offset_y = (load(kWindows.row[4]) - all(1.5f)) * all(scale.k);
  Vec tx[3], ty[3], half[3];
  Distances offset;
  for (int i = 0; i < 3; ++i) {
    tx[i] = all(f.tx[i][lane]), ty[i] = all(f.ty[i][lane]), half[i] = all(f.half[i][lane]);
    offset.across[i] = fms(tx[i], offset_y, ty[i] * offset_x);
    offset.along[i] = fma(tx[i], offset_x, ty[i] * offset_y);
  }

  for (int32_t first = left; first <= right; first += kLanes) {
    const int width = right - first < kLanes ? right - first + 1 : kLanes;
    const int height = kLanes / width;
    const float x0 = ((static_cast<float>(first) + 0.5f) * kBlock - f.x0[lane]) * scale.k;
    const Vec x = fma(load(kWindows.column[width]), all(block_size), all(x0));
    for (int32_t row = top; row <= bottom; row += height) {
      uint32_t open = 0;
      const uint8_t* bytes = ws.open + row * ws.row_bytes + first / 8;
      for (int i = 0; i < height && row + i <= bottom; ++i, bytes += ws.row_bytes) {
        uint32_t word;
        __builtin_memcpy(&word, bytes, 4);
        open |= (word >> first % 8 & ((1u << width) - 1)) << i * width;
      }
      if (!open) continue;
      const float y0 = ((static_cast<float>(row) + 0.5f) * kBlock - f.y0[lane]) * scale.k;
      const Vec y = fma(load(kWindows.row[width]), all(block_size), all(y0));
      Distances centre;
      alignas(64) float across[3][kLanes], along[3][kLanes];
      for (int i = 0; i < 3; ++i) {
        centre.across[i] = fms(tx[i], y, ty[i] * x);
        if (i == 1) centre.across[i] = centre.across[i] + all(f.height[lane]);
        centre.along[i] = fma(tx[i], x, fma(ty[i], y, all(f.shift[i][lane])));
        store(across[i], centre.across[i]), store(along[i], centre.along[i]);
      }
      const Mask near = (all(reach * reach) > nearest_edge(centre, half).d) &
                        (centre.across[0] > all(f.reach[0][lane])) & (centre.across[1] > all(f.reach[1][lane])) &
                        (centre.across[2] > all(f.reach[2][lane]));
      for (uint32_t todo = bits(near) & open; todo; todo &= todo - 1) {
        const int block = __builtin_ctz(todo);
        Distances at;
        for (int i = 0; i < 3; ++i) {
          at.across[i] = offset.across[i] + all(across[i][block]);
          at.along[i] = offset.along[i] + all(along[i][block]);
        }
        const int64_t c = first + kWindows.column_of[width][block], r = row + kWindows.row_of[width][block];
        visit(at, nearest_edge(at, half), ws.products + (r * ws.blocks + c) * kLanes, c, r);
      }
    }
  }
}

}  // namespace
}  // namespace jaxfit
