// XLA's handlers: they check the buffers, split the batch into images, and call the kernels once for each image.
//
// With vmap_method="expand_dims" every operand has the same number of leading dimensions. Each leading dimension is
// that of the batch or 1. Results have all dimensions of the batch.
#include "ffi.h"

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "guard.h"
#include "instruction_set.h"
#include "parallel.h"
#include "shapes.h"

namespace jaxfit {
namespace {

namespace ffi = xla::ffi;

using Dimensions = ffi::AnyBuffer::Dimensions;
using Floats = ffi::Buffer<ffi::F32>;
using Indices = ffi::Buffer<ffi::S32>;

// The dimensions of the batch: the leading dimensions of a result whose items have `item_rank` dimensions.
struct Batch {
  std::vector<int64_t> dims;
  int64_t count = 1;

  Batch(Dimensions result, size_t item_rank) {
    for (size_t i = 0; i + item_rank < result.size(); ++i) dims.push_back(result[i]), count *= result[i];
  }
};

// The place of each image's part in an operand.
struct Operand {
  std::vector<int64_t> strides;  // in items; 0 where all images share one item
  int64_t item = 1, items = 1;   // numbers in an item, items in the operand

  int64_t offset(const Batch& batch, int64_t image) const {
    int64_t at = 0;
    for (size_t i = batch.dims.size(); i-- > 0; image /= batch.dims[i]) at += image % batch.dims[i] * strides[i];
    return at * item;
  }
};

// Throws std::invalid_argument where `dims` does not fit the batch and the shape of an item.
Operand bind(const char* name, Dimensions dims, const Batch& batch, std::vector<int64_t> item) {
  const size_t leading = batch.dims.size();
  bool fits = dims.size() == leading + item.size();
  for (size_t i = 0; fits && i < leading; ++i) fits = dims[i] == 1 || dims[i] == batch.dims[i];
  for (size_t i = 0; fits && i < item.size(); ++i) fits = item[i] == kAny || dims[leading + i] == item[i];
  if (!fits)
    throw std::invalid_argument(std::string(name) + ": expected the batch dimensions " + text_of(batch.dims) +
                                " (or 1 in place of any of them) followed by " + text_of(item) + ", got " +
                                text_of(dims));
  Operand out;
  for (size_t i = leading; i < dims.size(); ++i) out.item *= dims[i];
  out.strides.assign(leading, 0);
  for (size_t i = leading; i-- > 0; out.items *= dims[i])
    if (dims[i] != 1) out.strides[i] = out.items;
  return out;
}

void check_result(const char* name, Dimensions dims, const Batch& batch, const std::vector<int64_t>& item) {
  std::vector<int64_t> expected = batch.dims;
  expected.insert(expected.end(), item.begin(), item.end());
  if (!std::equal(dims.begin(), dims.end(), expected.begin(), expected.end()))
    throw std::invalid_argument(std::string(name) + ": expected shape " + text_of(expected) + ", got " +
                                text_of(dims));
}

// Returns the width and height of a square image, which the last dimension gives.
int64_t size_of(const char* name, Dimensions dims) {
  const int64_t size = dims.size() ? dims[dims.size() - 1] : 0;
  if (size < 1 || size > kMaxSize)
    throw std::invalid_argument(std::string(name) + ": expected a square image of 1 to " + std::to_string(kMaxSize) +
                                " pixels a side, got shape " + text_of(dims));
  return size;
}

void check_indices(const char* name, const int32_t* indices, int64_t count, int64_t end) {
  bool inside = true;
  for (int64_t i = 0; i < count; ++i) inside &= indices[i] >= 0 && indices[i] < end;
  if (!inside)
    throw std::invalid_argument(std::string(name) + ": an index is not in [0, " + std::to_string(end) + ")");
}

struct Meshes {
  const float* vertices;
  const int32_t* faces;
  Operand vertices_at, faces_at;
  int64_t num_vertices = 0, num_faces = 0;

  Meshes(const Floats& vertices, const Indices& faces, const Batch& batch)
      : vertices(vertices.typed_data()),
        faces(faces.typed_data()),
        vertices_at(bind("vertices", vertices.dimensions(), batch, {kAny, 3})),
        faces_at(bind("faces", faces.dimensions(), batch, {kAny, 3})),
        num_vertices(vertices_at.item / 3),
        num_faces(faces_at.item / 3) {
    check_indices("faces", this->faces, faces_at.items * faces_at.item, num_vertices);
  }

  Mesh of(const Batch& batch, int64_t image) const {
    return {vertices + vertices_at.offset(batch, image), faces + faces_at.offset(batch, image), num_vertices,
            num_faces};
  }
};

Blur checked_blur(float sigma, float radius) {
  if (!(sigma > 0) || !(radius >= 0))
    throw std::invalid_argument("blur: expected a positive sigma and a radius of at least 0");
  return {sigma, radius};
}

LossKind checked_kind(int32_t kind) {
  if (kind != static_cast<int32_t>(LossKind::kL1) && kind != static_cast<int32_t>(LossKind::kSmoothL1))
    throw std::invalid_argument("kind: expected 0 or 1, got " + std::to_string(kind));
  return static_cast<LossKind>(kind);
}

ffi::Error silhouette(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::Result<Floats> image, float sigma,
                      float radius) {
  const int64_t size = size_of("image", image->dimensions());
  const Batch batch(image->dimensions(), 2);
  check_result("image", image->dimensions(), batch, {size, size});
  const Blur blur = checked_blur(sigma, radius);
  const Meshes meshes(vertices, faces, batch);
  const Kernels& kernels = current_kernels();
  float* out = image->typed_data();
  for_each_task(pool, batch.count, [=, &batch, &meshes, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    kernels.silhouette(mesh, blur, size, scratch(kernels.workspace(mesh, size)), out + i * size * size);
  });
  return ffi::Error::Success();
}

ffi::Error silhouette_gradient(ffi::ThreadPool pool, Floats vertices, Indices faces, Floats cotangent,
                               ffi::Result<Floats> gradient, float sigma, float radius) {
  const Batch batch(gradient->dimensions(), 2);
  const Blur blur = checked_blur(sigma, radius);
  const Meshes meshes(vertices, faces, batch);
  check_result("gradient", gradient->dimensions(), batch, {meshes.num_vertices, 3});
  const int64_t size = size_of("cotangent", cotangent.dimensions());
  const Operand cotangent_at = bind("cotangent", cotangent.dimensions(), batch, {size, size});
  const Kernels& kernels = current_kernels();
  const float* from = cotangent.typed_data();
  float* out = gradient->typed_data();
  for_each_task(pool, batch.count, [=, &batch, &meshes, &cotangent_at, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    kernels.silhouette_gradient(mesh, blur, size, scratch(kernels.workspace(mesh, size)),
                                from + cotangent_at.offset(batch, i), out + i * 3 * mesh.num_vertices);
  });
  return ffi::Error::Success();
}

// The masks of a batch, with bytes or floats.
struct Targets {
  const char* pixels;
  bool bytes;
  int64_t size;
  Operand at;

  Targets(const ffi::AnyBuffer& target, const Batch& batch)
      : pixels(static_cast<const char*>(target.untyped_data())), size(size_of("target", target.dimensions())) {
    const auto type = target.element_type();
    bytes = type == ffi::U8 || type == ffi::PRED;
    if (!bytes && type != ffi::F32) throw std::invalid_argument("target: expected bool, uint8 or float32");
    at = bind("target", target.dimensions(), batch, {size, size});
  }

  Target of(const Batch& batch, int64_t image) const {
    Target out{};
    const int64_t offset = at.offset(batch, image);
    if (bytes)
      out.bytes = reinterpret_cast<const uint8_t*>(pixels) + offset;
    else
      out.floats = reinterpret_cast<const float*>(pixels) + offset;
    return out;
  }
};

// If `gradient` is null, only the loss is computed.
ffi::Error run_mask_loss(ffi::ThreadPool& pool, const Floats& vertices, const Indices& faces,
                         const ffi::AnyBuffer& target, const Floats& weight, ffi::Result<Floats>& loss,
                         ffi::Result<Floats>* gradient, float sigma, float radius, int32_t kind_number) {
  const Batch batch(loss->dimensions(), 0);
  const Blur blur = checked_blur(sigma, radius);
  const LossKind kind = checked_kind(kind_number);
  const Meshes meshes(vertices, faces, batch);
  if (gradient) check_result("gradient", (*gradient)->dimensions(), batch, {meshes.num_vertices, 3});
  const Targets targets(target, batch);
  const Operand weight_at = bind("weight", weight.dimensions(), batch, {});
  const Kernels& kernels = current_kernels();
  const float* weights = weight.typed_data();
  float* out = loss->typed_data();
  float* slopes = gradient ? (*gradient)->typed_data() : nullptr;
  for_each_task(pool, batch.count, [=, &batch, &meshes, &targets, &weight_at, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    float* slope = slopes ? slopes + i * 3 * mesh.num_vertices : nullptr;
    if (weights[weight_at.offset(batch, i)] == 0) {  // a missing frame: nothing is rendered
      out[i] = 0;
      if (slope) std::fill(slope, slope + 3 * mesh.num_vertices, 0.f);
      return;
    }
    void* memory = scratch(kernels.workspace(mesh, targets.size));
    kernels.mask_loss(mesh, blur, targets.size, memory, targets.of(batch, i), kind, out + i, slope);
  });
  return ffi::Error::Success();
}

ffi::Error mask_loss(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::AnyBuffer target, Floats weight,
                     ffi::Result<Floats> loss, float sigma, float radius, int32_t kind) {
  return run_mask_loss(pool, vertices, faces, target, weight, loss, nullptr, sigma, radius, kind);
}

ffi::Error mask_loss_and_gradient(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::AnyBuffer target,
                                  Floats weight, ffi::Result<Floats> loss, ffi::Result<Floats> gradient, float sigma,
                                  float radius, int32_t kind) {
  return run_mask_loss(pool, vertices, faces, target, weight, loss, &gradient, sigma, radius, kind);
}

// The Gauss-Newton blocks of the mask loss. `slope` is (J, 3, 4, D) with D a multiple of 16.
ffi::Error mask_gauss_newton(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::AnyBuffer target, Floats weight,
                             Floats rest, Indices joint, Floats skin_weight, Floats slope, ffi::Result<Floats> block,
                             float sigma, float radius, int32_t kind_number, float focal, float centre) {
  const Batch batch(block->dimensions(), 2);
  const Blur blur = checked_blur(sigma, radius);
  const LossKind kind = checked_kind(kind_number);
  const Meshes meshes(vertices, faces, batch);
  const int64_t parameters = block->dimensions()[block->dimensions().size() - 1];
  if (parameters < 1 || parameters % 16)
    throw std::invalid_argument("block: expected a multiple of 16 parameters, got " + std::to_string(parameters));
  check_result("block", block->dimensions(), batch, {parameters, parameters});
  const Targets targets(target, batch);
  const Operand weight_at = bind("weight", weight.dimensions(), batch, {});
  const Operand rest_at = bind("rest", rest.dimensions(), batch, {meshes.num_vertices, 3});
  const Operand joint_at = bind("joint", joint.dimensions(), batch, {meshes.num_vertices, kAny});
  const int64_t per_vertex = meshes.num_vertices ? joint_at.item / meshes.num_vertices : 0;
  const Operand skin_weight_at = bind("skin_weight", skin_weight.dimensions(), batch, {meshes.num_vertices, per_vertex});
  const Operand slope_at = bind("slope", slope.dimensions(), batch, {kAny, 3, 4, parameters});
  const int64_t num_joints = slope_at.item / (12 * parameters);
  check_indices("joint", joint.typed_data(), joint_at.items * joint_at.item, num_joints);
  const Kernels& kernels = current_kernels();
  const Skin first{rest.typed_data(), joint.typed_data(), skin_weight.typed_data(), slope.typed_data(),
                   per_vertex,        parameters,         focal,                    centre};
  const float* weights = weight.typed_data();
  float* out = block->typed_data();
  for_each_task(pool, batch.count,
                [=, &batch, &meshes, &targets, &weight_at, &rest_at, &joint_at, &skin_weight_at, &slope_at,
                 &kernels](int64_t i) {
    float* own = out + i * parameters * parameters;
    if (weights[weight_at.offset(batch, i)] == 0) return static_cast<void>(std::fill(own, own + parameters * parameters, 0.f));
    Skin skin = first;
    skin.rest += rest_at.offset(batch, i), skin.joint += joint_at.offset(batch, i);
    skin.weight += skin_weight_at.offset(batch, i), skin.slope += slope_at.offset(batch, i);
    const Mesh mesh = meshes.of(batch, i);
    void* memory = scratch(kernels.gauss_newton_workspace(mesh, skin, targets.size));
    kernels.mask_gauss_newton(mesh, skin, blur, targets.size, memory, targets.of(batch, i), kind, own);
  });
  return ffi::Error::Success();
}

auto with_mesh() { return ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Floats>().Arg<Indices>(); }

auto with_mesh_and_target() { return with_mesh().Arg<ffi::AnyBuffer>().Arg<Floats>(); }

}  // namespace

XLA_FFI_Error* silhouette_handler(XLA_FFI_CallFrame* frame) {
  return call_guarded(frame->api, [frame] {
    static const auto* handler =
        with_mesh().Ret<Floats>().Attr<float>("sigma").Attr<float>("radius").To(silhouette).release();
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
                                     .Attr<int32_t>("kind")
                                     .To(mask_loss_and_gradient)
                                     .release();
    return handler->Call(frame);
  });
}

XLA_FFI_Error* mask_gauss_newton_handler(XLA_FFI_CallFrame* frame) {
  return call_guarded(frame->api, [frame] {
    static const auto* handler = with_mesh_and_target()
                                     .Arg<Floats>()
                                     .Arg<Indices>()
                                     .Arg<Floats>()
                                     .Arg<Floats>()
                                     .Ret<Floats>()
                                     .Attr<float>("sigma")
                                     .Attr<float>("radius")
                                     .Attr<int32_t>("kind")
                                     .Attr<float>("focal")
                                     .Attr<float>("centre")
                                     .To(mask_gauss_newton)
                                     .release();
    return handler->Call(frame);
  });
}

}  // namespace jaxfit
