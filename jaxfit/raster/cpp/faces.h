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
  float height[kLanes];                              // distance of vertex 0 from edge 12
  float reach[3][kLanes];                            // minus (blur radius + half the extent of a block across the edge)
  int32_t left[kLanes], right[kLanes], top[kLanes], bottom[kLanes];  // the blocks around the face, inclusive
  int32_t vertex[3][kLanes];
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

INLINE Workspace carve(const Mesh& mesh, int64_t size, void* memory) {
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

INLINE void close(const Workspace& ws, int64_t column, int64_t row) {
  ws.open[row * ws.row_bytes + column / 8] &= ~(1u << column % 8);
}

struct Scale {
  float k;       // scaled units per pixel
  float radius;  // in scaled units
  float size;    // px
  float slope;   // -∂(p's exponent) / ∂(scaled distance), the constant factor of the gradient in px
};

INLINE Scale scale_of(Blur blur, int64_t size) {
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
INLINE int64_t stride_of(int64_t n) {
  int64_t stride = static_cast<int64_t>(static_cast<double>(n) * 0.6180339887498949);
  for (;; ++stride) {
    int64_t a = n, b = stride;
    while (b) { const int64_t r = a % b; a = b, b = r; }
    if (a == 1) return stride;
  }
}

INLINE Vec clamp(Vec a, float low, float high) { return min(max(a, all(low)), all(high)); }

INLINE void set_up_chunk(Faces& f, const Workspace& ws, Scale scale) {
  alignas(64) float gathered[6][kLanes];
  for (int i = 0; i < kLanes; ++i)
    for (int v = 0; v < 3; ++v) {
      gathered[2 * v][i] = ws.x[f.vertex[v][i]];
      gathered[2 * v + 1][i] = ws.y[f.vertex[v][i]];
    }
  const Vec x0 = load(gathered[0]), y0 = load(gathered[1]);
  Vec x1 = load(gathered[2]) - x0, y1 = load(gathered[3]) - y0;
  Vec x2 = load(gathered[4]) - x0, y2 = load(gathered[5]) - y0;
  Vec area = x1 * y2 - x2 * y1;

  const Mask turned = all(0.f) > area;
  const uint32_t swap = bits(turned);
  for (int i = 0; i < kLanes; ++i)
    if (swap >> i & 1) {
      const int32_t v = f.vertex[1][i];
      f.vertex[1][i] = f.vertex[2][i], f.vertex[2][i] = v;
    }
  const Vec x1_old = x1, y1_old = y1;
  x1 = select(turned, x2, x1), y1 = select(turned, y2, y1);
  x2 = select(turned, x1_old, x2), y2 = select(turned, y1_old, y2);
  const Vec px_x[2] = {x1, x2}, px_y[2] = {y1, y2};
  // The area is exactly 0 where two corners are equal, if the compiler does not fuse these products.
  const Mask seen = abs(area) > all(kMinArea * 0.25f * scale.size * scale.size);
  const Vec k = all(scale.k);
  x1 = x1 * k, y1 = y1 * k, x2 = x2 * k, y2 = y2 * k, area = abs(area) * k * k;

  store(f.x0, x0), store(f.y0, y0);
  const Vec ax[3] = {all(0.f), x1, x2}, ay[3] = {all(0.f), y1, y2};
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3;
    const Vec ex = ax[j] - ax[i], ey = ay[j] - ay[i];
    const Vec length = max(sqrt(fma(ex, ex, ey * ey)), all(kShortest));
    const Vec inverse = all(1.f) / length;
    const Vec tx = ex * inverse, ty = ey * inverse;
    store(f.tx[i], tx), store(f.ty[i], ty);
    store(f.half[i], length * all(0.5f));
    store(f.shift[i], all(-0.5f) * fma(tx, ax[i] + ax[j], ty * (ay[i] + ay[j])));
    store(f.reach[i], all(-scale.radius) - (abs(tx) + abs(ty)) * all(1.5f * scale.k));
    if (i == 1) store(f.height, area * inverse);
  }

  // The centre of pixel i is at i + 1/2.
  const Vec margin = all(scale.radius / scale.k);
  const Vec shift_low = margin + all(0.5f), shift_high = margin - all(0.5f);
  const Vec zero = all(0.f);
  const Vec low_x = x0 + min(zero, min(px_x[0], px_x[1])) - shift_low;
  const Vec low_y = y0 + min(zero, min(px_y[0], px_y[1])) - shift_low;
  const Vec high_x = x0 + max(zero, max(px_x[0], px_x[1])) + shift_high;
  const Vec high_y = y0 + max(zero, max(px_y[0], px_y[1])) + shift_high;
  const Vec last = all(scale.size - 1);
  const Mask visible = seen &
                       (low_x <= last) & (low_y <= last) & (zero <= high_x) & (zero <= high_y);
  f.visible &= bits(visible);

  alignas(64) float range[4][kLanes];
  store(range[0], clamp(low_x, 0, scale.size - 1) * all(1.f / kBlock));
  store(range[1], clamp(high_x, 0, scale.size - 1) * all(1.f / kBlock));
  store(range[2], clamp(low_y, 0, scale.size - 1) * all(1.f / kBlock));
  store(range[3], clamp(high_y, 0, scale.size - 1) * all(1.f / kBlock));
  for (int i = 0; i < kLanes; ++i) {
    f.left[i] = static_cast<int32_t>(range[0][i]), f.right[i] = static_cast<int32_t>(range[1][i]);
    f.top[i] = static_cast<int32_t>(range[2][i]), f.bottom[i] = static_cast<int32_t>(range[3][i]);
  }
}

void set_up_faces(const Mesh& mesh, Scale scale, Workspace& ws) {
  const int64_t n = mesh.num_faces, stride = n ? stride_of(n) : 0;
  int64_t face = 0;
  for (int64_t c = 0; c < ws.num_chunks; ++c) {
    Faces& f = ws.faces[c];
    const int64_t rest = n - c * kLanes;
    f.visible = rest >= kLanes ? 0xFFFFu : (1u << rest) - 1;
    for (int i = 0; i < kLanes; ++i) {
      int64_t id = face;
      for (int v = 0; v < 3; ++v) f.vertex[v][i] = mesh.faces[3 * id + v];
      face += stride;
      if (face >= n) face -= n;
    }
    set_up_chunk(f, ws, scale);
  }
}

}  // namespace
}  // namespace jaxfit
