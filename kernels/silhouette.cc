// The soft silhouette. This file is compiled once for each instruction set.
//
// For a pixel and a face, d is the squared distance to the nearest edge segment, negative inside, and
// silhouette = 1 - Π (1 - p) with p = sigmoid(-d / s). With e = exp(-d / s) this equals 1 - 1 / Π (1 + e), which needs
// no division per face. All lengths are scaled by k = √(log2(e) / s), so that e = 2^(-d).
//
// The image is divided into blocks of 4×4 pixels. A face changes only pixels that are inside it, or nearer than the blur
// radius. To find their blocks, the distances of the block *centres* around the face are computed, sixteen at a time (a
// window); then those of the pixels of these blocks.
//
// There are two passes over the faces. The first multiplies the factors (1 + e) of all faces into `products`. From the
// products come the loss, and for each pixel the factor of the gradient, which replaces the product. The second pass adds
// the gradient of all faces. A block is closed, so that later faces skip it, in the first pass when all its products
// exceed kSaturated, because d silhouette / d d = -Π (1 - p) · p / s vanishes there; and before the second pass where no
// pixel has a gradient.
#include "compiled.h"
#include "gauss_newton.h"
#include "products.h"

namespace jaxfit {
namespace {

// Adds the gradient of every open block. For each pixel `products` holds the factor of p · (pixel - nearest point). The
// nearest point lies on an edge between two vertices, which share the force. With rows, the pull of each chosen pixel is
// added to its row as well, with the factor of the row: the derivative of the silhouette in place of that of the loss.
template <bool with_rows>
void accumulate_gradient(const Mesh& mesh, const Skin* skin, Scale scale, Workspace& ws, const Rows* rows,
                         float* gradient) {
  const Vec radius_squared = all(scale.radius * scale.radius), zero = all(0.f), one = all(1.f);
  for (int64_t c = 0; c < ws.num_chunks; ++c) {
    Faces& f = ws.faces[c];
    for (uint32_t todo = f.visible; todo; todo &= todo - 1) {
      const int lane = __builtin_ctz(todo);
      const Vec inverse[3] = {all(f.inverse[0][lane]), all(f.inverse[1][lane]), all(f.inverse[2][lane])};
      Vec x[3] = {zero, zero, zero}, y[3] = {zero, zero, zero};  // on vertices 0 and 1, and on the whole face
      bool any = false;
      for_each_block<Reached::kKnown>(f, lane, scale, ws, [&](const Face& face, const Block& block)
                                      __attribute__((always_inline)) {
        any = true;
        const int64_t first_pixel = block.place - ws.products;
        const uint32_t chosen = with_rows ? rows->chosen[first_pixel / kLanes] : 0;
        for (int at = 0; at < kLanes; at += kWidth) {
          const Nearest n = nearest_edge(face, block, at);
          const Vec p = keep(greater(radius_squared, n.d), reciprocal(one + exp2(n.d)));
          // Outside, the silhouette rises if the edge moves towards the pixel; inside, if it moves away.
          const Vec pull = flip_sign(p, n.d);
          const Vec across = pull * pick(n, n.across[0], n.across[1], n.across[2]);
          const Vec beyond = pull * pick(n, n.beyond[0], n.beyond[1], n.beyond[2]);
          const Vec tx = pick(n, face.tx[0], face.tx[1], face.tx[2]);
          const Vec ty = pick(n, face.ty[0], face.ty[1], face.ty[2]);
          // With the normal m = (-ty, tx), which points inside, pixel - nearest point = beyond · t + across · m.
          const Vec pull_x = fms(tx, beyond, ty * across), pull_y = fma(ty, beyond, tx * across);
          const Vec along = pick(n, n.clamped[0] * inverse[0], n.clamped[1] * inverse[1], n.clamped[2] * inverse[2]);
          // `along` is in [-1/2, 1/2] from the start to the end of the edge. Edge 12 does not touch vertex 0, and edge 20
          // does not touch vertex 1.
          const Vec of_end = all(0.5f) + along, of_start = all(0.5f) - along;
          const Vec share0 = pick(n, of_start, zero, of_end), share1 = pick(n, of_end, of_start, zero);
          const Vec factor = load(block.place + at);
          const Vec force_x = factor * pull_x, force_y = factor * pull_y;
          x[0] = fma(share0, force_x, x[0]);
          y[0] = fma(share0, force_y, y[0]);
          x[1] = fma(share1, force_x, x[1]);
          y[1] = fma(share1, force_y, y[1]);
          x[2] = x[2] + force_x;
          y[2] = y[2] + force_y;
          const uint32_t own = chosen >> at & ((1u << kWidth) - 1);
          if (!with_rows || !own) continue;
          Pull stored;
          store(stored.x, pull_x);
          store(stored.y, pull_y);
          store(stored.share0, share0);
          store(stored.share1, share1);
          const uint32_t reached = own & bits(greater(radius_squared, n.d));
          add_to_rows(mesh, *skin, f, lane, reached, stored, rows->of_pixel + first_pixel + at, *rows);
        }
      });
      if (!any) continue;
      float on_x[3] = {sum(x[0]), sum(x[1]), sum(x[2])}, on_y[3] = {sum(y[0]), sum(y[1]), sum(y[2])};
      on_x[2] -= on_x[0] + on_x[1];  // vertex 2 has the rest of the force
      on_y[2] -= on_y[0] + on_y[1];
      for (int i = 0; i < 3; ++i) {
        gradient[3 * f.vertex[i][lane]] += on_x[i];
        gradient[3 * f.vertex[i][lane] + 1] += on_y[i];
      }
    }
  }
}

// Returns a 4×4 block of a row-major image, with `fill` outside the image.
[[gnu::always_inline]] inline BlockValues load_block(const float* image, int64_t size, int64_t column, int64_t row,
                                                     float fill) {
  const int64_t x0 = column * kBlock, y0 = row * kBlock;
  BlockValues values;
  for (int i = 0; i < kLanes; ++i) {
    const int64_t x = x0 + i % kBlock, y = y0 + i / kBlock;
    values.at[i] = x < size && y < size ? image[y * size + x] : fill;
  }
  return values;
}

// The target of a block, and 0 at unknown pixels, else 1. Outside the image the target is the bird: the products there
// are kFull, so the error is 0.
struct BlockTarget {
  BlockValues value, known;
};

[[gnu::always_inline]] inline BlockTarget load_target(const float* target, int64_t size, int64_t column,
                                                      int64_t row) {
  BlockTarget block{load_block(target, size, column, row, 1), {}};
  fill(block.known.at, kLanes, 1);
  return block;
}

[[gnu::always_inline]] inline BlockTarget load_target(const uint8_t* target, int64_t size, int64_t column,
                                                      int64_t row) {
  return {load_unequal(target, size, column, row, kBackground, kBird),
          load_unequal(target, size, column, row, kUnknown, kBird)};
}

// Replaces products by the factors of the gradient, given d loss / d silhouette. Returns whether one is above
// `negligible` before it is multiplied by the constant `scale.slope`.
[[gnu::always_inline]] inline bool set_factor(Vec cotangent, Vec transmitted, Scale scale, float negligible,
                                              float* place) {
  const Vec factor = cotangent * transmitted;
  store(place, factor * all(scale.slope));
  return bits(greater(abs(factor), all(negligible)));
}

// Returns the loss. With a gradient, replaces the products by its factors and closes the blocks without any.
template <LossKind kind, typename Pixel>
float compare(const Pixel* target, int64_t size, Scale scale, Workspace& ws, bool with_gradient) {
  double total = 0;
  Vec part = all(0.f);
  const Vec zero = all(0.f), half = all(0.5f), one = all(1.f);
  for_each_place(ws, [&](float* place, int64_t column, int64_t row) __attribute__((always_inline)) {
    const BlockTarget block = load_target(target, size, column, row);
    bool open = false;
    for (int at = 0; at < kLanes; at += kWidth) {
      const Vec transmitted = one / load(place + at);
      const Vec error = load(block.known.at + at) * (one - transmitted - load(block.value.at + at));
      const Vec magnitude = abs(error);
      Vec cotangent;  // d loss / d silhouette
      if (kind == LossKind::kL1) {
        part = part + magnitude;
        cotangent = flip_sign(keep(greater(magnitude, zero), one), error);
      } else {
        part = part + select(greater(magnitude, one), magnitude - half, half * error * error);
        cotangent = clamp_to(error, one);
      }
      if (with_gradient) open |= set_factor(cotangent, transmitted, scale, 1 / kSaturated, place + at);
    }
    if (column % 16 == 15) {  // a float is precise enough for the sum of so few numbers
      total += sum(part);
      part = zero;
    }
    if (with_gradient && !open) close(ws, column, row);
  });
  return static_cast<float>(total + sum(part));
}

// The second pass over the faces, from the factors of the pixels.
void gradient_from_factors(const Mesh& mesh, Scale scale, Workspace& ws, float* gradient, const Skin* skin = nullptr,
                           const Rows* rows = nullptr) {
  set_gradient(gradient, mesh.num_vertices, 0);
  if (rows)
    accumulate_gradient<true>(mesh, skin, scale, ws, rows, gradient);
  else
    accumulate_gradient<false>(mesh, skin, scale, ws, rows, gradient);
  clear_far_gradient(mesh, gradient);
}

void silhouette(const Mesh& mesh, Blur blur, int64_t size, void* memory, float* image) {
  Workspace ws = carve(mesh, size, memory);
  const Scale scale = scale_of(blur, size);
  if (!render(mesh, size, scale, ws)) return fill(image, size * size, __builtin_nanf(""));
  for_each_place(ws, [&](float* place, int64_t column, int64_t row) __attribute__((always_inline)) {
    BlockValues value;
    for (int at = 0; at < kLanes; at += kWidth) store(value.at + at, all(1.f) - all(1.f) / load(place + at));
    for (int i = 0; i < kLanes; ++i) {
      const int64_t x = column * kBlock + i % kBlock, y = row * kBlock + i / kBlock;
      if (x < size && y < size) image[y * size + x] = value.at[i];
    }
  });
}

void silhouette_gradient(const Mesh& mesh, Blur blur, int64_t size, void* memory, const float* cotangent,
                         float* gradient) {
  Workspace ws = carve(mesh, size, memory);
  const Scale scale = scale_of(blur, size);
  if (!render(mesh, size, scale, ws))
    return set_gradient(gradient, mesh.num_vertices, __builtin_nanf(""));
  float greatest = 0;
  for (int64_t i = 0; i < size * size; ++i) greatest = __builtin_fmaxf(greatest, __builtin_fabsf(cotangent[i]));
  // relative to the greatest number, where all are small
  const float negligible = __builtin_fminf(greatest, 1) / kSaturated;
  for_each_place(ws, [&](float* place, int64_t column, int64_t row) __attribute__((always_inline)) {
    const BlockValues cotangents = load_block(cotangent, size, column, row, 0);
    bool open = false;
    for (int at = 0; at < kLanes; at += kWidth)
      open |= set_factor(load(cotangents.at + at), all(1.f) / load(place + at), scale, negligible, place + at);
    if (!open) close(ws, column, row);
  });
  gradient_from_factors(mesh, scale, ws, gradient);
}

void mask_loss(const Mesh& mesh, Blur blur, int64_t size, void* memory, Target target, LossKind kind, float* loss,
               float* gradient, const Skin* skin, float* block) {
  Workspace ws = carve(mesh, size, memory);
  const Scale scale = scale_of(blur, size);
  if (!render(mesh, size, scale, ws)) {
    *loss = __builtin_nanf("");
    if (gradient) set_gradient(gradient, mesh.num_vertices, *loss);
    if (block) fill(block, skin->parameters * skin->parameters, *loss);
    return;
  }
  Rows rows;
  if (block) {  // before the loss, which overwrites the products
    rows = carve_rows(mesh, *skin, blur, size, memory);
    choose_rows(target.bytes, size, skin->parameters, scale, ws, rows);
  }
  const bool l1 = kind == LossKind::kL1, with_gradient = gradient != nullptr;
  if (target.bytes)
    *loss = l1 ? compare<LossKind::kL1>(target.bytes, size, scale, ws, with_gradient)
               : compare<LossKind::kSmoothL1>(target.bytes, size, scale, ws, with_gradient);
  else
    *loss = l1 ? compare<LossKind::kL1>(target.floats, size, scale, ws, with_gradient)
               : compare<LossKind::kSmoothL1>(target.floats, size, scale, ws, with_gradient);
  // The blocks of the band are open: both the error and 1 - silhouette are at least kBandEdge there, so their product,
  // the factor, is not negligible.
  if (gradient) gradient_from_factors(mesh, scale, ws, gradient, skin, block ? &rows : nullptr);
  if (block) multiply_rows(rows.values, rows.values, rows.count, skin->parameters, block);
}

}  // namespace

template <>
const Kernels Compiled<kIsa>::soft_rasterizer = {
    workspace, silhouette, silhouette_gradient, mask_loss, block_workspace};

}  // namespace jaxfit
