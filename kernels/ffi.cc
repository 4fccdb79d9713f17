// Argument checks and bindings: from XLA's buffers, with any leading batch dimensions, to one call an image.
//
// vmap_method="expand_dims" gives every operand the same number of leading dimensions, each the batch's size or 1;
// results have the full sizes.
#include "ffi.h"

#include <string>
#include <vector>

#include "instruction_set.h"
#include "parallel.h"

namespace jaxfit {
namespace {

namespace ffi = xla::ffi;

using Floats = ffi::Buffer<ffi::F32>;
using Indices = ffi::Buffer<ffi::S32>;

std::string shape_of(ffi::AnyBuffer::Dimensions dims) {
  std::string text = "(";
  for (size_t i = 0; i < dims.size(); ++i) text += (i ? ", " : "") + std::to_string(dims[i]);
  return text + ")";
}

// The batch's dimensions, taken from a result.
struct Batch {
  std::vector<int64_t> dims;
  int64_t count = 1;

  Batch(ffi::AnyBuffer::Dimensions result, size_t item_rank) {
    for (size_t i = 0; i + item_rank < result.size(); ++i) dims.push_back(result[i]), count *= result[i];
  }
};

// Where each image's part of one operand begins.
struct Operand {
  std::vector<int64_t> strides;  // in items, 0 where the operand is shared
  int64_t item = 1, items = 1;

  int64_t offset(const Batch& batch, int64_t image) const {
    int64_t at = 0;
    for (size_t i = batch.dims.size(); i-- > 0; image /= batch.dims[i]) at += image % batch.dims[i] * strides[i];
    return at * item;
  }
};

// Checks `dims` against batch and item shape (-1: any); false with `error` set.
bool bind(const char* name, ffi::AnyBuffer::Dimensions dims, const Batch& batch, std::vector<int64_t> item,
          Operand& out, std::string& error) {
  const size_t leading = batch.dims.size();
  bool fits = dims.size() == leading + item.size();
  for (size_t i = 0; fits && i < leading; ++i) fits = dims[i] == 1 || dims[i] == batch.dims[i];
  for (size_t i = 0; fits && i < item.size(); ++i) fits = item[i] < 0 || dims[leading + i] == item[i];
  if (!fits) {
    error = std::string(name) + " has shape " + shape_of(dims) + ", which does not fit a batch of shape (";
    for (int64_t d : batch.dims) error += std::to_string(d) + ", ";
    error += ") of items (";
    for (int64_t d : item) error += (d < 0 ? std::string("any") : std::to_string(d)) + ", ";
    error += ")";
    return false;
  }
  for (size_t i = leading; i < dims.size(); ++i) out.item *= dims[i];
  out.strides.assign(leading, 0);
  for (size_t i = leading; i-- > 0; out.items *= dims[i])
    if (dims[i] != 1) out.strides[i] = out.items;
  return true;
}

struct Meshes {
  const float* vertices;
  const int32_t* faces;
  Operand vertices_at, faces_at;
  int64_t num_vertices = 0, num_faces = 0;

  Mesh of(const Batch& batch, int64_t image) const {
    return {vertices + vertices_at.offset(batch, image), faces + faces_at.offset(batch, image), num_vertices,
            num_faces};
  }
};

bool bind_meshes(const Floats& vertices, const Indices& faces, const Batch& batch, Blur blur, Meshes& out,
                 std::string& error) {
  if (!(blur.sigma > 0) || !(blur.radius >= 0)) {
    error = "blur: sigma must be positive and radius not negative";
    return false;
  }
  if (!bind("vertices", vertices.dimensions(), batch, {-1, 3}, out.vertices_at, error) ||
      !bind("faces", faces.dimensions(), batch, {-1, 3}, out.faces_at, error))
    return false;
  out.vertices = vertices.typed_data(), out.faces = faces.typed_data();
  out.num_vertices = out.vertices_at.item / 3, out.num_faces = out.faces_at.item / 3;
  const int64_t n = out.faces_at.items * out.faces_at.item;
  bool inside = true;
  for (int64_t i = 0; i < n; ++i) inside &= out.faces[i] >= 0 && out.faces[i] < out.num_vertices;
  if (!inside) error = "faces: an index is not in [0, " + std::to_string(out.num_vertices) + ")";
  return inside;
}

ffi::Error invalid(const std::string& message) { return ffi::Error::InvalidArgument("jaxfit: " + message); }

ffi::Error finish(bool fine) {
  return fine ? ffi::Error::Success()
              : ffi::Error(ffi::ErrorCode::kResourceExhausted, "jaxfit: no memory for the silhouette's scratch");
}

ffi::Error silhouette(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::Result<Floats> image, float sigma,
                      float radius) {
  const auto dims = image->dimensions();
  if (dims.size() < 2 || dims[dims.size() - 1] != dims[dims.size() - 2]) return invalid("the image is not square");
  const int64_t size = dims[dims.size() - 1];
  const Batch batch(dims, 2);
  const Blur blur{sigma, radius};
  Meshes meshes;
  std::string error;
  if (!bind_meshes(vertices, faces, batch, blur, meshes, error)) return invalid(error);
  const Kernels& kernels = current_kernels();
  float* out = image->typed_data();
  return finish(for_each_task(pool, batch.count, [=, &batch, &meshes, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    kernels.silhouette(mesh, blur, size, scratch(kernels.workspace(mesh, size)), out + i * size * size);
  }));
}

ffi::Error silhouette_gradient(ffi::ThreadPool pool, Floats vertices, Indices faces, Floats cotangent,
                               ffi::Result<Floats> gradient, float sigma, float radius) {
  const Batch batch(gradient->dimensions(), 2);
  const Blur blur{sigma, radius};
  Meshes meshes;
  Operand cotangent_at;
  std::string error;
  if (!bind_meshes(vertices, faces, batch, blur, meshes, error)) return invalid(error);
  const auto dims = cotangent.dimensions();
  const int64_t size = dims.size() ? dims[dims.size() - 1] : 0;
  if (!bind("cotangent", dims, batch, {size, size}, cotangent_at, error)) return invalid(error);
  const Kernels& kernels = current_kernels();
  const float* from = cotangent.typed_data();
  float* out = gradient->typed_data();
  return finish(for_each_task(pool, batch.count, [=, &batch, &meshes, &cotangent_at, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    kernels.silhouette_gradient(mesh, blur, size, scratch(kernels.workspace(mesh, size)),
                                from + cotangent_at.offset(batch, i), out + i * 3 * mesh.num_vertices);
  }));
}

ffi::Error run_mask_loss(ffi::ThreadPool& pool, const Floats& vertices, const Indices& faces,
                         const ffi::AnyBuffer& target, const Floats& weight, ffi::Result<Floats>& loss,
                         float* gradient, float sigma, float radius, int32_t kind) {
  const Batch batch(loss->dimensions(), 0);
  const Blur blur{sigma, radius};
  Meshes meshes;
  Operand target_at, weight_at;
  std::string error;
  if (!bind_meshes(vertices, faces, batch, blur, meshes, error)) return invalid(error);
  const auto dims = target.dimensions();
  const int64_t size = dims.size() ? dims[dims.size() - 1] : 0;
  if (!bind("target", dims, batch, {size, size}, target_at, error) ||
      !bind("weight", weight.dimensions(), batch, {}, weight_at, error))
    return invalid(error);
  const auto type = target.element_type();
  const bool bytes = type == ffi::U8 || type == ffi::PRED;
  if (!bytes && type != ffi::F32) return invalid("target: expected bool, uint8 or float32");
  const auto* pixels = static_cast<const char*>(target.untyped_data());
  const Kernels& kernels = current_kernels();
  const float* weights = weight.typed_data();
  float* out = loss->typed_data();
  return finish(for_each_task(pool, batch.count, [=, &batch, &meshes, &target_at, &weight_at, &kernels](int64_t i) {
    const Mesh mesh = meshes.of(batch, i);
    float* slope = gradient ? gradient + i * 3 * mesh.num_vertices : nullptr;
    if (weights[weight_at.offset(batch, i)] == 0) {  // a missing frame costs nothing
      out[i] = 0;
      if (slope) std::fill(slope, slope + 3 * mesh.num_vertices, 0.f);
      return;
    }
    const int64_t at = target_at.offset(batch, i);
    Target image{};
    if (bytes)
      image.bytes = reinterpret_cast<const uint8_t*>(pixels) + at;
    else
      image.floats = reinterpret_cast<const float*>(pixels) + at;
    kernels.mask_loss(mesh, blur, size, scratch(kernels.workspace(mesh, size)), image, static_cast<LossKind>(kind),
                      out + i, slope);
  }));
}

ffi::Error mask_loss(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::AnyBuffer target, Floats weight,
                     ffi::Result<Floats> loss, float sigma, float radius, int32_t kind) {
  return run_mask_loss(pool, vertices, faces, target, weight, loss, nullptr, sigma, radius, kind);
}

ffi::Error mask_loss_and_gradient(ffi::ThreadPool pool, Floats vertices, Indices faces, ffi::AnyBuffer target,
                                  Floats weight, ffi::Result<Floats> loss, ffi::Result<Floats> gradient, float sigma,
                                  float radius, int32_t kind) {
  return run_mask_loss(pool, vertices, faces, target, weight, loss, gradient->typed_data(), sigma, radius, kind);
}

auto with_mesh() { return ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<Floats>().Arg<Indices>(); }

}  // namespace

XLA_FFI_Error* silhouette_handler(XLA_FFI_CallFrame* frame) {
  static const auto* handler =
      with_mesh().Ret<Floats>().Attr<float>("sigma").Attr<float>("radius").To(silhouette).release();
  return handler->Call(frame);
}

XLA_FFI_Error* silhouette_gradient_handler(XLA_FFI_CallFrame* frame) {
  static const auto* handler =
      with_mesh().Arg<Floats>().Ret<Floats>().Attr<float>("sigma").Attr<float>("radius").To(silhouette_gradient)
          .release();
  return handler->Call(frame);
}

XLA_FFI_Error* mask_loss_handler(XLA_FFI_CallFrame* frame) {
  static const auto* handler = with_mesh()
                                   .Arg<ffi::AnyBuffer>()
                                   .Arg<Floats>()
                                   .Ret<Floats>()
                                   .Attr<float>("sigma")
                                   .Attr<float>("radius")
                                   .Attr<int32_t>("kind")
                                   .To(mask_loss)
                                   .release();
  return handler->Call(frame);
}

XLA_FFI_Error* mask_loss_and_gradient_handler(XLA_FFI_CallFrame* frame) {
  static const auto* handler = with_mesh()
                                   .Arg<ffi::AnyBuffer>()
                                   .Arg<Floats>()
                                   .Ret<Floats>()
                                   .Ret<Floats>()
                                   .Attr<float>("sigma")
                                   .Attr<float>("radius")
                                   .Attr<int32_t>("kind")
                                   .To(mask_loss_and_gradient)
                                   .release();
  return handler->Call(frame);
}

}  // namespace jaxfit
