#include "instruction_set.h"

#if defined(JAXFIT_X86)
#include <cpuid.h>
#endif

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

#if defined(JAXFIT_X86)

struct Features {
  bool avx2, avx512;
};

// Asks the processor, because __builtin_cpu_supports finds no instruction set in programs that Zig compiles.
Features features() {
  constexpr unsigned first = bit_OSXSAVE | bit_AVX | bit_FMA;
  constexpr unsigned avx512 = bit_AVX512F | bit_AVX512BW | bit_AVX512DQ | bit_AVX512VL;
  unsigned a, b, c, d;
  if (!__get_cpuid(1, &a, &b, &c, &d) || (c & first) != first) return {};
  unsigned saved, rest;  // the registers that the operating system saves: bits 1, 2 for AVX; 5, 6, 7 for AVX-512
  __asm__("xgetbv" : "=a"(saved), "=d"(rest) : "c"(0));
  if ((saved & 0x06) != 0x06 || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return {};
  const bool avx2 = (b & bit_AVX2) != 0;
  return {avx2, avx2 && (b & avx512) == avx512 && (saved & 0xe6) == 0xe6};
}

#endif

std::vector<Choice> choices() {
  std::vector<Choice> available;
#if defined(JAXFIT_X86)
  const Features found = features();
  if (found.avx512) available.push_back(choice<Isa::kAvx512>("avx512"));
  if (found.avx2) available.push_back(choice<Isa::kAvx2>("avx2"));
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
