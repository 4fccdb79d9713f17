// Bindings of the renderer: NumPy arrays in and out, strips of the images shared out to threads of this call.
//
// XLA is not involved: nothing here is traced, images have many sizes, and each size would be a program of its own.
#include "render.h"

#include <nanobind/ndarray.h>

#include <new>
#include <stdexcept>
#include <system_error>
#include <thread>
#include <vector>

#include "instruction_set.h"
#include "parallel.h"

namespace nb = nanobind;

namespace jaxfit {
namespace {

template <typename T, long... sizes>
using Shaped = nb::ndarray<T, nb::shape<sizes...>, nb::c_contig, nb::device::cpu>;

using Vertices = Shaped<const float, -1, -1, 3>;  // (B, V, 3)
using Faces = Shaped<const int32_t, -1, 3>;

constexpr int64_t kStripBytes = 4 << 20;  // of the z-buffer; where few tiles are touched, the caches hold more rows
constexpr int64_t kFewestRows = 16;       // a strip looks at every face

// Threads that live as long as one call: a pool that outlived it would not survive a fork.
class Threads {
 public:
  Threads() : count_(static_cast<int64_t>(std::thread::hardware_concurrency())) {}
  ~Threads() {
    for (std::thread& thread : started_) thread.join();
  }
  int64_t num_threads() const { return count_ > 0 ? count_ : 1; }
  template <typename Work>
  void Schedule(Work work) {
    try {
      started_.emplace_back(std::move(work));
    } catch (const std::system_error&) {  // no more threads: the caller does the work
    }
  }

 private:
  int64_t count_;
  std::vector<std::thread> started_;
};

// Calls task(renderer, mesh, image, rows, scratch) for every strip of every image.
template <typename Task>
void for_each_strip(const Vertices& vertices, const Faces& faces, Frame frame, Task task) {
  const int64_t images = static_cast<int64_t>(vertices.shape(0)), count = static_cast<int64_t>(vertices.shape(1));
  const Mesh first{vertices.data(), faces.data(), count, static_cast<int64_t>(faces.shape(0))};
  for (int64_t i = 0; i < 3 * first.num_faces; ++i)
    if (first.faces[i] < 0 || first.faces[i] >= count) throw std::invalid_argument("faces: an index is out of range");
  nb::gil_scoped_release unlocked;
  Threads threads;
  int64_t rows = std::max(kFewestRows, kStripBytes / (8 * frame.width * frame.samples * frame.samples));
  const int64_t wanted = 4 * threads.num_threads();  // so that threads end together
  if (images < wanted) rows = std::min(rows, std::max(kFewestRows, frame.height * images / wanted));
  const int64_t strips = (frame.height + rows - 1) / rows;
  const Renderer& renderer = current_renderer();
  const bool fine = for_each_task(threads, images * strips, [=, &renderer, &task](int64_t i) {
    const int64_t image = i / strips, top = i % strips * rows;
    Mesh mesh = first;
    mesh.vertices += image * count * 3;
    const Rows strip{top, std::min(top + rows, frame.height)};
    task(renderer, mesh, image, strip, scratch(renderer.workspace(mesh, frame, strip)));
  });
  if (!fine) throw std::bad_alloc();
}

template <typename Image>
Frame frame_of(const Image& image, size_t height_at, int64_t samples) {
  return {static_cast<int64_t>(image.shape(height_at + 1)), static_cast<int64_t>(image.shape(height_at)), samples};
}

void zbuffer(Vertices vertices, Faces faces, Shaped<int32_t, -1, -1, -1> face,
             Shaped<float, -1, -1, -1, 3> barycentric, Shaped<float, -1, -1, -1> depth) {
  const Frame frame = frame_of(face, 1, 1);
  const int64_t size = frame.width * frame.height;
  int32_t* face_at = face.data();
  float *barycentric_at = barycentric.data(), *depth_at = depth.data();
  for_each_strip(vertices, faces, frame, [=](const Renderer& r, const Mesh& mesh, int64_t i, Rows rows, void* memory) {
    r.fragments(mesh, frame, rows, memory, face_at + i * size, barycentric_at + 3 * i * size, depth_at + i * size);
  });
}

void hard_mask(Vertices vertices, Faces faces, Shaped<bool, -1, -1, -1> mask) {
  const Frame frame = frame_of(mask, 1, 1);
  uint8_t* at = reinterpret_cast<uint8_t*>(mask.data());
  for_each_strip(vertices, faces, frame, [=](const Renderer& r, const Mesh& mesh, int64_t i, Rows rows, void* memory) {
    r.mask(mesh, frame, rows, memory, at + i * frame.width * frame.height);
  });
}

void interpolate(Vertices vertices, Faces faces, Shaped<const float, -1, -1, -1> attributes, int64_t samples,
                 Shaped<float, -1, -1, -1, -1> values, Shaped<float, -1, -1, -1> coverage,
                 Shaped<int32_t, -1, -1, -1> face) {
  const Frame frame = frame_of(face, 1, samples);
  const int64_t size = frame.width * frame.height, channels = static_cast<int64_t>(attributes.shape(2));
  const int64_t count = static_cast<int64_t>(attributes.shape(1));
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
  m.def("interpolate", &interpolate, arg("vertices").noconvert(), arg("faces").noconvert(),
        arg("attributes").noconvert(), arg("samples"), arg("values").noconvert(), arg("coverage").noconvert(),
        arg("face").noconvert());
  m.def("draw", &draw, arg("vertices").noconvert(), arg("faces").noconvert(), arg("colours").noconvert(),
        arg("samples"), arg("image").noconvert());
}

}  // namespace jaxfit
