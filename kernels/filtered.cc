// The filtered silhouette: the area of each pixel that the mesh covers, filtered by a Gaussian. This file is compiled
// once for each instruction set, as silhouette.cc is.
//
// The faces have two sides: the corners of a face turn from +x to +y, or the other way. N(x) is the number of faces of
// one side that contain the point x. The mean of N over a pixel is exact: each face adds its directed edges, edges between
// two faces of one side cancel, and only the edges that remain are walked through the pixels. An edge adds the area below
// itself to the pixels of each column, so that sums down the columns give the mean of N. The coverage of a pixel is the
// larger mean of the two sides, at most 1: a closed surface has equal means, a sheet has faces of one side only. Coverage
// is too large only where two outlines share a pixel.
//
// The error, coverage minus mask at the known pixels, is filtered as a whole, so that both have the same softness: the
// silhouette has the area of its mesh, whatever the width of the filter and of the part.
#include "compiled.h"
#include "vertex_rows.h"

namespace jaxfit {
namespace {

constexpr float kCovered = 0.9999f;  // from this mean of N on, a pixel is covered
constexpr float kRounding = 1e-5f;  // sums of N round by less, so a smaller error is none
constexpr int64_t kRowsPerColumn = 16;  // the Gauss-Newton block has at most this many rows per column of the image

// Taps of a Gaussian with the variance of the soft rasteriser's edge, whose profile is sigmoid(-x·|x| / s): 2·ln(2)·s.
struct Filter {
  double variance;
  int64_t radius;  // pixels

  explicit Filter(Blur blur)
      : variance(2 * 0.69314718055994530942 * blur.sigma),
        radius(static_cast<int64_t>(__builtin_ceil(3 * __builtin_sqrt(variance)))) {}

  void fill_taps(float* taps) const {
    double total = 0;
    for (int64_t k = -radius; k <= radius; ++k) total += __builtin_exp(-0.5 * static_cast<double>(k * k) / variance);
    for (int64_t k = -radius; k <= radius; ++k)
      taps[k + radius] =
          static_cast<float>(__builtin_exp(-0.5 * static_cast<double>(k * k) / variance) / total);
  }
};

// Images are planes with rows of `stride` floats: a margin of `radius` zeros, the pixels, and zeros up to the end. The
// blocks are those of kLanes pixels of a line.
struct Workspace {
  float* taps;
  float *front, *back;  // means of N of the two sides
  float *error, *other;
  uint8_t *marked, *reached;  // (size, blocks): where `error` and `other` are not 0
  int32_t* count;             // (blocks): marks in the lines within the radius
  int16_t *front_edges, *back_edges;  // for each edge how often it remains, with the sign of its direction
  int64_t radius, stride, plane, size, blocks;
  bool closed;  // the edges of both sides are the same, and so are the means
};

[[gnu::always_inline]] inline Workspace carve(const Mesh& mesh, Blur blur, int64_t size, void* memory, size_t* bytes = nullptr) {
  const Filter filter(blur);
  Workspace ws;
  ws.size = size, ws.radius = filter.radius;
  ws.blocks = round_up(size) / kLanes;
  ws.stride = round_up(size) + round_up(2 * ws.radius);
  ws.plane = ws.stride * (size + 1);
  float* p = static_cast<float*>(memory);
  ws.taps = p, p += round_up(2 * ws.radius + 1);
  float** const planes[] = {&ws.front, &ws.back, &ws.error, &ws.other};
  for (float** plane : planes) *plane = p, p += ws.plane;
  ws.count = reinterpret_cast<int32_t*>(p);
  ws.front_edges = reinterpret_cast<int16_t*>(ws.count + ws.blocks);
  ws.back_edges = ws.front_edges + mesh.edges.count;
  ws.marked = reinterpret_cast<uint8_t*>(ws.back_edges + mesh.edges.count);
  ws.reached = ws.marked + size * ws.blocks;
  if (bytes) {
    const char* end = reinterpret_cast<char*>(ws.reached + size * ws.blocks);
    *bytes = static_cast<size_t>((end - static_cast<char*>(memory) + 63) / 64 * 64);  // floats follow
  } else {
    filter.fill_taps(ws.taps);
  }
  return ws;
}

size_t workspace(const Mesh& mesh, Blur blur, int64_t size) {
  size_t bytes;
  carve(mesh, blur, size, nullptr, &bytes);
  return bytes;
}

// Finds the edges that remain of each side. Returns false if a coordinate is not finite.
bool find_edges(const Mesh& mesh, Workspace& ws) {
  float finite = 0;
  for (int64_t i = 0; i < 3 * mesh.num_vertices; ++i) finite += 0 * mesh.vertices[i];
  if (finite != 0) return false;
  for (int64_t e = 0; e < 2 * mesh.edges.count; ++e) ws.front_edges[e] = 0;
  const float half = 0.5f * static_cast<float>(ws.size), least = kMinArea * half * half;
  for (int64_t i = 0; i < mesh.num_faces; ++i) {
    const int32_t* corner = mesh.faces + 3 * i;
    const float *a = mesh.vertices + 3 * corner[0], *b = mesh.vertices + 3 * corner[1],
                *c = mesh.vertices + 3 * corner[2];
    if (!(a[2] > kMinDepth && b[2] > kMinDepth && c[2] > kMinDepth)) continue;
    const float ax = clamp_far(a[0]), ay = clamp_far(a[1]);
    const float area = (clamp_far(b[0]) - ax) * (clamp_far(c[1]) - ay) - (clamp_far(b[1]) - ay) * (clamp_far(c[0]) - ax);
    if (!(__builtin_fabsf(area) > least)) continue;
    int16_t* edges = area > 0 ? ws.front_edges : ws.back_edges;
    const int sign = area > 0 ? 1 : -1;
    for (int k = 0; k < 3; ++k) {
      const int32_t edge = mesh.edges.of_face[3 * i + k];
      edges[edge >> 1] = static_cast<int16_t>(edges[edge >> 1] + (edge & 1 ? -sign : sign));
    }
  }
  ws.closed = true;
  for (int64_t e = 0; e < mesh.edges.count; ++e) ws.closed &= ws.front_edges[e] == ws.back_edges[e];
  return true;
}

// An edge in the image, from a by (dx, dy).
struct Segment {
  float ax, ay, dx, dy;
};

// Calls visit(column, row, t0, t1) for each pixel that the segment crosses from the share t0 to t1 of its length. The
// columns -1 and `size`, and the rows likewise, hold everything outside the image.
template <typename Visit>
[[gnu::always_inline]] inline void walk(Segment s, int64_t size, Visit visit) {
  const float last = static_cast<float>(size), never = 2.f;
  const auto cell = [&](float a, float d) {
    const float low = __builtin_floorf(a < -1 ? -1 : a > last ? last : a);
    return static_cast<int64_t>(d < 0 && low == a ? low - 1 : low);
  };
  const auto next = [&](int64_t i, float a, float d, float inverse) {
    if (d > 0) return i >= size ? never : (static_cast<float>(i + 1) - a) * inverse;
    return i < 0 ? never : (static_cast<float>(i) - a) * inverse;
  };
  int64_t column = cell(s.ax, s.dx), row = cell(s.ay, s.dy);
  if (column < -1) column = -1;
  if (row < -1) row = -1;
  const float by_x = s.dx == 0 ? 0 : 1 / s.dx, by_y = s.dy == 0 ? 0 : 1 / s.dy;
  const int64_t right = s.dx > 0 ? 1 : -1, down = s.dy > 0 ? 1 : -1;
  float tx = s.dx == 0 ? never : next(column, s.ax, s.dx, by_x);
  float ty = s.dy == 0 ? never : next(row, s.ay, s.dy, by_y);
  for (float t = 0; t < 1;) {
    const float to = tx < ty ? tx : ty, end = to < t ? t : to < 1 ? to : 1;
    visit(column, row, t, end);
    t = end;
    if (!(to < 1)) break;
    if (tx < ty) column += right, tx = next(column, s.ax, s.dx, by_x);
    else row += down, ty = next(row, s.ay, s.dy, by_y);
  }
}

[[gnu::always_inline]] inline Segment segment_of(const Mesh& mesh, int64_t edge) {
  const float* a = mesh.vertices + 3 * mesh.edges.ends[2 * edge];
  const float* b = mesh.vertices + 3 * mesh.edges.ends[2 * edge + 1];
  const float ax = clamp_far(a[0]), ay = clamp_far(a[1]);
  return {ax, ay, clamp_far(b[0]) - ax, clamp_far(b[1]) - ay};
}

[[gnu::always_inline]] inline float* at(float* plane, const Workspace& ws, int64_t row) { return plane + row * ws.stride + ws.radius; }

// Computes `front` and `back`. Returns false if a coordinate is not finite.
bool render(const Mesh& mesh, Workspace& ws) {
  if (!find_edges(mesh, ws)) return false;
  const int64_t size = ws.size;
  fill(ws.front, ws.closed ? ws.plane : 2 * ws.plane, 0);
  for (int64_t e = 0; e < mesh.edges.count; ++e) {
    const float front = ws.front_edges[e], back = ws.back_edges[e];
    if (front == 0 && back == 0) continue;
    const Segment s = segment_of(mesh, e);
    walk(s, size, [&](int64_t column, int64_t row, float t0, float t1) __attribute__((always_inline)) {
      if (column < 0 || column >= size || row >= size) return;
      const float width = s.dx * (t1 - t0);
      const float above = s.ay + s.dy * 0.5f * (t0 + t1) - static_cast<float>(row);
      const float lower = row < 0 || above > 1 ? 1 : above < 0 ? 0 : above;  // share of the strip in the rows below
      const int64_t own = (row < 0 ? -1 : row) * ws.stride + ws.radius + column;
      if (row >= 0) ws.front[own] += front * width * (1 - lower);
      ws.front[own + ws.stride] += front * width * lower;
      if (ws.closed) return;
      if (row >= 0) ws.back[own] += back * width * (1 - lower);
      ws.back[own + ws.stride] += back * width * lower;
    });
  }
  for (int64_t i = ws.stride; i < size * ws.stride; ++i) ws.front[i] += ws.front[i - ws.stride];
  for (int64_t i = ws.stride; i < size * ws.stride && !ws.closed; ++i) ws.back[i] += ws.back[i - ws.stride];
  return true;
}

[[gnu::always_inline]] inline float coverage_at(const Workspace& ws, int64_t i) {
  const float front = ws.front[i], back = ws.closed ? front : ws.back[i];
  const float most = front > back ? front : back;
  return most < kCovered ? most : 1;
}

// Clears the rest of each line of `error`, and marks its blocks that are not 0.
void mark(Workspace& ws) {
  for (int64_t y = 0; y < ws.size; ++y) {
    float* line = at(ws.error, ws, y);
    fill(line + ws.size, ws.blocks * kLanes - ws.size, 0);
    for (int64_t b = 0; b < ws.blocks; ++b) {
      uint32_t any = 0;
      for (int i = 0; i < kLanes; i += kWidth) any |= bits(greater(abs(load(line + b * kLanes + i)), all(kRounding)));
      ws.marked[y * ws.blocks + b] = any != 0;
    }
  }
}

// Filters `error` in place at the marked blocks, and marks the blocks of the result; `other` is overwritten. The filter is
// its own transpose.
void filter(Workspace& ws) {
  const int64_t size = ws.size, blocks = ws.blocks, r = ws.radius, reach = (r + kLanes - 1) / kLanes;
  const auto add_marks = [&](int64_t y, int32_t times) {
    for (int64_t b = 0; b < blocks && y >= 0 && y < size; ++b) ws.count[b] += times * ws.marked[y * blocks + b];
  };
  for (int64_t b = 0; b < blocks; ++b) ws.count[b] = 0;
  for (int64_t y = 0; y < r; ++y) add_marks(y, 1);
  for (int64_t y = 0; y < size; ++y) {
    add_marks(y + r, 1);
    add_marks(y - r - 1, -1);
    const int64_t first = y < r ? -y : -r, last = size - 1 - y < r ? size - 1 - y : r;
    for (int64_t b = 0; b < blocks; ++b) {
      ws.reached[y * blocks + b] = ws.count[b] > 0;
      for (int64_t x = b * kLanes; x < (b + 1) * kLanes; x += kWidth) {
        Vec sum = all(0.f);
        for (int64_t k = first; ws.count[b] > 0 && k <= last; ++k)
          sum = fma(all(ws.taps[k + r]), load(at(ws.error, ws, y + k) + x), sum);
        store(at(ws.other, ws, y) + x, sum);
      }
    }
  }
  for (int64_t y = 0; y < size; ++y) {
    float* from = ws.other + y * ws.stride;
    fill(from, r, 0);
    fill(from + r + size, ws.stride - r - size, 0);
    float* to = at(ws.error, ws, y);
    for (int64_t b = 0; b < blocks; ++b) {
      bool near = false;
      for (int64_t n = b < reach ? 0 : b - reach; n <= b + reach && n < blocks; ++n) near |= ws.reached[y * blocks + n];
      ws.marked[y * blocks + b] = near;
      for (int64_t x = b * kLanes; x < (b + 1) * kLanes; x += kWidth) {
        Vec sum = all(0.f);
        for (int64_t k = 0; near && k <= 2 * r; ++k) sum = fma(all(ws.taps[k]), load(from + x + k), sum);
        store(to + x, sum);
      }
    }
    fill(to + size, blocks * kLanes - size, 0);
  }
}

// Adds the derivatives of Σ error · coverage, over the pixels that are known.
void add_gradient(const Mesh& mesh, const Workspace& ws, const uint8_t* target, float* gradient) {
  const int64_t size = ws.size;
  for (int64_t e = 0; e < mesh.edges.count; ++e) {
    const float front = ws.front_edges[e], back = ws.back_edges[e];
    if (front == 0 && back == 0) continue;
    const Segment s = segment_of(mesh, e);
    float to_a = 0, to_b = 0;
    walk(s, size, [&](int64_t column, int64_t row, float t0, float t1) __attribute__((always_inline)) {
      if (column < 0 || column >= size || row < 0 || row >= size) return;
      const int64_t i = row * ws.stride + ws.radius + column;
      const float of_front = ws.front[i], of_back = ws.closed ? of_front : ws.back[i];
      const bool in_front = of_front >= of_back;
      if (!((in_front ? of_front : of_back) < kCovered) || (target && target[row * size + column] == kUnknown)) return;
      const float factor = (in_front ? front : back) * ws.error[i] * (t1 - t0);
      const float middle = 0.5f * (t0 + t1);
      to_a += factor * (1 - middle);
      to_b += factor * middle;
    });
    float* a = gradient + 3 * mesh.edges.ends[2 * e];
    float* b = gradient + 3 * mesh.edges.ends[2 * e + 1];
    a[0] += s.dy * to_a, a[1] -= s.dx * to_a;
    b[0] += s.dy * to_b, b[1] -= s.dx * to_b;
  }
  clear_far_gradient(mesh, gradient);
}

void silhouette(const Mesh& mesh, Blur blur, int64_t size, void* memory, float* image) {
  Workspace ws = carve(mesh, blur, size, memory);
  if (!render(mesh, ws)) return fill(image, size * size, __builtin_nanf(""));
  for (int64_t y = 0; y < size; ++y)
    for (int64_t x = 0; x < size; ++x) at(ws.error, ws, y)[x] = coverage_at(ws, y * ws.stride + ws.radius + x);
  mark(ws);
  filter(ws);
  for (int64_t y = 0; y < size; ++y)
    for (int64_t x = 0; x < size; ++x) image[y * size + x] = at(ws.error, ws, y)[x];
}

void silhouette_gradient(const Mesh& mesh, Blur blur, int64_t size, void* memory, const float* cotangent,
                         float* gradient) {
  Workspace ws = carve(mesh, blur, size, memory);
  if (!render(mesh, ws)) return set_gradient(gradient, mesh.num_vertices, __builtin_nanf(""));
  for (int64_t y = 0; y < size; ++y)
    for (int64_t x = 0; x < size; ++x) at(ws.error, ws, y)[x] = cotangent[y * size + x];
  mark(ws);
  filter(ws);
  set_gradient(gradient, mesh.num_vertices, 0);
  add_gradient(mesh, ws, nullptr, gradient);
}

// Rows d coverage / d parameters of the pixels at the outline, in the order of the pixels.
struct Rows {
  float *values, *filtered;  // (limit, D); `filtered` has the rows of FᵀF · values, with the filter F
  int32_t* of_pixel;         // (size, size): the row of a pixel, -1 without one
  int32_t *pixel, *order;    // (limit): the pixel of each row; the rows in the order of the pixels
  int32_t *line, *column;    // (size + 1): the first place in `order` of each line; (limit): the column of each place
  int32_t* first;            // (size): the first place of each line that is near
  float* overlap;            // (size, 4·radius + 1): entries of FᵀF along one axis
  int32_t* near;             // (limit): the rows whose pixels are near that of one row, with their entries of FᵀF
  float* weights;
  VertexRows of_vertex;
  int64_t count, limit;
};

[[gnu::always_inline]] inline Rows carve_rows(const Mesh& mesh, const Skin& skin, const Workspace& ws, void* memory, size_t before,
                       size_t* bytes = nullptr) {
  const int64_t size = ws.size, D = skin.parameters;
  Rows rows;
  rows.limit = kRowsPerColumn * size, rows.count = 0;
  float* p = reinterpret_cast<float*>(static_cast<char*>(memory) + before);
  rows.values = p, p += rows.limit * D;
  rows.filtered = p, p += rows.limit * D;
  rows.of_vertex.values = p, p += 2 * mesh.num_vertices * D;
  rows.overlap = p, p += size * (4 * ws.radius + 1);
  rows.weights = p, p += rows.limit;
  int32_t* q = reinterpret_cast<int32_t*>(p);
  rows.of_pixel = q, q += size * size;
  rows.pixel = q, q += rows.limit;
  rows.order = q, q += rows.limit;
  rows.near = q, q += rows.limit;
  rows.column = q, q += rows.limit;
  rows.line = q, q += size + 1;
  rows.first = q, q += size;
  rows.of_vertex.ready = reinterpret_cast<uint8_t*>(q);
  if (bytes) *bytes = reinterpret_cast<char*>(q) - static_cast<char*>(memory) + mesh.num_vertices;
  return rows;
}

size_t block_workspace(const Mesh& mesh, const Skin& skin, Blur blur, int64_t size) {
  size_t before, bytes;
  const Workspace ws = carve(mesh, blur, size, nullptr, &before);
  carve_rows(mesh, skin, ws, nullptr, before, &bytes);
  return bytes;
}

// Fills the rows of the known pixels at the outline. Pixels beyond the limit have no row.
void fill_rows(const Mesh& mesh, const Skin& skin, const Workspace& ws, const uint8_t* target, Rows& rows) {
  const int64_t size = ws.size, D = skin.parameters;
  for (int64_t i = 0; i < size * size; ++i) rows.of_pixel[i] = -1;
  for (int64_t i = 0; i < mesh.num_vertices; ++i) rows.of_vertex.ready[i] = 0;
  for (int64_t e = 0; e < mesh.edges.count; ++e) {
    const float front = ws.front_edges[e], back = ws.back_edges[e];
    if (front == 0 && back == 0) continue;
    const Segment s = segment_of(mesh, e);
    const float* a = nullptr;
    const float* b = nullptr;
    walk(s, size, [&](int64_t column, int64_t row, float t0, float t1) __attribute__((always_inline)) {
      if (column < 0 || column >= size || row < 0 || row >= size) return;
      const int64_t i = row * ws.stride + ws.radius + column, pixel = row * size + column;
      const float of_front = ws.front[i], of_back = ws.closed ? of_front : ws.back[i];
      const bool in_front = of_front >= of_back;
      const float turns = in_front ? front : back;
      if (turns == 0 || !((in_front ? of_front : of_back) < kCovered) || target[pixel] == kUnknown) return;
      if (rows.of_pixel[pixel] < 0) {
        if (rows.count == rows.limit) return;
        rows.pixel[rows.count] = static_cast<int32_t>(pixel);
        fill(rows.values + rows.count * D, D, 0);
        rows.of_pixel[pixel] = static_cast<int32_t>(rows.count++);
      }
      if (!a) {
        a = vertex_rows(mesh, skin, mesh.edges.ends[2 * e], rows.of_vertex);
        b = vertex_rows(mesh, skin, mesh.edges.ends[2 * e + 1], rows.of_vertex);
      }
      const float share = turns * (t1 - t0), middle = 0.5f * (t0 + t1);
      const float x = share * s.dy, y = -share * s.dx;
      add_vertices(a, b, (1 - middle) * x, (1 - middle) * y, middle * x, middle * y, D,
                   rows.values + rows.of_pixel[pixel] * D);
    });
  }
}

// Puts the rows into the order of their pixels: by lines, then by insertion within each line, which has few.
void sort_rows(int64_t size, Rows& rows) {
  for (int64_t y = 0; y <= size; ++y) rows.line[y] = 0;
  for (int64_t row = 0; row < rows.count; ++row) ++rows.line[rows.pixel[row] / size + 1];
  int32_t before = 0;
  for (int64_t y = 1; y <= size; ++y) {
    const int32_t own = rows.line[y];
    rows.line[y] = before, before += own;
  }
  for (int64_t row = 0; row < rows.count; ++row)
    rows.order[rows.line[rows.pixel[row] / size + 1]++] = static_cast<int32_t>(row);
  for (int64_t y = 0; y < size; ++y)
    for (int32_t n = rows.line[y] + 1; n < rows.line[y + 1]; ++n) {
      const int32_t row = rows.order[n];
      int32_t place = n;
      for (; place > rows.line[y] && rows.pixel[rows.order[place - 1]] > rows.pixel[row]; --place)
        rows.order[place] = rows.order[place - 1];
      rows.order[place] = row;
    }
}

// to = Σ weights[n] · rows[near[n]], n registers of each row.
template <int n>
[[gnu::always_inline]] inline void add_weighted(const float* rows, const int32_t* near, const float* weights,
                                                int64_t count, int64_t D, float* to) {
  Vec sums[n];
  for (int c = 0; c < n; ++c) sums[c] = all(0.f);
  for (int64_t i = 0; i < count; ++i) {
    const float* from = rows + near[i] * D;
    for (int c = 0; c < n; ++c) sums[c] = fma(all(weights[i]), load(from + c * kWidth), sums[c]);
  }
  for (int c = 0; c < n; ++c) store(to + c * kWidth, sums[c]);
}

// Fills `overlap`: the entries of FᵀF along one axis, of a pixel and each pixel within twice the radius.
void fill_overlap(const Workspace& ws, Rows& rows) {
  const int64_t size = ws.size, r = ws.radius, reach = 2 * r, width = 2 * reach + 1;
  for (int64_t u = 0; u < size; ++u)
    for (int64_t k = -reach; k <= reach; ++k) {
      float* to = rows.overlap + u * width + reach + k;
      *to = 0;
      if (u > reach && u + reach < size) {  // far from both ends, as at the pixel before
        *to = to[-width];
        continue;
      }
      for (int64_t v = (k < 0 ? u : u + k) - r; v <= (k < 0 ? u + k : u) + r; ++v)
        if (v >= 0 && v < size) *to += ws.taps[v - u + r] * ws.taps[v - u - k + r];
    }
}

// Fills `filtered`. Only pairs of rows within twice the radius of the filter have an entry of FᵀF that is not 0.
void filter_rows(const Workspace& ws, int64_t D, Rows& rows) {
  const int64_t size = ws.size, reach = 2 * ws.radius, width = 2 * reach + 1;
  fill_overlap(ws, rows);
  sort_rows(size, rows);
  for (int64_t y = 0; y < size; ++y)
    for (int32_t n = rows.line[y]; n < rows.line[y + 1]; ++n)
      rows.column[n] = static_cast<int32_t>(rows.pixel[rows.order[n]] - y * size);
  for (int64_t y = 0; y < size; ++y) {
    const int64_t top = y < reach ? 0 : y - reach, bottom = y + reach < size ? y + reach : size - 1;
    for (int64_t line = top; line <= bottom; ++line) rows.first[line] = rows.line[line];
    for (int32_t place = rows.line[y]; place < rows.line[y + 1]; ++place) {
      const int64_t x = rows.column[place];
      const float *down = rows.overlap + y * width + reach - y, *along = rows.overlap + x * width + reach - x;
      int64_t count = 0;
      for (int64_t line = top; line <= bottom; ++line) {
        int32_t& first = rows.first[line];  // the places of a line come in the order of x
        const int32_t end = rows.line[line + 1];
        while (first < end && rows.column[first] < x - reach) ++first;
        for (int32_t n = first; n < end && rows.column[n] <= x + reach; ++n) {
          rows.near[count] = rows.order[n];
          rows.weights[count++] = down[line] * along[rows.column[n]];
        }
      }
      float* to = rows.filtered + rows.order[place] * D;
      for (int64_t d = 0; d < D;) {
        const bool several = D - d >= kColumns * kWidth;
        if (several) add_weighted<kColumns>(rows.values + d, rows.near, rows.weights, count, D, to + d);
        else add_weighted<1>(rows.values + d, rows.near, rows.weights, count, D, to + d);
        d += several ? kColumns * kWidth : kWidth;
      }
    }
  }
}

void mask_loss(const Mesh& mesh, Blur blur, int64_t size, void* memory, Target target, LossKind kind, float* loss,
               float* gradient, const Skin* skin, float* block) {
  Workspace ws = carve(mesh, blur, size, memory);
  if (!render(mesh, ws)) {
    *loss = __builtin_nanf("");
    if (gradient) set_gradient(gradient, mesh.num_vertices, *loss);
    if (block) fill(block, skin->parameters * skin->parameters, *loss);
    return;
  }
  if (block) {
    Rows rows = carve_rows(mesh, *skin, ws, memory, workspace(mesh, blur, size));
    fill_rows(mesh, *skin, ws, target.bytes, rows);
    filter_rows(ws, skin->parameters, rows);
    multiply_rows(rows.values, rows.filtered, rows.count, skin->parameters, block);
  }
  for (int64_t y = 0; y < size; ++y) {
    float* error = at(ws.error, ws, y);
    const int64_t line = y * ws.stride + ws.radius;
    for (int64_t x = 0; x < size; ++x) error[x] = coverage_at(ws, line + x);
    if (target.bytes) {
      const uint8_t* own = target.bytes + y * size;
      for (int64_t x = 0; x < size; ++x)
        error[x] = own[x] == kUnknown ? 0.f : error[x] - (own[x] == kBackground ? 0.f : 1.f);
    } else {
      for (int64_t x = 0; x < size; ++x) error[x] -= target.floats[y * size + x];
    }
  }
  mark(ws);
  filter(ws);
  double total = 0;
  const Vec zero = all(0.f), half = all(0.5f), one = all(1.f);
  for (int64_t y = 0; y < size; ++y) {
    Vec of_line = zero;
    for (int64_t b = 0; b < ws.blocks; ++b) {
      if (!ws.marked[y * ws.blocks + b]) continue;
      for (int i = 0; i < kLanes; i += kWidth) {
        float* place = at(ws.error, ws, y) + b * kLanes + i;
        const Vec error = load(place), magnitude = abs(error);
        if (kind == LossKind::kL1) {
          of_line = of_line + magnitude;
          store(place, flip_sign(keep(greater(magnitude, zero), one), error));
        } else {
          of_line = of_line + select(greater(magnitude, one), magnitude - half, half * error * error);
          store(place, clamp_to(error, one));
        }
      }
    }
    total += sum(of_line);
  }
  *loss = static_cast<float>(total);
  if (!gradient) return;
  filter(ws);
  set_gradient(gradient, mesh.num_vertices, 0);
  add_gradient(mesh, ws, target.bytes, gradient);
}

}  // namespace

template <>
const Kernels Compiled<kIsa>::unbiased = {
    workspace, silhouette, silhouette_gradient, mask_loss, block_workspace};

}  // namespace jaxfit
