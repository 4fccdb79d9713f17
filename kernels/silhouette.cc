// The raster core, compiled once an instruction set (JAXFIT_AVX512, JAXFIT_AVX2, neither).
//
// For a pixel and a face, d is the squared distance to the nearest edge segment, negative inside, and
// silhouette = 1 - Π (1 - p) with p = sigmoid(-d / s). With e = exp(-d / s) this is 1 - 1 / Π (1 + e): no division a
// face. All lengths are scaled by k = √(log2(e) / s), so that e = 2^(-d).
//
// The image is cut into blocks of 4×4 pixels. For each face, one evaluation over sixteen block *centres* at a time, a
// window of the blocks around the face, says which of them it can reach; those are evaluated pixel by pixel. A block whose every product has passed kSaturated is done: no later face visits it, and it has no gradient,
// as d silhouette / d d = -Π (1 - p) · p / s vanishes there.
#include "silhouette.h"
#include "simd.h"

#if defined(JAXFIT_AVX512)
#define KERNELS kernels_avx512
#elif defined(JAXFIT_AVX2)
#define KERNELS kernels_avx2
#else
#define KERNELS kernels_baseline
#endif

namespace jaxfit {
namespace {

constexpr int kBlock = 4;  // pixels; a block fills a register's sixteen lanes
constexpr float kSaturated = 1e5f;   // a silhouette is 1 to within 1e-5 from here
constexpr float kFarAway = 1048576.f;  // px; coordinates are clamped to this, so that squares stay finite
constexpr float kMinDepth = 1e-8f;
constexpr float kMinArea = 1e-8f;    // of |2·area|, in units of half the image

// Sixteen faces, lengths scaled by k, vertices in the order that makes the area positive.
struct Faces {
  float x0[kLanes], y0[kLanes];                      // the first vertex: the origin of the rest
  float tx[3][kLanes], ty[3][kLanes];                // unit tangents of the edges 01, 12, 20
  float shift[3][kLanes], half[3][kLanes];           // minus the edge's middle along its tangent; half its length
  float height[kLanes];                              // distance of vertex 0 from edge 12
  float reach[3][kLanes];                            // blur radius plus a block's half-width across the edge
  int32_t left[kLanes], right[kLanes], top[kLanes], bottom[kLanes];  // the blocks around the face, inclusive
  int32_t vertex[3][kLanes];
  uint32_t visible;
  uint32_t pad[15];
};

struct Workspace {
  float* x;         // scaled vertex coordinates; NaN behind the camera
  float* y;
  float* products;  // Π (1 + e) by block and pixel; later the factor of p in the gradient
  uint8_t* open;    // a bit for each block that is still to be evaluated, rows of `row_bytes`
  Faces* faces;
  int64_t blocks, row_bytes;  // blocks along a side
  int64_t num_chunks;
};

INLINE int64_t round_up(int64_t n) { return (n + kLanes - 1) / kLanes * kLanes; }

struct Layout {
  int64_t blocks, row_bytes, vertices, products, open, chunks;  // the last four in floats
  explicit Layout(const Mesh& mesh, int64_t size)
      : blocks((size + kBlock - 1) / kBlock),
        row_bytes((blocks + 7) / 8 + 4),  // a row is read four bytes at a time
        vertices(round_up(mesh.num_vertices)),
        products(blocks * blocks * kLanes),
        open(round_up((blocks * row_bytes + 3) / 4)),
        chunks(round_up(mesh.num_faces) / kLanes) {}
};

size_t workspace(const Mesh& mesh, int64_t size) {
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
  float k;       // scaled units a pixel
  float radius;  // in scaled units
  float size;    // px
  float slope;   // -∂(p's exponent) / ∂(scaled distance), the constant factor of the gradient in px
};

INLINE Scale scale_of(Blur blur, int64_t size) {
  const float k = __builtin_sqrtf(1.44269504088896340736f / blur.sigma);
  return {k, blur.radius * k, static_cast<float>(size), 2.f / (blur.sigma * k)};
}

// False if any coordinate is not finite.
bool load_vertices(const Mesh& mesh, Scale scale, Workspace& ws) {
  float zero = 0;  // stays 0 only while every coordinate is finite
  for (int64_t i = 0; i < mesh.num_vertices; ++i) {
    const float* v = mesh.vertices + 3 * i;
    zero += 0 * v[0] + 0 * v[1] + 0 * v[2];
    const float x = v[0] < -kFarAway ? -kFarAway : v[0] > kFarAway ? kFarAway : v[0];
    const float y = v[1] < -kFarAway ? -kFarAway : v[1] > kFarAway ? kFarAway : v[1];
    ws.x[i] = v[2] > kMinDepth ? x * scale.k : __builtin_nanf("");
    ws.y[i] = y * scale.k;
  }
  return zero == 0;
}

// Neighbouring faces stand far apart in this order, so that every block soon has some that cover it.
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
  area = abs(area);

  store(f.x0, x0), store(f.y0, y0);
  const Vec ax[3] = {all(0.f), x1, x2}, ay[3] = {all(0.f), y1, y2};
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3;
    const Vec ex = ax[j] - ax[i], ey = ay[j] - ay[i];
    const Vec length = max(sqrt(fma(ex, ex, ey * ey)), all(1e-12f));
    const Vec inverse = all(1.f) / length;
    const Vec tx = ex * inverse, ty = ey * inverse;
    store(f.tx[i], tx), store(f.ty[i], ty);
    store(f.half[i], length * all(0.5f));
    store(f.shift[i], all(-0.5f) * fma(tx, ax[i] + ax[j], ty * (ay[i] + ay[j])));
    store(f.reach[i], all(-scale.radius) - (abs(tx) + abs(ty)) * all(1.5f * scale.k));
    if (i == 1) store(f.height, area * inverse);
  }

  // Pixel i has its centre at i + 1/2.
  const Vec to_px = all(1.f / scale.k);
  const Vec margin = all(scale.radius / scale.k);
  const Vec shift_low = margin + all(0.5f), shift_high = margin - all(0.5f);
  const Vec zero = all(0.f);
  const Vec low_x = (x0 + min(zero, min(x1, x2))) * to_px - shift_low;
  const Vec low_y = (y0 + min(zero, min(y1, y2))) * to_px - shift_low;
  const Vec high_x = (x0 + max(zero, max(x1, x2))) * to_px + shift_high;
  const Vec high_y = (y0 + max(zero, max(y1, y2))) * to_px + shift_high;
  const float half_size = 0.5f * scale.size * scale.k;
  const Vec last = all(scale.size - 1);
  const Mask visible = (area > all(kMinArea * half_size * half_size)) & (low_x <= last) & (low_y <= last) &
                       (zero <= high_x) & (zero <= high_y);
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

// Sixteen signed distances from one face: to the three edges' lines (`across`, positive inside) and, along each edge,
// from its middle (`along`).
struct Distances {
  Vec across[3], along[3];
};

// d itself: the smallest squared distance to an edge, negative inside. `clamped` and `beyond` split the position along
// each edge into the nearest point's and the rest.
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

// How the blocks of a window are numbered: row by row, for each width of a row from 1 to 16.
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

// Calls visit(signed distances of the block's pixels, place in `products`, column, row) for each open block in reach.
template <typename Visit>
INLINE void for_each_block(const Faces& f, int lane, Scale scale, const Workspace& ws, Visit visit) {
  const int32_t left = f.left[lane], right = f.right[lane], top = f.top[lane], bottom = f.bottom[lane];
  const float reach = scale.radius + 2.1213204f * scale.k;  // a block's centre to its corner pixels: 1.5·√2
  const float block_size = kBlock * scale.k;
  const Vec offset_x = (load(kWindows.column[4]) - all(1.5f)) * all(scale.k);
  const Vec offset_y = (load(kWindows.row[4]) - all(1.5f)) * all(scale.k);
  Vec tx[3], ty[3], half[3];
  Distances offset;
  for (int i = 0; i < 3; ++i) {
    tx[i] = all(f.tx[i][lane]), ty[i] = all(f.ty[i][lane]), half[i] = all(f.half[i][lane]);
    offset.across[i] = tx[i] * offset_y - ty[i] * offset_x;
    offset.along[i] = fma(tx[i], offset_x, ty[i] * offset_y);
  }

  for (int32_t first = left; first <= right; first += kLanes) {
    const int width = right - first < kLanes ? right - first + 1 : kLanes;
    const int height = kLanes / width;
    const float x0 = (static_cast<float>(first) + 0.5f) * block_size - f.x0[lane];
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
      const float y0 = (static_cast<float>(row) + 0.5f) * block_size - f.y0[lane];
      const Vec y = fma(load(kWindows.row[width]), all(block_size), all(y0));
      Distances centre;
      alignas(64) float across[3][kLanes], along[3][kLanes];
      for (int i = 0; i < 3; ++i) {
        centre.across[i] = tx[i] * y - ty[i] * x;
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

// Fills `products` and closes the blocks that saturate.
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

// Starts every product at 1; pixels that the last blocks have beyond the image count as full.
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

// Adds the gradient of every open block; `products` now holds, a pixel, the factor of p · (pixel - nearest point).
void accumulate_gradient(Scale scale, Workspace& ws, float* gradient) {
  const Vec outside = all(scale.radius * scale.radius);
  for (int64_t c = 0; c < ws.num_chunks; ++c) {
    const Faces& f = ws.faces[c];
    for (uint32_t todo = f.visible; todo; todo &= todo - 1) {
      const int lane = __builtin_ctz(todo);
      // An edge's pull on its ends: across and along it, and both weighted by where along it the pull acts.
      Vec sums[12];
      for (int i = 0; i < 12; ++i) sums[i] = all(0.f);
      bool any = false;
      for_each_block(f, lane, scale, ws,
                     [&](const Distances& at, const Nearest& n, float* place, int64_t, int64_t)
                         __attribute__((always_inline)) {
        any = true;
        const Mask in = outside > n.d;
        const Vec p = reciprocal(all(1.f) + exp2(n.d));
        const Vec pull = flip_sign(load(place) * p, n.d);
        Mask mine[3];
        mine[0] = in & (n.square[0] <= n.smallest);
        mine[1] = without(in & (n.square[1] <= n.smallest), mine[0]);
        mine[2] = without(without(in, mine[0]), mine[1]);
        for (int i = 0; i < 3; ++i) {
          const Vec g = keep(mine[i], pull), gt = g * n.clamped[i];
          sums[4 * i + 0] = fma(g, at.across[i], sums[4 * i + 0]);
          sums[4 * i + 1] = fma(g, n.beyond[i], sums[4 * i + 1]);
          sums[4 * i + 2] = fma(gt, at.across[i], sums[4 * i + 2]);
          sums[4 * i + 3] = fma(gt, n.beyond[i], sums[4 * i + 3]);
        }
      });
      if (!any) continue;
      alignas(64) float total[16];
      reduce12(sums, total);
      for (int i = 0; i < 3; ++i) {
        const float tx = f.tx[i][lane], ty = f.ty[i][lane], inverse = 0.5f / f.half[i][lane];
        const float* s = total + 4 * i;
        const float fx = 0.5f * (tx * s[1] - ty * s[0]), fy = 0.5f * (ty * s[1] + tx * s[0]);
        const float mx = inverse * (tx * s[3] - ty * s[2]), my = inverse * (ty * s[3] + tx * s[2]);
        float* a = gradient + 3 * f.vertex[i][lane];
        float* b = gradient + 3 * f.vertex[(i + 1) % 3][lane];
        a[0] += fx - mx, a[1] += fy - my;
        b[0] += fx + mx, b[1] += fy + my;
      }
    }
  }
}


// Calls visit(place in `products`, column, row) for every block.
template <typename Visit>
INLINE void for_each_place(const Workspace& ws, Visit visit) {
  for (int64_t row = 0; row < ws.blocks; ++row)
    for (int64_t column = 0; column < ws.blocks; ++column)
      visit(ws.products + (row * ws.blocks + column) * kLanes, column, row);
}

// A 4×4 block of a row-major image, `fill` beyond the image's edge.
INLINE Vec load_block(const float* image, int64_t size, int64_t column, int64_t row, float fill) {
  const int64_t x0 = column * kBlock, y0 = row * kBlock;
  alignas(64) float values[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    const int64_t x = x0 + i % kBlock, y = y0 + i / kBlock;
    values[i] = x < size && y < size ? image[y * size + x] : fill;
  }
  return load(values);
}

INLINE Vec load_block(const uint8_t* image, int64_t size, int64_t column, int64_t row, uint8_t fill) {
  const int64_t x0 = column * kBlock, y0 = row * kBlock;
  if (x0 + kBlock <= size && y0 + kBlock <= size) return from_bytes(image + y0 * size + x0, size);
  uint8_t values[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    const int64_t x = x0 + i % kBlock, y = y0 + i / kBlock;
    values[i] = x < size && y < size ? image[y * size + x] : fill;
  }
  return from_bytes(values, kBlock);
}

// Turns the products into the gradient's factors, given d loss / d silhouette; closes blocks that have none.
INLINE void set_factor(Vec cotangent, Vec transmitted, Scale scale, const Workspace& ws, float* place, int64_t column,
                       int64_t row) {
  const Vec factor = cotangent * transmitted;
  store(place, factor * all(scale.slope));
  if (!bits(abs(factor) > all(1.f / kSaturated))) close(ws, column, row);
}

template <LossKind kind, typename Pixel>
float compare(const Pixel* target, int64_t size, Scale scale, Workspace& ws, bool with_gradient) {
  double total = 0;
  Vec part = all(0.f);
  const Vec one = all(1.f);
  for_each_place(ws, [&](float* place, int64_t column, int64_t row) __attribute__((always_inline)) {
    const Vec transmitted = one / load(place);
    const Vec error = (one - transmitted) - load_block(target, size, column, row, static_cast<Pixel>(1));
    const Vec size_of = abs(error);
    Vec slope;
    if (kind == LossKind::kL1) {
      part = part + size_of;
      slope = flip_sign(keep(size_of > all(0.f), one), error);
    } else {
      const Vec square = all(0.5f) * error * error;
      part = part + select(size_of > one, size_of - all(0.5f), square);
      slope = max(min(error, one), all(-1.f));
    }
    if (column % 16 == 15) total += sum(part), part = all(0.f);
    if (with_gradient) set_factor(slope, transmitted, scale, ws, place, column, row);
  });
  return static_cast<float>(total + sum(part));
}

void fill(float* p, int64_t n, float value) {
  for (int64_t i = 0; i < n; ++i) p[i] = value;
}

void clear_gradient(float* gradient, int64_t vertices, float value) {
  for (int64_t i = 0; i < vertices; ++i) gradient[3 * i] = gradient[3 * i + 1] = value, gradient[3 * i + 2] = 0;
}

// Prepares `products`; false where a coordinate is not finite.
bool render(const Mesh& mesh, int64_t size, Scale scale, Workspace& ws) {
  if (!load_vertices(mesh, scale, ws)) return false;
  set_up_faces(mesh, scale, ws);
  clear_products(size, ws);
  accumulate_products(scale, ws);
  return true;
}

void finish_gradient(const Mesh& mesh, Scale scale, Workspace& ws, float* gradient) {
  clear_gradient(gradient, mesh.num_vertices, 0);
  accumulate_gradient(scale, ws, gradient);
  for (int64_t i = 0; i < mesh.num_vertices; ++i)
    for (int c = 0; c < 2; ++c) {
      const float v = mesh.vertices[3 * i + c];
      if (v < -kFarAway || v > kFarAway) gradient[3 * i + c] = 0;
    }
}

void silhouette(const Mesh& mesh, Blur blur, int64_t size, void* memory, float* image) {
  Workspace ws = carve(mesh, size, memory);
  const Scale scale = scale_of(blur, size);
  if (!render(mesh, size, scale, ws)) return fill(image, size * size, __builtin_nanf(""));
  for_each_place(ws, [&](float* place, int64_t column, int64_t row) __attribute__((always_inline)) {
    alignas(64) float value[kLanes];
    store(value, all(1.f) - all(1.f) / load(place));
    for (int i = 0; i < kLanes; ++i) {
      const int64_t x = column * kBlock + i % kBlock, y = row * kBlock + i / kBlock;
      if (x < size && y < size) image[y * size + x] = value[i];
    }
  });
}

void silhouette_gradient(const Mesh& mesh, Blur blur, int64_t size, void* memory, const float* cotangent,
                         float* gradient) {
  Workspace ws = carve(mesh, size, memory);
  const Scale scale = scale_of(blur, size);
  if (!render(mesh, size, scale, ws))
    return clear_gradient(gradient, mesh.num_vertices, __builtin_nanf(""));
  for_each_place(ws, [&](float* place, int64_t column, int64_t row) __attribute__((always_inline)) {
    const Vec transmitted = all(1.f) / load(place);
    set_factor(load_block(cotangent, size, column, row, 0.f), transmitted, scale, ws, place, column, row);
  });
  finish_gradient(mesh, scale, ws, gradient);
}

void mask_loss(const Mesh& mesh, Blur blur, int64_t size, void* memory, Target target, LossKind kind, float* loss,
               float* gradient) {
  Workspace ws = carve(mesh, size, memory);
  const Scale scale = scale_of(blur, size);
  if (!render(mesh, size, scale, ws)) {
    *loss = __builtin_nanf("");
    if (gradient) clear_gradient(gradient, mesh.num_vertices, *loss);
    return;
  }
  const bool l1 = kind == LossKind::kL1, with = gradient != nullptr;
  if (target.bytes)
    *loss = l1 ? compare<LossKind::kL1>(target.bytes, size, scale, ws, with)
               : compare<LossKind::kSmoothL1>(target.bytes, size, scale, ws, with);
  else
    *loss = l1 ? compare<LossKind::kL1>(target.floats, size, scale, ws, with)
               : compare<LossKind::kSmoothL1>(target.floats, size, scale, ws, with);
  if (gradient) finish_gradient(mesh, scale, ws, gradient);
}

}  // namespace

extern const Kernels KERNELS;
const Kernels KERNELS = {workspace, silhouette, silhouette_gradient, mask_loss};

}  // namespace jaxfit
