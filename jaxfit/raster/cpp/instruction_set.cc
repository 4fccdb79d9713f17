#include "instruction_set.h"

#include <atomic>
#include <stdexcept>

#include "compiled.h"

namespace jaxfit {

namespace {

struct Choice {
  const char* name;
  const Kernels* kernels[2];  // by Edge
  const Renderer* renderer;
};

template <Isa isa>
Choice choice(const char* name) {
  using Own = Compiled<isa>;
  return {name, {&Own::soft_rasterizer, &Own::unbiased}, &Own::renderer};
}

std::vector<Choice> choices() {
  std::vector<Choice> available;
#if defined(JAXFIT_X86)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
    available.push_back(choice<Isa::kAvx512>("avx512"));
  if (avx2) available.push_back(choice<Isa::kAvx2>("avx2"));
#endif
  available.push_back(choice<Isa::kBaseline>("baseline"));
  return available;
}

std::atomic<int>& chosen() {
  static std::atomic<int> index{0};
  return index;
}

const std::vector<Choice>& all_choices() {
  static const std::vector<Choice> all = choices();
  return all;
}

}  // namespace

std::vector<std::string> available_isas() {
  std::vector<std::string> names;
  for (const Choice& choice : all_choices()) names.emplace_back(choice.name);
  return names;
}

std::string current_isa() { return all_choices()[chosen()].name; }

const Kernels& current_kernels(Edge edge) { return *all_choices()[chosen()].kernels[static_cast<int32_t>(edge)]; }

const Renderer& current_renderer() { return *all_choices()[chosen()].renderer; }

void choose_isa(const std::string& name) {
  if (name == "auto") {
    chosen() = 0;
    return;
  }
  std::string names = "auto";
  for (size_t i = 0; i < all_choices().size(); ++i) {
    if (name == all_choices()[i].name) {
      chosen() = static_cast<int>(i);
      return;
    }
    names += std::string(", ") + all_choices()[i].name;
  }
  throw std::invalid_argument("instruction set '" + name + "' is not available here: choose one of " + names);
}

}  // namespace jaxfit
