// The pixels that a mesh covers, without their depths. Part of zbuffer.cc.
//
// The image is drawn line by line. A line is a row for masks and a column for runs, because a run follows the columns.
// The results of the edge functions are those of strip.h, bit by bit.
#pragma once

#include "strip.h"

namespace jaxfit {
namespace {

constexpr int64_t kPatchBytes = 4 << 20;
constexpr uint64_t kAllCovered = 0x0101010101010101;  // the bytes of kLanes pixels

typedef uint8_t Bytes __attribute__((vector_size(8)));
typedef uint64_t UnsignedLongs __attribute__((vector_size(64)));

// Whether x or y runs along the lines.
enum Along { kX, kY };

struct Corners {
  double* along;  // px; NaN where faces with this vertex are skipped
  double* across;
};

struct Patch {
  int64_t low, high;   // pixels [low, high) of each line
  int64_t first, end;  // lines [first, end)
  int64_t stride;      // bytes between lines; kLanes pixels from any pixel of a line are within the line
  uint8_t* bytes;      // 1 where the mesh covers the centre of the pixel, else 0

  uint8_t* line(int64_t line) const { return bytes + (line - first) * stride; }
};

struct Triangle {
  double u[3], v[3];  // corners along and across the lines, px
  int64_t left, right, top, bottom;  // range of pixels of each line and of lines, inclusive
};

size_t patch_workspace(const Mesh& mesh) { return 2 * sizeof(double) * mesh.num_vertices + kPatchBytes; }

// Prepares a face. Returns false if the area of the corners in this order is not positive, or if no pixel is covered.
bool set_up(const Corners& corners, int32_t a, int32_t b, int32_t c, const Patch& p, Triangle& t) {
  const double u0 = corners.along[a], u1 = corners.along[b], u2 = corners.along[c];
  const double v0 = corners.across[a], v1 = corners.across[b], v2 = corners.across[c];
  if (!((u1 - u0) * (v2 - v0) - (v1 - v0) * (u2 - u0) > 0)) return false;  // also NaN
  const double left = most(__builtin_ceil(least(least(u0, u1), u2) - 0.5), static_cast<double>(p.low));
  const double right = least(__builtin_floor(most(most(u0, u1), u2) - 0.5), static_cast<double>(p.high - 1));
  const double top = most(__builtin_ceil(least(least(v0, v1), v2) - 0.5), static_cast<double>(p.first));
  const double bottom = least(__builtin_floor(most(most(v0, v1), v2) - 0.5), static_cast<double>(p.end - 1));
  if (left > right || top > bottom) return false;
  t = {{u0, u1, u2}, {v0, v1, v2}, static_cast<int64_t>(left), static_cast<int64_t>(right), static_cast<int64_t>(top),
       static_cast<int64_t>(bottom)};
  return true;
}

void cover(const Patch& p, const Triangle& t) {
  const Doubles lanes = {0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5};
  const Doubles zero = all(0);  // added, it turns -0 into 0: then the sign bit tells negative numbers
  for (int64_t start = t.left; start <= t.right; start += kLanes) {
    const Doubles x = lanes + all(static_cast<double>(start));
    const int64_t inside = t.right - start + 1;  // lanes up to the end of the face
    const uint64_t beyond = inside < kLanes ? kAllCovered << 8 * inside : 0;
    const Doubles dx0 = all(t.u[0]) - x, dx1 = all(t.u[1]) - x, dx2 = all(t.u[2]) - x;
    uint8_t* at = p.line(t.top) + (start - p.low);
    for (int64_t line = t.top; line <= t.bottom; ++line, at += p.stride) {
      uint64_t old;
      __builtin_memcpy(&old, at, sizeof old);
      if ((old | beyond) == kAllCovered) continue;
      const double y = static_cast<double>(line) + 0.5;
      const Doubles dy0 = all(t.v[0] - y), dy1 = all(t.v[1] - y), dy2 = all(t.v[2] - y);
      const Doubles e0 = dx1 * dy2 - dy1 * dx2, e1 = dx2 * dy0 - dy2 * dx0, e2 = dx0 * dy1 - dy0 * dx1;
      const Longs outside = (Longs)(e0 + zero) | (Longs)(e1 + zero) | (Longs)(e2 + zero);
      const Bytes covered = __builtin_convertvector((UnsignedLongs)~outside >> 63, Bytes);
      const uint64_t both = old | ((uint64_t)covered & ~beyond);
      __builtin_memcpy(at, &both, sizeof both);
    }
  }
}

// Calls visit(patch) for patches that together contain all pixels that the mesh covers in the lines [first, end) of
// `length` pixels.
template <typename Visit>
inline void for_each_patch(const Mesh& mesh, Along along, int64_t length, int64_t first, int64_t end, void* memory,
                           Visit visit) {
  const Corners corners{static_cast<double*>(memory), static_cast<double*>(memory) + mesh.num_vertices};
  const double inf = __builtin_inf(), nan = __builtin_nan("");
  double low[2] = {inf, inf}, high[2] = {-inf, -inf};  // along and across the lines
  for (int64_t i = 0; i < mesh.num_vertices; ++i) {
    const float* v = mesh.vertices + 3 * i;
    const bool drawn = v[2] > kNear && __builtin_isfinite(v[0] + 0 * v[1] + 0 * v[2]);
    const double u = drawn ? v[along] : nan, w = drawn ? v[1 - along] : nan;
    corners.along[i] = u, corners.across[i] = w;
    low[0] = least(u, low[0]), high[0] = most(u, high[0]);  // of NaN and a number the number
    low[1] = least(w, low[1]), high[1] = most(w, high[1]);
  }
  const auto within = [](double at, int64_t from, int64_t to) {
    return static_cast<int64_t>(least(most(at, static_cast<double>(from)), static_cast<double>(to)));
  };
  Patch p;
  p.low = within(__builtin_ceil(low[0] - 0.5), 0, length), p.high = within(__builtin_floor(high[0] + 0.5), 0, length);
  if (p.low >= p.high) return;
  p.stride = p.high - p.low + kLanes;
  p.bytes = reinterpret_cast<uint8_t*>(corners.across + mesh.num_vertices);
  const int64_t last = within(__builtin_floor(high[1] + 0.5), first, end), lines = kPatchBytes / p.stride;
  for (p.first = within(__builtin_ceil(low[1] - 0.5), first, end); p.first < last; p.first = p.end) {
    p.end = p.first + lines < last ? p.first + lines : last;
    __builtin_memset(p.bytes, 0, static_cast<size_t>((p.end - p.first) * p.stride));
    // The faces of one side cover most pixels of a closed mesh. The faces of the other side skip these pixels.
    Triangle t;
    for (int64_t i = 0; i < 2 * mesh.num_faces; ++i) {
      const bool back = i >= mesh.num_faces;
      const int32_t* corner = mesh.faces + 3 * (back ? i - mesh.num_faces : i);
      if (set_up(corners, corner[back], corner[!back], corner[2], p, t)) cover(p, t);
    }
    visit(p);
  }
}

}  // namespace
}  // namespace jaxfit
