// Sixteen float lanes, spelt once for each instruction set. Included by silhouette.cc only, which is compiled once a set.
//
// Everything is in an anonymous namespace and nothing here uses the standard library's templates: a function that
// the linker may share between the sets could otherwise carry AVX-512 into the code for an older processor.
#pragma once

#include <cstdint>

#define INLINE inline __attribute__((always_inline))

namespace {

constexpr int kLanes = 16;
constexpr float kFull = 1e30f;  // products are held below this, or at infinity

// 2^f to 2.6e-6 (relative) by a quartic, on [0, 1) and on [-1/2, 1/2].
constexpr float kExpFloor[5] = {1.0000026226043701f, 0.6930038332939148f, 0.2414427548646927f,
                                0.052011460065841675f, 0.013534167781472206f};
constexpr float kExpRound[5] = {0.9999992847442627f, 0.6931217908859253f, 0.240247443318367f,
                                0.05591785907745361f, 0.009570101276040077f};

}  // namespace

// Each of these defines Vec, Mask and the same functions of them. Where a name does not say it all:
//   bits(m)                       a bit a lane
//   keep(m, a)                    a where m, else 0
//   without(m, n)                 m and not n
//   fma(a, b, c), fms(a, b, c)    a · b + c, a · b - c
//   clamp_to(a, limit)            a held to [-limit, limit]
//   negate_if_any_negative(d, …)  -d where one of the three has a minus sign, else d; d ≥ 0
//   flip_sign(a, s)               a, negated where s has a minus sign
//   grow(product, e, m)           product · (1 + e) where m, never NaN
//   from_bytes(p, stride)         a 4×4 block of bytes: 1 where one is not 0
//   reduce12(sums, total)         the twelve vectors' sums over their lanes
#if defined(JAXFIT_AVX512)
#include "simd_avx512.h"
#elif defined(JAXFIT_AVX2)
#include "simd_avx2.h"
#else
#include "simd_baseline.h"
#endif
