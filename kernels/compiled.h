// The kernels, compiled once for each instruction set.
#pragma once

#include "silhouette.h"
#include "zbuffer.h"

namespace jaxfit {

enum class Isa { kBaseline, kAvx2, kAvx512 };

// silhouette.cc, filtered.cc and zbuffer.cc define these for the instruction set of their compiler flags.
template <Isa isa>
struct Compiled {
  static const Kernels soft_rasterizer, unbiased;
  static const Renderer renderer;
};

template <>
const Kernels Compiled<Isa::kBaseline>::soft_rasterizer;
template <>
const Kernels Compiled<Isa::kBaseline>::unbiased;
template <>
const Renderer Compiled<Isa::kBaseline>::renderer;
template <>
const Kernels Compiled<Isa::kAvx2>::soft_rasterizer;
template <>
const Kernels Compiled<Isa::kAvx2>::unbiased;
template <>
const Renderer Compiled<Isa::kAvx2>::renderer;
template <>
const Kernels Compiled<Isa::kAvx512>::soft_rasterizer;
template <>
const Kernels Compiled<Isa::kAvx512>::unbiased;
template <>
const Renderer Compiled<Isa::kAvx512>::renderer;

namespace {

// The instruction set of the compiler flags. The baseline is what every processor of the platform has: SSE2 on x86-64,
// NEON on 64-bit ARM.
#if defined(__AVX512F__)
constexpr Isa kIsa = Isa::kAvx512;
#elif defined(__AVX2__)
constexpr Isa kIsa = Isa::kAvx2;
#else
constexpr Isa kIsa = Isa::kBaseline;
#endif

}  // namespace
}  // namespace jaxfit
