// Vectors of sixteen floats, defined for each instruction set. Only silhouette.cc and filtered.cc include this file, and
// both are compiled once for each instruction set.
//
// Everything is in an anonymous namespace, and templates of the standard library are not used. The linker may merge
// equal functions of different object files, which could bring AVX-512 instructions into code for an older processor.
#pragma once

#include <cstdint>

#define INLINE inline __attribute__((always_inline))

namespace {

constexpr int kLanes = 16;
constexpr float kFull = 1e30f;  // products are limited to this value, except on AVX-512, where they may be infinite

// Polynomials of degree four for 2^f on [0, 1) and on [-1/2, 1/2], with a relative error of 2.6e-6.
constexpr float kExpFloor[5] = {1.0000026226043701f, 0.6930038332939148f, 0.2414427548646927f,
                                0.052011460065841675f, 0.013534167781472206f};
constexpr float kExpRound[5] = {0.9999992847442627f, 0.6931217908859253f, 0.240247443318367f,
                                0.05591785907745361f, 0.009570101276040077f};

}  // namespace

// Each of these files defines Vec, Mask and the same functions:
//   bits(m)                       one bit per lane
//   keep(m, a)                    a where m, else 0
//   without(m, n)                 m and not n
//   fma(a, b, c), fms(a, b, c)    a · b + c, a · b - c
//   clamp_to(a, limit)            a clamped to [-limit, limit]
//   negate_if_any_negative(d, …)  -d where one of the other three has a minus sign, else d; for d ≥ 0
//   flip_sign(a, s)               a, negated where s has a minus sign
//   grow(product, e, m)           product · (1 + e) where m, never NaN
//   unequal(p, stride, value)     a 4×4 block of bytes as floats: 1 where the byte is not `value`, else 0
//   reduce12(sums, total)         for each of twelve vectors the sum over its lanes
#if defined(JAXFIT_AVX512)
#include "simd_avx512.h"
#elif defined(JAXFIT_AVX2)
#include "simd_avx2.h"
#else
#include "simd_baseline.h"
#endif
