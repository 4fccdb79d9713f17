// The operands of a batch of images: their shapes are checked, and each image finds its part. Part of ffi.cc.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "edges.h"
#include "mesh.h"
#include "shapes.h"
#include "xla/ffi/api/ffi.h"

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
  std::vector<EdgeTable> edges;  // of each item of `faces`, if they are needed

  Meshes(const Floats& vertices, const Indices& faces, const Batch& batch, bool with_edges)
      : vertices(vertices.typed_data()),
        faces(faces.typed_data()),
        vertices_at(bind("vertices", vertices.dimensions(), batch, {kAny, 3})),
        faces_at(bind("faces", faces.dimensions(), batch, {kAny, 3})),
        num_vertices(vertices_at.item / 3),
        num_faces(faces_at.item / 3) {
    check_indices("faces", this->faces, faces_at.items * faces_at.item, num_vertices);
    for (int64_t i = 0; with_edges && i < faces_at.items; ++i)
      edges.emplace_back(this->faces + i * faces_at.item, num_faces, num_vertices);
  }

  Mesh of(const Batch& batch, int64_t image) const {
    const int64_t at = faces_at.offset(batch, image);
    const Edges own = edges.empty() || !num_faces ? Edges{} : edges[at / faces_at.item].view();
    return {vertices + vertices_at.offset(batch, image), faces + at, num_vertices, num_faces, own};
  }
};

}  // namespace
}  // namespace jaxfit
