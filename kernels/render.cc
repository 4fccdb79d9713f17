// Bindings of the renderer: NumPy arrays in and out. Threads that live for one call share the strips of the images.
//
// XLA is not used: the renderer is never traced, images have many sizes, and XLA would compile a program for each size.
#include "render.h"

#include <nanobind/ndarray.h>

#include <algorithm>
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "instruction_set.h"
#include "parallel.h"
#include "shapes.h"

namespace nb = nanobind;

namespace jaxfit {
namespace {

template <typename T, long... sizes>
using Shaped = nb::ndarray<T, nb::shape<sizes...>, nb::c_contig, nb::device::cpu>;

using Vertices = Shaped<const float, -1, -1, 3>;  // (B, V, 3)
using Faces = Shaped<const int32_t, -1, 3>;

constexpr int64_t kStripBytes = 4 << 20;  // of the z-buffer; the caches hold more rows where few tiles are touched
constexpr int64_t kFewestRows = 16;       // a limit, because every strip visits all faces

// Threads that live for one call. A pool with a longer life would not survive a fork.
class Threads {
 public:
  Threads() : count_(static_cast<int64_t>(std::thread::hardware_concurrency())) {}
  ~Threads() {
    for (std::thread& thread : started_) thread.join();
  }
  int64_t num_threads() const { return count_ > 0 ? count_ : 1; }
  // Throws where the system has no further thread.
  template <typename Work>
  void Schedule(Work work) {
    started_.emplace_back(std::move(work));
  }

 private:
  int64_t count_;
  std::vector<std::thread> started_;
};

template <typename Array>
void check_shape(const char* name, const Array& array, std::initializer_list<int64_t> expected) {
  std::vector<int64_t> shape;
  for (size_t i = 0; i < array.ndim(); ++i) shape.push_back(static_cast<int64_t>(array.shape(i)));
  if (shape != std::vector<int64_t>(expected))
    throw std::invalid_argument(std::string(name) + ": expected shape " + text_of(expected) + ", got " +
                                text_of(shape));
}

void check_range(const char* name, int64_t value, int64_t greatest) {
  if (value < 1 || value > greatest)
    throw std::invalid_argument(std::string(name) + ": expected 1 to " + std::to_string(greatest) + ", got " +
                                std::to_string(value));
}

// Returns the frame of an image array whose height is at the axis `height_at` and whose width is at the next axis.
template <typename Image>
Frame frame_of(const Image& image, size_t height_at, int64_t samples) {
  const Frame frame{static_cast<int64_t>(image.shape(height_at + 1)), static_cast<int64_t>(image.shape(height_at)),
                    samples};
  check_range("width", frame.width, kMaxSize);
  check_range("height", frame.height, kMaxSize);
  check_range("samples", frame.samples, kMaxSamples);
  return frame;
}

// Returns the mesh of the first image. The meshes of the other images have the same faces.
Mesh first_mesh(const Vertices& vertices, const Faces& faces) {
  const int64_t count = static_cast<int64_t>(vertices.shape(1));
  const Mesh mesh{vertices.data(), faces.data(), count, static_cast<int64_t>(faces.shape(0))};
  for (int64_t i = 0; i < 3 * mesh.num_faces; ++i)
    if (mesh.faces[i] < 0 || mesh.faces[i] >= count)
      throw std::invalid_argument("faces: an index is not in [0, " + std::to_string(count) + ")");
  return mesh;
}

Mesh mesh_of(int64_t image, Mesh first) {
  first.vertices += image * first.num_vertices * 3;
  return first;
}

// Calls task(renderer, mesh, image, rows, scratch) for every strip of every image.
template <typename Task>
void for_each_strip(const Vertices& vertices, const Faces& faces, Frame frame, Task task) {
  const int64_t images = static_cast<int64_t>(vertices.shape(0));
  const Mesh first = first_mesh(vertices, faces);
  nb::gil_scoped_release unlocked;
  Threads threads;
  int64_t rows = std::max(kFewestRows, kStripBytes / (8 * frame.width * frame.samples * frame.samples));
  const int64_t enough = 4 * threads.num_threads();  // strips, so that all threads end at about the same time
  if (images < enough) rows = std::min(rows, std::max(kFewestRows, frame.height * images / enough));
  const int64_t strips = (frame.height + rows - 1) / rows;
  const Renderer& renderer = current_renderer();
  for_each_task(threads, images * strips, [=, &renderer, &task](int64_t i) {
    const int64_t image = i / strips, top = i % strips * rows;
    const Mesh mesh = mesh_of(image, first);
    const Rows strip{top, std::min(top + rows, frame.height)};
    task(renderer, mesh, image, strip, scratch(renderer.workspace(mesh, frame, strip)));
  });
}

void zbuffer(Vertices vertices, Faces faces, Shaped<int32_t, -1, -1, -1> face,
             Shaped<float, -1, -1, -1, 3> barycentric, Shaped<float, -1, -1, -1> depth) {
  const Frame frame = frame_of(face, 1, 1);
  const int64_t size = frame.width * frame.height, images = static_cast<int64_t>(vertices.shape(0));
  check_shape("face", face, {images, frame.height, frame.width});
  check_shape("barycentric", barycentric, {images, frame.height, frame.width, 3});
  check_shape("depth", depth, {images, frame.height, frame.width});
  int32_t* face_at = face.data();
  float *barycentric_at = barycentric.data(), *depth_at = depth.data();
  for_each_strip(vertices, faces, frame, [=](const Renderer& r, const Mesh& mesh, int64_t i, Rows rows, void* memory) {
    r.fragments(mesh, frame, rows, memory, face_at + i * size, barycentric_at + 3 * i * size, depth_at + i * size);
  });
}

void hard_mask(Vertices vertices, Faces faces, Shaped<bool, -1, -1, -1> mask) {
  const Frame frame = frame_of(mask, 1, 1);
  check_shape("mask", mask, {static_cast<int64_t>(vertices.shape(0)), frame.height, frame.width});
  uint8_t* at = reinterpret_cast<uint8_t*>(mask.data());
  for_each_strip(vertices, faces, frame, [=](const Renderer& r, const Mesh& mesh, int64_t i, Rows rows, void* memory) {
    r.mask(mesh, frame, rows, memory, at + i * frame.width * frame.height);
  });
}

void mask_overlap(Vertices vertices, Faces faces, Shaped<const int32_t, -1, 2> sizes,
                  Shaped<const int32_t, -1, 2> runs, Shaped<const int64_t, -1> run_ends, Shaped<int32_t, -1, 4> box,
                  Shaped<int32_t, -1> area, Shaped<int32_t, -1> shared) {
  const int64_t images = static_cast<int64_t>(vertices.shape(0)), count = static_cast<int64_t>(runs.shape(0));
  check_shape("sizes", sizes, {images, 2});
  check_shape("run_ends", run_ends, {images});
  check_shape("box", box, {images, 4});
  check_shape("area", area, {images});
  check_shape("shared", shared, {count});
  const int32_t* size_at = sizes.data();
  const int64_t* end_at = run_ends.data();
  for (int64_t i = 0; i < images; ++i) {
    check_range("width", size_at[2 * i], kMaxSize);
    check_range("height", size_at[2 * i + 1], kMaxSize);
    if (end_at[i] < (i ? end_at[i - 1] : 0) || end_at[i] > count)
      throw std::invalid_argument("run_ends: expected increasing numbers up to " + std::to_string(count));
  }
  const Mesh first = first_mesh(vertices, faces);
  static_assert(sizeof(Run) == 2 * sizeof(int32_t));
  const Run* runs_at = reinterpret_cast<const Run*>(runs.data());
  int32_t *box_at = box.data(), *area_at = area.data(), *shared_at = shared.data();
  nb::gil_scoped_release unlocked;
  Threads threads;
  const Renderer& renderer = current_renderer();
  for_each_task(threads, images, [=, &renderer](int64_t i) {
    const Mesh mesh = mesh_of(i, first);
    const Frame frame{size_at[2 * i], size_at[2 * i + 1], 1};
    const int64_t start = i ? end_at[i - 1] : 0;
    renderer.overlap(mesh, frame, scratch(renderer.workspace(mesh, frame, Rows{0, 0})), runs_at + start,
                     end_at[i] - start, box_at + 4 * i, area_at + i, shared_at + start);
  });
}

void interpolate(Vertices vertices, Faces faces, Shaped<const float, -1, -1, -1> attributes, int64_t samples,
                 Shaped<float, -1, -1, -1, -1> values, Shaped<float, -1, -1, -1> coverage,
                 Shaped<int32_t, -1, -1, -1> face) {
  const Frame frame = frame_of(face, 1, samples);
  const int64_t size = frame.width * frame.height, channels = static_cast<int64_t>(attributes.shape(2));
  const int64_t images = static_cast<int64_t>(vertices.shape(0)), count = static_cast<int64_t>(vertices.shape(1));
  check_shape("attributes", attributes, {images, count, channels});
  check_shape("values", values, {images, frame.height, frame.width, channels});
  check_shape("coverage", coverage, {images, frame.height, frame.width});
  check_shape("face", face, {images, frame.height, frame.width});
  const float* from = attributes.data();
  float *values_at = values.data(), *coverage_at = coverage.data();
  int32_t* face_at = face.data();
  for_each_strip(vertices, faces, frame, [=](const Renderer& r, const Mesh& mesh, int64_t i, Rows rows, void* memory) {
    r.interpolate(mesh, frame, rows, memory, from + i * count * channels, channels, values_at + i * size * channels,
                  coverage_at + i * size, face_at + i * size);
  });
}

void draw(Vertices vertices, Faces faces, Shaped<const float, -1, 3> colours, int64_t samples,
          Shaped<uint8_t, -1, -1, 3> image) {
  const Frame frame = frame_of(image, 0, samples);
  const int64_t count = static_cast<int64_t>(vertices.shape(1));
  check_shape("vertices", vertices, {1, count, 3});
  check_shape("colours", colours, {count, 3});
  const float* from = colours.data();
  uint8_t* at = image.data();
  for_each_strip(vertices, faces, frame, [=](const Renderer& r, const Mesh& mesh, int64_t, Rows rows, void* memory) {
    r.draw(mesh, frame, rows, memory, from, at);
  });
}

}  // namespace

void add_renderer(nb::module_& m) {
  using nb::arg;
  m.def("zbuffer", &zbuffer, arg("vertices").noconvert(), arg("faces").noconvert(), arg("face").noconvert(),
        arg("barycentric").noconvert(), arg("depth").noconvert());
  m.def("hard_mask", &hard_mask, arg("vertices").noconvert(), arg("faces").noconvert(), arg("mask").noconvert());
  m.def("mask_overlap", &mask_overlap, arg("vertices").noconvert(), arg("faces").noconvert(),
        arg("sizes").noconvert(), arg("runs").noconvert(), arg("run_ends").noconvert(), arg("box").noconvert(),
        arg("area").noconvert(), arg("shared").noconvert());
  m.def("interpolate", &interpolate, arg("vertices").noconvert(), arg("faces").noconvert(),
        arg("attributes").noconvert(), arg("samples"), arg("values").noconvert(), arg("coverage").noconvert(),
        arg("face").noconvert());
  m.def("draw", &draw, arg("vertices").noconvert(), arg("faces").noconvert(), arg("colours").noconvert(),
        arg("samples"), arg("image").noconvert());
}

}  // namespace jaxfit
