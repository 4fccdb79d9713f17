// A register of floats of one instruction set, and the operations that the vector types of GCC and Clang lack. The kernels
// are compiled once for each instruction set, whose flags decide which part of this file is used. The compiler knows the
// arithmetic (+ - * /) of registers.
//
// Everything is in an anonymous namespace, and templates of the standard library are not used. The linker may merge
// equal functions of different object files, which could bring AVX-512 instructions into code for an older processor.
#pragma once

#include <cstdint>

#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

namespace jaxfit {
namespace {

constexpr int kLanes = 16;      // pixels of a block, and faces that are prepared together
constexpr float kFull = 1e30f;  // the limit of products

// Defined for each instruction set:
//   Vec, Ints            a register of floats, and one of as many integers
//   Mask                 one truth value for each lane of a register
//   min, max             of a and b; b where one of them is NaN
//   sqrt(a)
//   fma(a, b, c)         a · b + c, rounded once where the processor can
//   fms(a, b, c)         a · b - c, likewise
//   greater(a, b)        a > b
//   at_most(a, b)        a ≤ b
//   keep(m, a)           a where m, else 0
//   select(m, a, b)      a where m, else b
//   bits(m)              one bit for each lane
//   clamp_to(a, limit)   a clamped to [-limit, limit]
//   reciprocal(a)        1 / a, with a relative error of at most 2^-28
//   exp2(a)              2^a with a relative error of 2.6e-6; for a > 60 at least 2^60

// Coefficients of a polynomial for 2^a on [-1/2, 1/2].
constexpr float kPower[5] = {0.9999992847442627f, 0.6931217908859253f, 0.240247443318367f, 0.05591785907745361f,
                             0.009570101276040077f};

#if defined(__AVX512F__)

typedef __m512 Vec;
typedef int32_t Ints __attribute__((vector_size(64)));

[[gnu::always_inline]] inline Vec min(Vec a, Vec b) { return _mm512_min_ps(a, b); }
[[gnu::always_inline]] inline Vec max(Vec a, Vec b) { return _mm512_max_ps(a, b); }
[[gnu::always_inline]] inline Vec sqrt(Vec a) { return _mm512_sqrt_ps(a); }
[[gnu::always_inline]] inline Vec fma(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a, b, c); }
[[gnu::always_inline]] inline Vec fms(Vec a, Vec b, Vec c) { return _mm512_fmsub_ps(a, b, c); }

#elif defined(__AVX2__)

typedef __m256 Vec;
typedef int32_t Ints __attribute__((vector_size(32)));

[[gnu::always_inline]] inline Vec min(Vec a, Vec b) { return _mm256_min_ps(a, b); }
[[gnu::always_inline]] inline Vec max(Vec a, Vec b) { return _mm256_max_ps(a, b); }
[[gnu::always_inline]] inline Vec sqrt(Vec a) { return _mm256_sqrt_ps(a); }
[[gnu::always_inline]] inline Vec fma(Vec a, Vec b, Vec c) { return _mm256_fmadd_ps(a, b, c); }
[[gnu::always_inline]] inline Vec fms(Vec a, Vec b, Vec c) { return _mm256_fmsub_ps(a, b, c); }
[[gnu::always_inline]] inline uint32_t bits(Ints m) { return static_cast<uint32_t>(_mm256_movemask_ps((Vec)m)); }

#elif defined(__SSE2__)

typedef __m128 Vec;
typedef int32_t Ints __attribute__((vector_size(16)));

[[gnu::always_inline]] inline Vec min(Vec a, Vec b) { return _mm_min_ps(a, b); }
[[gnu::always_inline]] inline Vec max(Vec a, Vec b) { return _mm_max_ps(a, b); }
[[gnu::always_inline]] inline Vec sqrt(Vec a) { return _mm_sqrt_ps(a); }
[[gnu::always_inline]] inline Vec fma(Vec a, Vec b, Vec c) { return a * b + c; }
[[gnu::always_inline]] inline Vec fms(Vec a, Vec b, Vec c) { return a * b - c; }
[[gnu::always_inline]] inline uint32_t bits(Ints m) { return static_cast<uint32_t>(_mm_movemask_ps((Vec)m)); }

#else  // NEON on ARM; elsewhere what the compiler makes of vectors of four floats

typedef float Vec __attribute__((vector_size(16)));
typedef int32_t Ints __attribute__((vector_size(16)));

[[gnu::always_inline]] inline Vec min(Vec a, Vec b) { return a < b ? a : b; }
[[gnu::always_inline]] inline Vec max(Vec a, Vec b) { return a > b ? a : b; }
[[gnu::always_inline]] inline uint32_t bits(Ints m) {
  const Ints own = m & Ints{1, 2, 4, 8};
  return static_cast<uint32_t>((own[0] | own[1]) | (own[2] | own[3]));
}
#if defined(__ARM_NEON) && defined(__aarch64__)
[[gnu::always_inline]] inline Vec sqrt(Vec a) { return vsqrtq_f32(a); }
[[gnu::always_inline]] inline Vec fma(Vec a, Vec b, Vec c) { return vfmaq_f32(c, a, b); }
#else
[[gnu::always_inline]] inline Vec sqrt(Vec a) {
  return Vec{__builtin_sqrtf(a[0]), __builtin_sqrtf(a[1]), __builtin_sqrtf(a[2]), __builtin_sqrtf(a[3])};
}
[[gnu::always_inline]] inline Vec fma(Vec a, Vec b, Vec c) { return a * b + c; }
#endif
[[gnu::always_inline]] inline Vec fms(Vec a, Vec b, Vec c) { return fma(a, b, -c); }

#endif

constexpr int kWidth = sizeof(Vec) / sizeof(float);

// Unlike Vec{} + a, this needs no addition, because a - 0 is a also for a = -0.
[[gnu::always_inline]] inline Vec all(float a) { return a - Vec{}; }

[[gnu::always_inline]] inline Vec load(const float* p) {
  Vec a;
  __builtin_memcpy(&a, p, sizeof a);
  return a;
}

[[gnu::always_inline]] inline void store(float* p, Vec a) { __builtin_memcpy(p, &a, sizeof a); }

// 2^a for a in [-1/2, 1/2].
[[gnu::always_inline]] inline Vec exp2_of_fraction(Vec a) {
  const Vec high = fma(fma(a, all(kPower[4]), all(kPower[3])), a, all(kPower[2]));
  return fma(fma(high, a, all(kPower[1])), a, all(kPower[0]));
}

#if defined(__AVX512F__)

typedef __mmask16 Mask;

[[gnu::always_inline]] inline Mask greater(Vec a, Vec b) { return _mm512_cmp_ps_mask(a, b, _CMP_GT_OQ); }
[[gnu::always_inline]] inline Mask at_most(Vec a, Vec b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
[[gnu::always_inline]] inline Vec keep(Mask m, Vec a) { return _mm512_maskz_mov_ps(m, a); }
[[gnu::always_inline]] inline Vec select(Mask m, Vec a, Vec b) { return _mm512_mask_blend_ps(m, b, a); }
[[gnu::always_inline]] inline uint32_t bits(Mask m) { return m; }
[[gnu::always_inline]] inline Vec clamp_to(Vec a, Vec limit) {
  return _mm512_range_ps(a, limit, 2);  // the smaller magnitude, with the sign of a
}
[[gnu::always_inline]] inline Vec reciprocal(Vec a) {
  const Vec near = _mm512_rcp14_ps(a);
  return near * _mm512_fnmadd_ps(a, near, _mm512_set1_ps(2.f));  // a Newton step
}
[[gnu::always_inline]] inline Vec exp2(Vec a) {
  const Vec whole = _mm512_roundscale_ps(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  return _mm512_scalef_ps(exp2_of_fraction(a - whole), whole);
}

#else

typedef Ints Mask;  // all bits of a lane are set, or none

[[gnu::always_inline]] inline Mask greater(Vec a, Vec b) { return (Ints)(a > b); }
[[gnu::always_inline]] inline Mask at_most(Vec a, Vec b) { return (Ints)(a <= b); }
[[gnu::always_inline]] inline Vec keep(Mask m, Vec a) { return (Vec)(m & (Ints)a); }
#if defined(__AVX2__)
[[gnu::always_inline]] inline Vec select(Mask m, Vec a, Vec b) { return _mm256_blendv_ps(b, a, (Vec)m); }
#else
[[gnu::always_inline]] inline Vec select(Mask m, Vec a, Vec b) { return (Vec)((m & (Ints)a) | (~m & (Ints)b)); }
#endif
[[gnu::always_inline]] inline Vec clamp_to(Vec a, Vec limit) { return max(min(a, limit), -limit); }
[[gnu::always_inline]] inline Vec reciprocal(Vec a) { return 1.f / a; }
[[gnu::always_inline]] inline Vec exp2(Vec a) {
  a = max(min(a, all(60.f)), all(-126.f));
  const Vec shifted = a + 12582912.f;  // 1.5 · 2^23: the sum is rounded to a whole number, and its low bits hold it
  return (Vec)((Ints)exp2_of_fraction(a - (shifted - 12582912.f)) + ((Ints)shifted << 23));
}

#endif

[[gnu::always_inline]] inline Vec abs(Vec a) { return (Vec)((Ints)a & INT32_MAX); }

// a, negated where s has a minus sign.
[[gnu::always_inline]] inline Vec flip_sign(Vec a, Vec s) { return (Vec)((Ints)a ^ ((Ints)s & INT32_MIN)); }

// product · (1 + e) where m, at most kFull. Without the limit, the infinite product of another lane would become NaN.
[[gnu::always_inline]] inline Vec grow(Vec product, Vec e, Mask m) {
  return min(fma(product, keep(m, e), product), all(kFull));
}

[[gnu::always_inline]] inline float sum(Vec a) {
  typedef float Quad __attribute__((vector_size(16)));
  Quad parts[kWidth / 4];
  __builtin_memcpy(parts, &a, sizeof a);
  Quad total = parts[0];
  for (int i = 1; i < kWidth / 4; ++i) total += parts[i];
  return (total[0] + total[2]) + (total[1] + total[3]);
}

}  // namespace
}  // namespace jaxfit
