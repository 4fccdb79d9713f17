// XLA's handlers: they check the buffers, split the batch into images, and call the kernels once for each image.
//
// With vmap_method="expand_dims" every operand has the same number of leading dimensions. Each leading dimension is
// that of the batch or 1. Results have all dimensions of the batch.
#include "ffi.h"

#include <algorithm>
#include <stdexcept>
#include <string>

#include "guard.h"
#include "instruction_set.h"
#include "operands.h"
#include "parallel.h"

namespace jaxfit {
namespace {

Blur checked_blur(float sigma, float radius) {
  if (!(sigma > 0) || !(radius >= 0))
    throw std::invalid_argument("blur: expected a positive sigma and a radius of at least 0");
  return {sigma, radius};
}

Edge checked_edge(int32_t edge) {
  if (edge != static_cast<int32_t>(Edge::kSoftRasterizer) && edge != static_cast<int32_t>(Edge::kUnbiased))
    throw std::invalid_argument("edge: expected 0 or 1, got " + std::to_string(edge));
  return static_cast<Edge>(edge);
}

LossKind checked_kind(int32_t kind) {
  if (kind != static_cast<int32_t>(LossKind::kL1) && kind != static_cast<int32_t>(LossKind::kSmoothL1))
    throw std::invalid_argument("kind: expected 0 or 1, got " + std::to_string(kind));
  return static_cast<LossKind>(kind);
}

ffi::Error silhouette(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::Result<Floats> image, float sigma,
                      float radius, int32_t edge_number) {
  const int64_t size = size_of("image", image->dimensions());
  const Batch batch(image->dimensions(), 2);
  check_result("image", image->dimensions(), batch, {size, size});
  const Blur blur = checked_blur(sigma, radius);
  const Edge edge = checked_edge(edge_number);
  const Meshes meshes(vertices, faces, batch, edge == Edge::kUnbiased);
  const Kernels& kernels = current_kernels(edge);
  float* out = image->typed_data();
  for_each_task(pool, batch.count, [=, &batch, &meshes, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    kernels.silhouette(mesh, blur, size, scratch(kernels.workspace(mesh, blur, size)), out + i * size * size);
  });
  return ffi::Error::Success();
}

ffi::Error silhouette_gradient(ffi::ThreadPool pool, Floats vertices, Indices faces, Floats cotangent,
                               ffi::Result<Floats> gradient, float sigma, float radius,
                               int32_t edge_number) {
  const Batch batch(gradient->dimensions(), 2);
  const Blur blur = checked_blur(sigma, radius);
  const Edge edge = checked_edge(edge_number);
  const Meshes meshes(vertices, faces, batch, edge == Edge::kUnbiased);
  check_result("gradient", gradient->dimensions(), batch, {meshes.num_vertices, 3});
  const int64_t size = size_of("cotangent", cotangent.dimensions());
  const Operand cotangent_at = bind("cotangent", cotangent.dimensions(), batch, {size, size});
  const Kernels& kernels = current_kernels(edge);
  const float* from = cotangent.typed_data();
  float* out = gradient->typed_data();
  for_each_task(pool, batch.count, [=, &batch, &meshes, &cotangent_at, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    kernels.silhouette_gradient(mesh, blur, size, scratch(kernels.workspace(mesh, blur, size)),
                                from + cotangent_at.offset(batch, i), out + i * 3 * mesh.num_vertices);
  });
  return ffi::Error::Success();
}

// The skins of a batch. `generators` is (3, 4, P) and `shape` is (V, 3, S), with P and S multiples of 16 and D = P + S.
struct Skins {
  Skin first;  // with the pointers of the first item
  Operand rest_at, joint_at, weight_at, transforms_at, generators_at, moved_at, view_at, shape_at;

  Skins(const Batch& batch, int64_t num_vertices, int64_t parameters, const Floats& rest, const Indices& joint,
        const Floats& weight, const Floats& transforms, const Floats& generators, const Floats& moved,
        const Floats& view, const Floats& shape, float focal, float centre) {
    const int64_t shapes = shape.dimensions().size() ? shape.dimensions()[shape.dimensions().size() - 1] : 0;
    const int64_t transforming = parameters - shapes;
    if (transforming < 1 || transforming % 16 || shapes % 16)
      throw std::invalid_argument("block: expected a multiple of 16 parameters, got " + std::to_string(transforming) +
                                  " and " + std::to_string(shapes));
    rest_at = bind("rest", rest.dimensions(), batch, {num_vertices, 3});
    joint_at = bind("joint", joint.dimensions(), batch, {num_vertices, kAny});
    const int64_t joints = num_vertices ? joint_at.item / num_vertices : 0;
    if (joints > kMostInfluences) throw std::invalid_argument("joint: expected at most " + std::to_string(kMostInfluences) + " joints per vertex");
    weight_at = bind("skin_weight", weight.dimensions(), batch, {num_vertices, joints});
    transforms_at = bind("transforms", transforms.dimensions(), batch, {kAny, 3, 4});
    check_indices("joint", joint.typed_data(), joint_at.items * joint_at.item, transforms_at.item / 12);
    generators_at = bind("generators", generators.dimensions(), batch, {3, 4, transforming});
    moved_at = bind("moved", moved.dimensions(), batch, {transforms_at.item / 12, transforming});
    view_at = bind("view", view.dimensions(), batch, {3, 3});
    shape_at = bind("shape", shape.dimensions(), batch, {num_vertices, 3, shapes});
    first = {rest.typed_data(), joint.typed_data(), weight.typed_data(), transforms.typed_data(),
             generators.typed_data(), moved.typed_data(), view.typed_data(), shape.typed_data(),
             joints, transforming, parameters, focal, centre};
  }

  Skin of(const Batch& batch, int64_t image) const {
    Skin skin = first;
    skin.rest += rest_at.offset(batch, image);
    skin.joint += joint_at.offset(batch, image);
    skin.weight += weight_at.offset(batch, image);
    skin.transforms += transforms_at.offset(batch, image);
    skin.generators += generators_at.offset(batch, image);
    skin.moved += moved_at.offset(batch, image);
    skin.view += view_at.offset(batch, image);
    skin.shape += shape_at.offset(batch, image);
    return skin;
  }
};

// How a loss is computed: the checked attributes of its handlers.
struct Loss {
  Blur blur;
  Edge edge;
  LossKind kind;

  Loss(float sigma, float radius, int32_t edge, int32_t kind)
      : blur(checked_blur(sigma, radius)), edge(checked_edge(edge)), kind(checked_kind(kind)) {}
};

// Without `gradients`, only the losses are computed; with `skins` and `blocks`, the Gauss-Newton blocks too.
ffi::Error run_mask_loss(ffi::ThreadPool& pool, const Batch& batch, const Meshes& meshes, const ffi::AnyBuffer& target,
                         const Floats& weight, Loss how, float* losses, float* gradients = nullptr,
                         const Skins* skins = nullptr, float* blocks = nullptr) {
  const int64_t size = size_of("target", target.dimensions());
  const Operand target_at = bind("target", target.dimensions(), batch, {size, size});
  const Operand weight_at = bind("weight", weight.dimensions(), batch, {});
  const auto type = target.element_type();
  const bool bytes = type == ffi::U8 || type == ffi::PRED;
  if (!bytes && type != ffi::F32) throw std::invalid_argument("target: expected bool, uint8 or float32");
  if (!bytes && blocks) throw std::invalid_argument("target: expected bool or uint8");
  const auto* pixels = static_cast<const char*>(target.untyped_data());
  const Kernels& kernels = current_kernels(how.edge);
  const float* weights = weight.typed_data();
  for_each_task(pool, batch.count, [=, &batch, &meshes, &target_at, &weight_at, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    const Skin skin = skins ? skins->of(batch, i) : Skin{};
    const int64_t slopes = 3 * mesh.num_vertices, products = skin.parameters * skin.parameters;
    float* gradient = gradients ? gradients + i * slopes : nullptr;
    float* block = blocks ? blocks + i * products : nullptr;
    if (weights[weight_at.offset(batch, i)] == 0) {  // a missing frame: nothing is rendered
      losses[i] = 0;
      if (gradient) std::fill(gradient, gradient + slopes, 0.f);
      if (block) std::fill(block, block + products, 0.f);
      return;
    }
    const int64_t at = target_at.offset(batch, i);
    Target image{};
    if (bytes)
      image.bytes = reinterpret_cast<const uint8_t*>(pixels) + at;
    else
      image.floats = reinterpret_cast<const float*>(pixels) + at;
    void* memory = scratch(block ? kernels.block_workspace(mesh, skin, how.blur, size)
                                 : kernels.workspace(mesh, how.blur, size));
    kernels.mask_loss(mesh, how.blur, size, memory, image, how.kind, losses + i, gradient, &skin, block);
  });
  return ffi::Error::Success();
}

ffi::Error mask_loss(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::AnyBuffer target, Floats weight,
                     ffi::Result<Floats> loss, float sigma, float radius, int32_t edge, int32_t kind) {
  const Loss how(sigma, radius, edge, kind);
  const Batch batch(loss->dimensions(), 0);
  const Meshes meshes(vertices, faces, batch, how.edge == Edge::kUnbiased);
  return run_mask_loss(pool, batch, meshes, target, weight, how, loss->typed_data());
}

ffi::Error mask_loss_and_gradient(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::AnyBuffer target,
                                  Floats weight, ffi::Result<Floats> loss, ffi::Result<Floats> gradient, float sigma,
                                  float radius, int32_t edge, int32_t kind) {
  const Loss how(sigma, radius, edge, kind);
  const Batch batch(loss->dimensions(), 0);
  const Meshes meshes(vertices, faces, batch, how.edge == Edge::kUnbiased);
  check_result("gradient", gradient->dimensions(), batch, {meshes.num_vertices, 3});
  return run_mask_loss(pool, batch, meshes, target, weight, how, loss->typed_data(), gradient->typed_data());
}

ffi::Error mask_loss_gradient_and_block(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::AnyBuffer target,
                                        Floats weight, Floats rest, Indices joint, Floats skin_weight, Floats transforms,
                                        Floats generators, Floats moved, Floats view, Floats shape, ffi::Result<Floats> loss,
                                        ffi::Result<Floats> gradient, ffi::Result<Floats> block, float sigma,
                                        float radius, int32_t edge, int32_t kind, float focal, float centre) {
  const Loss how(sigma, radius, edge, kind);
  const Batch batch(loss->dimensions(), 0);
  const Meshes meshes(vertices, faces, batch, how.edge == Edge::kUnbiased);
  check_result("gradient", gradient->dimensions(), batch, {meshes.num_vertices, 3});
  const int64_t parameters = block->dimensions().size() ? block->dimensions()[block->dimensions().size() - 1] : 0;
  check_result("block", block->dimensions(), batch, {parameters, parameters});
  const Skins skins(batch, meshes.num_vertices, parameters, rest, joint, skin_weight, transforms, generators, moved,
                    view, shape, focal, centre);
  return run_mask_loss(pool, batch, meshes, target, weight, how, loss->typed_data(), gradient->typed_data(), &skins,
                       block->typed_data());
}

auto with_mesh() { return ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Floats>().Arg<Indices>(); }

auto with_mesh_and_target() { return with_mesh().Arg<ffi::AnyBuffer>().Arg<Floats>(); }

}  // namespace

XLA_FFI_Error* silhouette_handler(XLA_FFI_CallFrame* frame) {
  return call_guarded(frame->api, [frame] {
    static const auto* handler = with_mesh()
                                     .Ret<Floats>()
                                     .Attr<float>("sigma")
                                     .Attr<float>("radius")
                                     .Attr<int32_t>("edge")
                                     .To(silhouette)
                                     .release();
    return handler->Call(frame);
  });
}

XLA_FFI_Error* silhouette_gradient_handler(XLA_FFI_CallFrame* frame) {
  return call_guarded(frame->api, [frame] {
    static const auto* handler = with_mesh()
                                     .Arg<Floats>()
                                     .Ret<Floats>()
                                     .Attr<float>("sigma")
                                     .Attr<float>("radius")
                                     .Attr<int32_t>("edge")
                                     .To(silhouette_gradient)
                                     .release();
    return handler->Call(frame);
  });
}

XLA_FFI_Error* mask_loss_handler(XLA_FFI_CallFrame* frame) {
  return call_guarded(frame->api, [frame] {
    static const auto* handler = with_mesh_and_target()
                                     .Ret<Floats>()
                                     .Attr<float>("sigma")
                                     .Attr<float>("radius")
                                     .Attr<int32_t>("edge")
                                     .Attr<int32_t>("kind")
                                     .To(mask_loss)
                                     .release();
    return handler->Call(frame);
  });
}

XLA_FFI_Error* mask_loss_and_gradient_handler(XLA_FFI_CallFrame* frame) {
  return call_guarded(frame->api, [frame] {
    static const auto* handler = with_mesh_and_target()
                                     .Ret<Floats>()
                                     .Ret<Floats>()
                                     .Attr<float>("sigma")
                                     .Attr<float>("radius")
                                     .Attr<int32_t>("edge")
                                     .Attr<int32_t>("kind")
                                     .To(mask_loss_and_gradient)
                                     .release();
    return handler->Call(frame);
  });
}

XLA_FFI_Error* mask_loss_gradient_and_block_handler(XLA_FFI_CallFrame* frame) {
  return call_guarded(frame->api, [frame] {
    static const auto* handler = with_mesh_and_target()
                                     .Arg<Floats>()
                                     .Arg<Indices>()
                                     .Arg<Floats>()
                                     .Arg<Floats>()
                                     .Arg<Floats>()
                                     .Arg<Floats>()
                                     .Arg<Floats>()
                                     .Arg<Floats>()
                                     .Ret<Floats>()
                                     .Ret<Floats>()
                                     .Ret<Floats>()
                                     .Attr<float>("sigma")
                                     .Attr<float>("radius")
                                     .Attr<int32_t>("edge")
                                     .Attr<int32_t>("kind")
                                     .Attr<float>("focal")
                                     .Attr<float>("centre")
                                     .To(mask_loss_gradient_and_block)
                                     .release();
    return handler->Call(frame);
  });
}

}  // namespace jaxfit
