// The scratch memory of one image, and its faces, prepared sixteen at a time. Part of silhouette.cc.
#pragma once

#include "vertices.h"

namespace jaxfit {
namespace {

constexpr int kBlock = 4;  // pixels along a side; a block has one pixel for each of the sixteen lanes
constexpr float kSaturated = 1e5f;   // from this product on, the silhouette is within 1e-5 of 1
constexpr float kNegligible = 6.3f;   // scaled distance from which p is below 2^-39
constexpr float kShortest = 1e-12f;  // least length of an edge; shorter lengths are raised to this

// Sixteen faces. Lengths are scaled by k. The order of the vertices makes the area positive.
struct Faces {
  float x0[kLanes], y0[kLanes];                      // first vertex, in px, and origin of the other quantities
  float tx[3][kLanes], ty[3][kLanes];                // unit tangents of the edges 01, 12, 20
  float shift[3][kLanes], half[3][kLanes];           // minus the middle's place along the tangent; half the length
  float inverse[3][kLanes];                          // 1 / length
  float height[kLanes];                              // distance of vertex 0 from edge 12
  float reach[3][kLanes];                            // minus (blur radius + half the extent of a block across the edge)
  int32_t left[kLanes], right[kLanes], top[kLanes], bottom[kLanes];  // the blocks around the face, inclusive
  int32_t vertex[3][kLanes];
  uint32_t near[kLanes];                             // the blocks that a face with one window reaches, as bits: blocks.h
  uint32_t visible;
  uint32_t pad[15];
};

struct Workspace {
  float* x;         // vertex coordinates in px; x is NaN behind the camera
  float* y;
  float* products;  // Π (1 + e) for each block and pixel; later the factor of p in the gradient
  uint8_t* open;    // one bit per block, set while the block is evaluated; rows of `row_bytes`
  Faces* faces;
  int64_t blocks, row_bytes;  // number of blocks along a side; bytes of a row in `open`
  int64_t num_chunks;
};

struct Layout {
  int64_t blocks, row_bytes, vertices, products, open, chunks;  // the last four in floats
  explicit Layout(const Mesh& mesh, int64_t size)
      : blocks((size + kBlock - 1) / kBlock),
        row_bytes((blocks + 7) / 8 + 4),  // a row is read four bytes at a time, so it has four bytes more
        vertices(round_up(mesh.num_vertices)),
        products(blocks * blocks * kLanes),
        open(round_up((blocks * row_bytes + 3) / 4)),
        chunks(round_up(mesh.num_faces) / kLanes) {}
};

size_t workspace(const Mesh& mesh, Blur, int64_t size) {
  const Layout l(mesh, size);
  return sizeof(float) * (2 * l.vertices + l.products + l.open) + sizeof(Faces) * l.chunks;
}

[[gnu::always_inline]] inline Workspace carve(const Mesh& mesh, int64_t size, void* memory) {
  const Layout l(mesh, size);
  float* p = static_cast<float*>(memory);
  Workspace ws;
  ws.x = p, p += l.vertices;
  ws.y = p, p += l.vertices;
  ws.products = p, p += l.products;
  ws.open = reinterpret_cast<uint8_t*>(p), p += l.open;
  ws.faces = reinterpret_cast<Faces*>(p);
  ws.blocks = l.blocks, ws.row_bytes = l.row_bytes, ws.num_chunks = l.chunks;
  return ws;
}

[[gnu::always_inline]] inline void close(const Workspace& ws, int64_t column, int64_t row) {
  ws.open[row * ws.row_bytes + column / 8] &= ~(1u << column % 8);
}

struct Scale {
  float k;       // scaled units per pixel
  float radius;  // in scaled units
  float size;    // px
  float slope;   // -∂(p's exponent) / ∂(scaled distance), the constant factor of the gradient in px
};

[[gnu::always_inline]] inline Scale scale_of(Blur blur, int64_t size) {
  const float k = __builtin_sqrtf(1.44269504088896340736f / blur.sigma);
  const float radius = blur.radius * k;
  return {k, radius < kNegligible ? radius : kNegligible, static_cast<float>(size), 2.f / (blur.sigma * k)};
}

// Copies the vertices. Returns false if any coordinate is not finite.
bool load_vertices(const Mesh& mesh, Workspace& ws) {
  float zero = 0;  // stays 0 only while every coordinate is finite
  for (int64_t i = 0; i < mesh.num_vertices; ++i) {
    const float* v = mesh.vertices + 3 * i;
    zero += 0 * v[0] + 0 * v[1] + 0 * v[2];
    const float x = clamp_far(v[0]), y = clamp_far(v[1]);
    ws.x[i] = v[2] > kMinDepth ? x : __builtin_nanf("");
    ws.y[i] = y;
  }
  return zero == 0;
}

// Returns the stride of the order of the faces. It puts neighbouring faces far apart, so that every block soon meets a
// face that covers it.
[[gnu::always_inline]] inline int64_t stride_of(int64_t n) {
  int64_t stride = static_cast<int64_t>(static_cast<double>(n) * 0.6180339887498949);
  for (;; ++stride) {
    int64_t a = n, b = stride;
    while (b) { const int64_t r = a % b; a = b, b = r; }
    if (a == 1) return stride;
  }
}

// Prepares the faces from `at` on that fill a register; `gathered` holds x and y of their three corners.
[[gnu::always_inline]] inline void set_up_part(Faces& f, int at, const float gathered[6][kLanes], Scale scale) {
  const Vec x0 = load(gathered[0] + at), y0 = load(gathered[1] + at);
  const Vec to_x[2] = {load(gathered[2] + at) - x0, load(gathered[4] + at) - x0};
  const Vec to_y[2] = {load(gathered[3] + at) - y0, load(gathered[5] + at) - y0};
  const Vec area = to_x[0] * to_y[1] - to_x[1] * to_y[0];

  const Mask turned = greater(all(0.f), area);
  for (uint32_t todo = bits(turned); todo; todo &= todo - 1) {
    const int i = at + __builtin_ctz(todo);
    const int32_t v = f.vertex[1][i];
    f.vertex[1][i] = f.vertex[2][i];
    f.vertex[2][i] = v;
  }
  // The area is exactly 0 where two corners are equal, if the compiler does not fuse these products.
  const Mask seen = greater(abs(area), all(kMinArea * 0.25f * scale.size * scale.size));
  const Vec k = all(scale.k), zero = all(0.f);
  const Vec x1 = select(turned, to_x[1], to_x[0]) * k, x2 = select(turned, to_x[0], to_x[1]) * k;
  const Vec y1 = select(turned, to_y[1], to_y[0]) * k, y2 = select(turned, to_y[0], to_y[1]) * k;
  const Vec ax[3] = {zero, x1, x2}, ay[3] = {zero, y1, y2};
  store(f.x0 + at, x0);
  store(f.y0 + at, y0);
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3;
    const Vec ex = ax[j] - ax[i], ey = ay[j] - ay[i];
    const Vec length = max(sqrt(fma(ex, ex, ey * ey)), all(kShortest));
    const Vec inverse = all(1.f) / length;
    const Vec tx = ex * inverse, ty = ey * inverse;
    store(f.tx[i] + at, tx);
    store(f.ty[i] + at, ty);
    store(f.half[i] + at, length * all(0.5f));
    store(f.inverse[i] + at, inverse);
    store(f.shift[i] + at, all(-0.5f) * fma(tx, ax[i] + ax[j], ty * (ay[i] + ay[j])));
    store(f.reach[i] + at, all(-scale.radius) - (abs(tx) + abs(ty)) * all(1.5f * scale.k));
    if (i == 1) store(f.height + at, abs(area) * k * k * inverse);
  }

  // The centre of pixel i is at i + 1/2.
  const Vec margin = all(scale.radius / scale.k), last = all(scale.size - 1);
  const Vec shift_low = margin + all(0.5f), shift_high = margin - all(0.5f);
  const Vec low_x = x0 + min(zero, min(to_x[0], to_x[1])) - shift_low;
  const Vec low_y = y0 + min(zero, min(to_y[0], to_y[1])) - shift_low;
  const Vec high_x = x0 + max(zero, max(to_x[0], to_x[1])) + shift_high;
  const Vec high_y = y0 + max(zero, max(to_y[0], to_y[1])) + shift_high;
  const Mask inside = at_most(low_x, last) & at_most(low_y, last) & at_most(zero, high_x) & at_most(zero, high_y);
  f.visible |= bits(seen & inside) << at;

  const Vec range[4] = {low_x, high_x, low_y, high_y};
  int32_t* blocks[4] = {f.left, f.right, f.top, f.bottom};
  for (int i = 0; i < 4; ++i) {
    alignas(64) float block[kWidth];
    store(block, min(max(range[i], zero), last) * all(1.f / kBlock));
    for (int n = 0; n < kWidth; ++n) blocks[i][at + n] = static_cast<int32_t>(block[n]);
  }
}

void set_up_faces(const Mesh& mesh, Scale scale, Workspace& ws) {
  const int64_t n = mesh.num_faces, stride = n ? stride_of(n) : 0;
  int64_t face = 0;
  for (int64_t c = 0; c < ws.num_chunks; ++c) {
    Faces& f = ws.faces[c];
    alignas(64) float gathered[6][kLanes];
    for (int i = 0; i < kLanes; ++i) {
      const int64_t id = face;
      for (int v = 0; v < 3; ++v) {
        const int32_t vertex = mesh.faces[3 * id + v];
        f.vertex[v][i] = vertex;
        gathered[2 * v][i] = ws.x[vertex];
        gathered[2 * v + 1][i] = ws.y[vertex];
      }
      face += stride;
      if (face >= n) face -= n;
    }
    f.visible = 0;
    for (int at = 0; at < kLanes; at += kWidth) set_up_part(f, at, gathered, scale);
    const int64_t rest = n - c * kLanes;
    if (rest < kLanes) f.visible &= (1u << rest) - 1;
  }
}

}  // namespace
}  // namespace jaxfit
