// A strip: some rows of an image, and the faces drawn into them. Part of zbuffer.cc.
//
// As in simd.h, everything is in an anonymous namespace, and templates of the standard library are not used.
#pragma once

#include "zbuffer.h"

namespace jaxfit {
namespace {

constexpr int kLanes = 8;
constexpr int64_t kTile = 32;  // pixels; the samples of a tile fill whole registers
constexpr double kNear = 1e-3f;  // rounded to float, because vertices are floats

typedef double Doubles __attribute__((vector_size(64)));
typedef int64_t Longs __attribute__((vector_size(64)));
typedef float Floats __attribute__((vector_size(32)));
typedef int32_t Ints __attribute__((vector_size(32)));

struct Face {
  double x[3], y[3];   // corners, in samples
  double k[3];         // 1 / (depth · |2·area|)
  double low, high;    // least and greatest 1/depth
  double turn;         // sign of the area
  int32_t index;       // index of the face in the mesh
  int32_t left, right, top, bottom;  // range of samples, inclusive; rows count from the first row of the strip
};

struct Strip {
  Frame frame;
  Rows rows;
  int64_t columns, lines, tiles;  // samples in a line, lines of samples, tiles in a line
  float* near;                    // 1/depth, -1 without a face; undefined in untouched tiles, as is `face`
  int32_t* face;                  // place in `faces`, -1 without a face
  uint8_t* touched;               // one byte per tile
  Face* faces;
  int32_t num_faces;
};

int64_t round_up(int64_t n, int64_t step) { return (n + step - 1) / step * step; }

Strip lay_out(const Mesh& mesh, Frame frame, Rows rows, char* memory, size_t& bytes) {
  Strip s;
  s.frame = frame, s.rows = rows;
  s.tiles = (frame.width + kTile - 1) / kTile;
  s.columns = s.tiles * kTile * frame.samples, s.lines = (rows.end - rows.first) * frame.samples;
  const int64_t area = s.columns * s.lines * 4, flags = round_up(s.tiles, 64);
  s.near = reinterpret_cast<float*>(memory);
  s.face = reinterpret_cast<int32_t*>(memory + area);
  s.touched = reinterpret_cast<uint8_t*>(memory + 2 * area);
  s.faces = reinterpret_cast<Face*>(memory + 2 * area + flags);
  s.num_faces = 0;
  bytes = 2 * area + flags + mesh.num_faces * sizeof(Face);
  return s;
}

size_t strip_workspace(const Mesh& mesh, Frame frame, Rows rows) {
  size_t bytes;
  lay_out(mesh, frame, rows, nullptr, bytes);
  return bytes;
}

double least(double a, double b) { return a < b ? a : b; }
double most(double a, double b) { return a > b ? a : b; }

// Prepares a face. Returns false if the face is not visible in the strip.
bool set_up(const Mesh& mesh, int64_t index, const Strip& s, Face& f) {
  const int32_t* corner = mesh.faces + 3 * index;
  const float *a = mesh.vertices + 3 * corner[0], *b = mesh.vertices + 3 * corner[1],
              *c = mesh.vertices + 3 * corner[2];
  // This test comes first, because most faces lie in other strips. A comparison with NaN is false.
  const double scale = static_cast<double>(s.frame.samples);
  const double first = static_cast<double>(s.rows.first) * scale, end = static_cast<double>(s.rows.end) * scale;
  const double y0 = a[1] * scale, y1 = b[1] * scale, y2 = c[1] * scale;
  const double y_low = least(least(y0, y1), y2), y_high = most(most(y0, y1), y2);
  if (!(y_low < end && y_high > first)) return false;
  const float* const corners[3] = {a, b, c};
  for (const float* v : corners)
    if (!(v[2] > kNear) || !__builtin_isfinite(v[0] + 0 * v[1] + 0 * v[2])) return false;
  const double x0 = a[0] * scale, x1 = b[0] * scale, x2 = c[0] * scale;
  const double area = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0);
  const double last_column = static_cast<double>(s.frame.width) * scale - 1;
  const double left = most(__builtin_ceil(least(least(x0, x1), x2) - 0.5), 0);
  const double right = least(__builtin_floor(most(most(x0, x1), x2) - 0.5), last_column);
  const double top = most(__builtin_ceil(y_low - 0.5), first), bottom = least(__builtin_floor(y_high - 0.5), end - 1);
  if (area == 0 || left > right || top > bottom) return false;
  const double near[3] = {1. / a[2], 1. / b[2], 1. / c[2]}, size = __builtin_fabs(area);
  f.x[0] = x0, f.x[1] = x1, f.x[2] = x2, f.y[0] = y0, f.y[1] = y1, f.y[2] = y2;
  for (int i = 0; i < 3; ++i) f.k[i] = near[i] / size;
  f.low = least(least(near[0], near[1]), near[2]), f.high = most(most(near[0], near[1]), near[2]);
  f.turn = area > 0 ? 1 : -1;
  f.index = static_cast<int32_t>(index);
  f.left = static_cast<int32_t>(left), f.right = static_cast<int32_t>(right);
  f.top = static_cast<int32_t>(top - first), f.bottom = static_cast<int32_t>(bottom - first);
  return true;
}

void clear_tile(const Strip& s, int64_t tile) {
  const int64_t width = kTile * s.frame.samples;
  for (int64_t line = 0; line < s.lines; ++line) {
    float* near = s.near + line * s.columns + tile * width;
    int32_t* face = s.face + line * s.columns + tile * width;
    for (int64_t i = 0; i < width; ++i) near[i] = -1, face[i] = -1;
  }
}

[[gnu::always_inline]] inline Doubles all(double a) { return Doubles{a, a, a, a, a, a, a, a}; }

[[gnu::always_inline]] inline Doubles select(Longs which, Doubles a, Doubles b) {
  return (Doubles)((which & (Longs)a) | (~which & (Longs)b));
}

void draw_face(const Strip& s, const Face& f, int32_t number) {
  const Doubles lanes = {0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5};
  const int64_t start = f.left / kLanes * kLanes;
  const Doubles left = all(f.left + 0.5), right = all(f.right + 0.5), low = all(f.low), high = all(f.high);
  const Doubles k0 = all(f.k[0]), k1 = all(f.k[1]), k2 = all(f.k[2]);
  const double first = static_cast<double>(s.rows.first * s.frame.samples) + 0.5;
  for (int64_t line = f.top; line <= f.bottom; ++line) {
    const double y = first + static_cast<double>(line);
    const Doubles dy0 = all((f.y[0] - y) * f.turn), dy1 = all((f.y[1] - y) * f.turn),
                  dy2 = all((f.y[2] - y) * f.turn);
    for (int64_t column = start; column <= f.right; column += kLanes) {
      const Doubles x = lanes + all(static_cast<double>(column));
      const Doubles dx0 = all(f.x[0]) - x, dx1 = all(f.x[1]) - x, dx2 = all(f.x[2]) - x;
      const Doubles e0 = dx1 * dy2 - dy1 * dx2, e1 = dx2 * dy0 - dy2 * dx0, e2 = dx0 * dy1 - dy0 * dx1;
      const Longs inside = (e0 >= 0) & (e1 >= 0) & (e2 >= 0) & (x >= left) & (x <= right);
      Doubles nearness = (e0 * k0 + e1 * k1) + e2 * k2;
      nearness = select(nearness > low, nearness, low);
      nearness = select(nearness < high, nearness, high);
      float* near_at = s.near + line * s.columns + column;
      int32_t* face_at = s.face + line * s.columns + column;
      Floats old_near;
      Ints old_face;
      __builtin_memcpy(&old_near, near_at, sizeof old_near);
      __builtin_memcpy(&old_face, face_at, sizeof old_face);
      // Rounding makes the depths equal where faces meet or coincide. Then the first face keeps the sample.
      const Floats own = __builtin_convertvector(nearness, Floats);
      const Ints better = __builtin_convertvector(inside, Ints) & (Ints)(own > old_near);
      const Ints new_near = (better & (Ints)own) | (~better & (Ints)old_near);
      const Ints new_face = (better & number) | (~better & old_face);
      __builtin_memcpy(near_at, &new_near, sizeof new_near);
      __builtin_memcpy(face_at, &new_face, sizeof new_face);
    }
  }
}

Strip rasterise(const Mesh& mesh, Frame frame, Rows rows, void* memory) {
  size_t bytes;
  Strip s = lay_out(mesh, frame, rows, static_cast<char*>(memory), bytes);
  for (int64_t i = 0; i < s.tiles; ++i) s.touched[i] = 0;
  const int64_t width = kTile * frame.samples;
  for (int64_t i = 0; i < mesh.num_faces; ++i) {
    Face& f = s.faces[s.num_faces];
    if (!set_up(mesh, i, s, f)) continue;
    for (int64_t tile = f.left / width; tile <= f.right / width; ++tile)
      if (!s.touched[tile]) s.touched[tile] = 1, clear_tile(s, tile);
    draw_face(s, f, s.num_faces++);
  }
  return s;
}

// Computes perspective-correct weights of the corners at a sample that the face covers. Returns 1/depth.
[[gnu::always_inline]] inline double weigh(const Face& f, double x, double y, double weights[3]) {
  double dx[3], dy[3];
  for (int i = 0; i < 3; ++i) dx[i] = f.x[i] - x, dy[i] = (f.y[i] - y) * f.turn;
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    weights[i] = (dx[j] * dy[k] - dy[j] * dx[k]) * f.k[i];
  }
  const double total = (weights[0] + weights[1]) + weights[2];
  if (total == 0) weights[0] = 1;  // all weights rounded to 0: a corner is far outside the image
  const double inverse = total == 0 ? 1 : 1 / total;
  for (int i = 0; i < 3; ++i) weights[i] *= inverse;
  return least(most(total, f.low), f.high);
}

}  // namespace
}  // namespace jaxfit
