// The soft silhouette. This file is compiled once for each instruction set (JAXFIT_AVX512, JAXFIT_AVX2, neither).
//
// For a pixel and a face, d is the squared distance to the nearest edge segment, negative inside, and
// silhouette = 1 - Π (1 - p) with p = sigmoid(-d / s). With e = exp(-d / s) this equals 1 - 1 / Π (1 + e), which needs
// no division per face. All lengths are scaled by k = √(log2(e) / s), so that e = 2^(-d).
//
// The image is divided into blocks of 4×4 pixels. For each face, sixteen block *centres* at a time, a window of the
// blocks around the face, are evaluated to find the blocks that the face can reach. The pixels of these blocks are then
// evaluated. A block is closed when all its products exceed kSaturated: later faces skip the block, and the block has
// no gradient, because d silhouette / d d = -Π (1 - p) · p / s vanishes there.
#include "gauss_newton.h"
#include "products.h"

#if defined(JAXFIT_AVX512)
#define KERNELS kernels_avx512
#elif defined(JAXFIT_AVX2)
#define KERNELS kernels_avx2
#else
#define KERNELS kernels_baseline
#endif

namespace jaxfit {
namespace {

// Adds the gradient of every open block. For each pixel `products` holds the factor of p · (pixel - nearest point).
void accumulate_gradient(Scale scale, Workspace& ws, float* gradient) {
  const Vec outside = all(scale.radius * scale.radius);
  for (int64_t c = 0; c < ws.num_chunks; ++c) {
    const Faces& f = ws.faces[c];
    for (uint32_t todo = f.visible; todo; todo &= todo - 1) {
      const int lane = __builtin_ctz(todo);
      // For each edge the sums of four quantities over the pixels: the pull across and along the edge, and both
      // multiplied by the position along the edge where the pull acts.
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
        Mask of_edge[3];
        divide_pixels(n, in, of_edge);
        for (int i = 0; i < 3; ++i) {
          const Vec g = keep(of_edge[i], pull), gt = g * n.clamped[i];
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

// Returns a 4×4 block of a row-major image, with `fill` outside the image.
INLINE Vec load_block(const float* image, int64_t size, int64_t column, int64_t row, float fill) {
  const int64_t x0 = column * kBlock, y0 = row * kBlock;
  alignas(64) float values[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    const int64_t x = x0 + i % kBlock, y = y0 + i / kBlock;
    values[i] = x < size && y < size ? image[y * size + x] : fill;
  }
  return load(values);
}

// Returns silhouette - target, 0 at unknown pixels. Outside the image the target is the bird.
INLINE Vec error_of(Vec silhouette, const float* target, int64_t size, int64_t column, int64_t row) {
  return silhouette - load_block(target, size, column, row, 1.f);
}

INLINE Vec error_of(Vec silhouette, const uint8_t* target, int64_t size, int64_t column, int64_t row) {
  const Vec known = load_unequal(target, size, column, row, kUnknown, kBird);
  return known * (silhouette - load_unequal(target, size, column, row, kBackground, kBird));
}

// Replaces the products by the factors of the gradient, given d loss / d silhouette. Closes blocks without gradient.
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
    const Vec error = error_of(one - transmitted, target, size, column, row);
    const Vec magnitude = abs(error);
    Vec slope;
    if (kind == LossKind::kL1) {
      part = part + magnitude;
      slope = flip_sign(keep(magnitude > all(0.f), one), error);
    } else {
      const Vec square = all(0.5f) * error * error;
      part = part + select(magnitude > one, magnitude - all(0.5f), square);
      slope = max(min(error, one), all(-1.f));
    }
    if (column % 16 == 15) total += sum(part), part = all(0.f);
    if (with_gradient) set_factor(slope, transmitted, scale, ws, place, column, row);
  });
  return static_cast<float>(total + sum(part));
}

void finish_gradient(const Mesh& mesh, Scale scale, Workspace& ws, float* gradient) {
  set_gradient(gradient, mesh.num_vertices, 0);
  accumulate_gradient(scale, ws, gradient);
  clear_far_gradient(mesh, gradient);
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
    return set_gradient(gradient, mesh.num_vertices, __builtin_nanf(""));
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
    if (gradient) set_gradient(gradient, mesh.num_vertices, *loss);
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
const Kernels KERNELS = {
    workspace, silhouette, silhouette_gradient, mask_loss, gauss_newton_workspace, silhouette_gauss_newton};

}  // namespace jaxfit
