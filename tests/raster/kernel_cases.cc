// Compares the kernels of every instruction set of this processor with stored results of the reference implementations.
// It needs neither Python nor XLA, so it also runs on machines and emulators that have only a C++ compiler:
//
//   kernel_cases kernel_cases.txt
//
// The last check computes all cases again, in several threads: the results have to be the same bits.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <functional>
#include <iostream>
#include <map>
#include <string>
#include <thread>
#include <vector>

#include "edges.h"
#include "instruction_set.h"
#include "parallel.h"

namespace {

using jaxfit::Edge;
using jaxfit::LossKind;

// The numbers of one case by their names. The file has a name, a count and the numbers of each array.
struct Case {
  std::map<std::string, std::vector<float>> arrays;

  const std::vector<float>& floats(const std::string& name) const {
    const auto found = arrays.find(name);
    if (found == arrays.end()) {
      std::cerr << "the file of cases has no '" << name << "'\n";
      std::exit(2);
    }
    return found->second;
  }
  float number(const std::string& name) const { return floats(name).at(0); }
  template <typename T>
  std::vector<T> as(const std::string& name) const {
    return std::vector<T>(floats(name).begin(), floats(name).end());
  }
};

std::vector<Case> read_cases(const char* path) {
  std::ifstream file(path);
  std::vector<Case> cases;
  std::string name;
  size_t count = 0;
  bool complete = true;
  while (complete && file >> name >> count) {
    if (name == "case") {
      cases.emplace_back();
      continue;
    }
    std::vector<float> values(count);
    for (float& value : values) {
      std::string text;  // streams do not read "nan"
      file >> text;
      value = std::strtof(text.c_str(), nullptr);
    }
    complete = !file.fail() && !cases.empty();
    if (complete) cases.back().arrays[name] = std::move(values);
  }
  if (!complete || cases.empty() || !file.eof()) {
    std::cerr << path << ": is not a complete file of cases\n";
    std::exit(2);
  }
  return cases;
}

// What the kernels compute for one case, by the names of the stored results.
using Results = std::map<std::string, std::vector<float>>;

Results compute(const Case& own) {
  const auto faces = own.as<int32_t>("faces");
  const auto& vertices = own.floats("vertices");
  const int64_t num_vertices = static_cast<int64_t>(vertices.size()) / 3;
  const int64_t num_faces = static_cast<int64_t>(faces.size()) / 3;
  const jaxfit::EdgeTable edges(faces.data(), num_faces, num_vertices);
  const jaxfit::Mesh mesh{vertices.data(), faces.data(), num_vertices, num_faces, edges.view()};
  const jaxfit::Blur blur{own.number("sigma"), own.number("radius")};
  const int64_t size = static_cast<int64_t>(own.number("size"));
  const auto target = own.as<uint8_t>("target");
  const jaxfit::Kernels& kernels = jaxfit::current_kernels(static_cast<Edge>(static_cast<int>(own.number("edge"))));
  void* memory = jaxfit::scratch(kernels.workspace(mesh, blur, size));
  Results results;

  auto& image = results["silhouette"];
  image.resize(static_cast<size_t>(size * size));
  kernels.silhouette(mesh, blur, size, memory, image.data());
  auto& pull = results["pull"];
  pull.resize(vertices.size());
  kernels.silhouette_gradient(mesh, blur, size, memory, own.floats("cotangent").data(), pull.data());

  const auto joint = own.as<int32_t>("joint");
  const int64_t parameters = static_cast<int64_t>(own.number("parameters"));
  const jaxfit::Skin skin{own.floats("rest").data(),
                          joint.data(),
                          own.floats("skin_weight").data(),
                          own.floats("transforms").data(),
                          own.floats("generators").data(),
                          own.floats("moved").data(),
                          own.floats("view").data(),
                          own.floats("shape").data(),
                          static_cast<int64_t>(joint.size()) / num_vertices,
                          static_cast<int64_t>(own.number("transforming")),
                          parameters,
                          own.number("focal"),
                          own.number("centre")};
  auto& block = results["block"];
  block.resize(static_cast<size_t>(parameters * parameters));
  for (const LossKind kind : {LossKind::kL1, LossKind::kSmoothL1}) {
    const std::string name = kind == LossKind::kL1 ? "l1" : "smooth_l1";
    auto& loss = results[name];
    auto& gradient = results[name + "_gradient"];
    loss.resize(1);
    gradient.resize(vertices.size());
    // both ways: the loss and the gradient alone, and with the block
    const bool alone = kind == LossKind::kL1;
    memory = jaxfit::scratch(alone ? kernels.workspace(mesh, blur, size)
                                   : kernels.block_workspace(mesh, skin, blur, size));
    kernels.mask_loss(mesh, blur, size, memory, {target.data(), nullptr}, kind, loss.data(), gradient.data(),
                      alone ? nullptr : &skin, alone ? nullptr : block.data());
  }

  const jaxfit::Renderer& renderer = jaxfit::current_renderer();
  const jaxfit::Frame frame{size, size, 1};
  const jaxfit::Rows rows{0, size};
  std::vector<int32_t> face(image.size());
  std::vector<float> barycentric(3 * image.size());
  auto& depth = results["depth"];
  depth.resize(image.size());
  memory = jaxfit::scratch(renderer.workspace(mesh, frame, rows));
  renderer.fragments(mesh, frame, rows, memory, face.data(), barycentric.data(), depth.data());
  for (float& value : depth) value = std::isinf(value) ? 0 : value;
  results["face"].assign(face.begin(), face.end());
  return results;
}

// The greatest difference, as a share of the greatest stored number.
double error_of(const std::vector<float>& found, const std::vector<float>& stored) {
  if (found.size() != stored.size()) return HUGE_VAL;
  double greatest = 0, scale = 0;
  for (size_t i = 0; i < stored.size(); ++i) {
    if (std::isnan(found[i]) != std::isnan(stored[i])) return HUGE_VAL;
    if (std::isnan(found[i])) continue;
    greatest = std::max(greatest, std::fabs(static_cast<double>(found[i]) - static_cast<double>(stored[i])));
    scale = std::max(scale, std::fabs(static_cast<double>(stored[i])));
  }
  return scale > 0 ? greatest / scale : greatest;
}

// The largest error that passes. The faces of the z-buffer have to be equal.
double limit_of(const std::string& name) { return name == "face" ? 0 : name == "block" ? 2e-4 : 5e-5; }

// Threads for `for_each_task`.
class Threads {
 public:
  ~Threads() {
    for (std::thread& thread : started_) thread.join();
  }
  int64_t num_threads() const { return 4; }
  void Schedule(std::function<void()> work) { started_.emplace_back(std::move(work)); }

 private:
  std::vector<std::thread> started_;
};

bool same_bits(const Results& a, const Results& b) {
  for (const auto& [name, values] : a) {
    const std::vector<float>& other = b.at(name);
    if (!std::equal(values.begin(), values.end(), other.begin(), other.end(),
                    [](float x, float y) { return x == y || (std::isnan(x) && std::isnan(y)); }))
      return false;
  }
  return true;
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 2) {
    std::cerr << "usage: kernel_cases FILE\n";
    return 2;
  }
  const std::vector<Case> cases = read_cases(arguments[1]);
  bool passed = true;
  for (const std::string& isa : jaxfit::available_isas()) {
    jaxfit::choose_isa(isa);
    std::map<std::string, double> errors;
    std::vector<Results> serial;
    for (const Case& own : cases) {
      serial.push_back(compute(own));
      for (const auto& [name, values] : serial.back())
        errors[name] = std::max(errors[name], error_of(values, own.floats(name)));
    }
    for (const auto& [name, error] : errors) {
      const bool good = error <= limit_of(name);
      passed = passed && good;
      std::printf("%s %s %.1e %s\n", isa.c_str(), name.c_str(), error, good ? "ok" : "WRONG");
    }
    std::vector<Results> threaded(4 * cases.size());
    {
      Threads threads;
      jaxfit::for_each_task(threads, static_cast<int64_t>(threaded.size()), [&](int64_t i) {
        threaded[static_cast<size_t>(i)] = compute(cases[static_cast<size_t>(i) % cases.size()]);
      });
    }
    bool same = true;
    for (size_t i = 0; i < threaded.size(); ++i) same = same && same_bits(serial[i % cases.size()], threaded[i]);
    passed = passed && same;
    std::printf("%s threads - %s\n", isa.c_str(), same ? "ok" : "WRONG");
  }
  return passed ? 0 : 1;
}
