// Sixteen float lanes, spelt once for each instruction set. Included by silhouette.cc only, which is compiled once a set.
//
// Everything is in an anonymous namespace and nothing here uses the standard library's templates: a function that
// the linker may share between the sets could otherwise carry AVX-512 into the code for an older processor.
#pragma once

#include <cstdint>

#if defined(JAXFIT_AVX512) || defined(JAXFIT_AVX2)
#include <immintrin.h>
#endif

#define INLINE inline __attribute__((always_inline))

namespace {

constexpr int kLanes = 16;

// 2^f to 2.6e-6 (relative) by a quartic, on [0, 1) and on [-1/2, 1/2].
constexpr float kExpFloor[5] = {1.0000026226043701f, 0.6930038332939148f, 0.2414427548646927f,
                                0.052011460065841675f, 0.013534167781472206f};
constexpr float kExpRound[5] = {0.9999992847442627f, 0.6931217908859253f, 0.240247443318367f,
                                0.05591785907745361f, 0.009570101276040077f};

#if defined(JAXFIT_AVX512)

struct Vec { __m512 v; };
struct Mask { __mmask16 m; };

INLINE Vec load(const float* p) { return {_mm512_loadu_ps(p)}; }
INLINE void store(float* p, Vec a) { _mm512_storeu_ps(p, a.v); }
INLINE Vec all(float a) { return {_mm512_set1_ps(a)}; }
INLINE Vec operator+(Vec a, Vec b) { return {_mm512_add_ps(a.v, b.v)}; }
INLINE Vec operator-(Vec a, Vec b) { return {_mm512_sub_ps(a.v, b.v)}; }
INLINE Vec operator*(Vec a, Vec b) { return {_mm512_mul_ps(a.v, b.v)}; }
INLINE Vec operator/(Vec a, Vec b) { return {_mm512_div_ps(a.v, b.v)}; }
INLINE Vec fma(Vec a, Vec b, Vec c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
INLINE Vec min(Vec a, Vec b) { return {_mm512_min_ps(a.v, b.v)}; }
INLINE Vec max(Vec a, Vec b) { return {_mm512_max_ps(a.v, b.v)}; }
INLINE Vec sqrt(Vec a) { return {_mm512_sqrt_ps(a.v)}; }
INLINE Vec abs(Vec a) { return {_mm512_abs_ps(a.v)}; }
INLINE Mask operator>(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
INLINE Mask operator<=(Vec a, Vec b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
INLINE Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & b.m)}; }
INLINE Mask without(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & ~b.m)}; }
INLINE uint32_t bits(Mask a) { return a.m; }
INLINE Vec select(Mask m, Vec a, Vec b) { return {_mm512_mask_blend_ps(m.m, b.v, a.v)}; }
INLINE Vec keep(Mask m, Vec a) { return {_mm512_maskz_mov_ps(m.m, a.v)}; }
INLINE Vec fma_where(Mask m, Vec a, Vec b, Vec c) { return {_mm512_mask3_fmadd_ps(a.v, b.v, c.v, m.m)}; }
INLINE Vec mul_where(Mask m, Vec a, Vec b) { return {_mm512_maskz_mul_ps(m.m, a.v, b.v)}; }

// d ≥ 0 with a minus sign where any of a, b, c has one.
INLINE Vec with_signs(Vec d, Vec a, Vec b, Vec c) {
  const __m512i any = _mm512_ternarylogic_epi32(_mm512_castps_si512(a.v), _mm512_castps_si512(b.v),
                                                _mm512_castps_si512(c.v), 0xFE);
  return {_mm512_castsi512_ps(_mm512_ternarylogic_epi32(_mm512_castps_si512(d.v), any,
                                                        _mm512_set1_epi32(INT32_MIN), 0xF8))};
}
// a, its sign flipped where s is negative.
INLINE Vec flip_sign(Vec a, Vec s) {
  return {_mm512_castsi512_ps(_mm512_ternarylogic_epi32(_mm512_castps_si512(a.v), _mm512_castps_si512(s.v),
                                                        _mm512_set1_epi32(INT32_MIN), 0x78))};
}
INLINE Vec exp2(Vec x) {
  const Vec f = {_mm512_reduce_ps(x.v, 0x01)};
  const Vec half = fma(fma(f, all(kExpFloor[4]), all(kExpFloor[3])), f, all(kExpFloor[2]));
  const Vec p = fma(fma(half, f, all(kExpFloor[1])), f, all(kExpFloor[0]));
  return {_mm512_scalef_ps(p.v, x.v)};
}
// P (1 + e) where m; an infinite product stays so.
INLINE Vec grow(Vec product, Vec e, Mask m, float) { return fma_where(m, product, e, product); }
INLINE Vec reciprocal(Vec a) {  // one Newton step: 2^-28
  const Vec r = {_mm512_rcp14_ps(a.v)};
  return r * Vec{_mm512_fnmadd_ps(a.v, r.v, _mm512_set1_ps(2.0f))};
}
INLINE Vec from_bytes(const uint8_t* p, int64_t stride) {  // a 4×4 block: 1 where the byte is not zero
  int32_t r[4];
  for (int i = 0; i < 4; ++i) __builtin_memcpy(&r[i], p + i * stride, 4);
  const __m128i b = _mm_set_epi32(r[3], r[2], r[1], r[0]);
  return {_mm512_maskz_mov_ps(_mm_test_epi8_mask(b, b), _mm512_set1_ps(1.0f))};
}

#elif defined(JAXFIT_AVX2)

struct Vec { __m256 a, b; };
struct Mask { __m256 a, b; };

INLINE Vec load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
INLINE void store(float* p, Vec v) { _mm256_storeu_ps(p, v.a), _mm256_storeu_ps(p + 8, v.b); }
INLINE Vec all(float s) { const __m256 v = _mm256_set1_ps(s); return {v, v}; }
INLINE Vec operator+(Vec x, Vec y) { return {_mm256_add_ps(x.a, y.a), _mm256_add_ps(x.b, y.b)}; }
INLINE Vec operator-(Vec x, Vec y) { return {_mm256_sub_ps(x.a, y.a), _mm256_sub_ps(x.b, y.b)}; }
INLINE Vec operator*(Vec x, Vec y) { return {_mm256_mul_ps(x.a, y.a), _mm256_mul_ps(x.b, y.b)}; }
INLINE Vec operator/(Vec x, Vec y) { return {_mm256_div_ps(x.a, y.a), _mm256_div_ps(x.b, y.b)}; }
INLINE Vec fma(Vec x, Vec y, Vec z) { return {_mm256_fmadd_ps(x.a, y.a, z.a), _mm256_fmadd_ps(x.b, y.b, z.b)}; }
INLINE Vec min(Vec x, Vec y) { return {_mm256_min_ps(x.a, y.a), _mm256_min_ps(x.b, y.b)}; }
INLINE Vec max(Vec x, Vec y) { return {_mm256_max_ps(x.a, y.a), _mm256_max_ps(x.b, y.b)}; }
INLINE Vec sqrt(Vec x) { return {_mm256_sqrt_ps(x.a), _mm256_sqrt_ps(x.b)}; }
INLINE Vec abs(Vec x) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_andnot_ps(sign, x.a), _mm256_andnot_ps(sign, x.b)};
}
INLINE Mask operator>(Vec x, Vec y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_GT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GT_OQ)};
}
INLINE Mask operator<=(Vec x, Vec y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_LE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LE_OQ)};
}
INLINE Mask operator&(Mask x, Mask y) { return {_mm256_and_ps(x.a, y.a), _mm256_and_ps(x.b, y.b)}; }
INLINE Mask without(Mask x, Mask y) { return {_mm256_andnot_ps(y.a, x.a), _mm256_andnot_ps(y.b, x.b)}; }
INLINE uint32_t bits(Mask m) {
  return static_cast<uint32_t>(_mm256_movemask_ps(m.a)) | static_cast<uint32_t>(_mm256_movemask_ps(m.b)) << 8;
}
INLINE Vec select(Mask m, Vec x, Vec y) {
  return {_mm256_blendv_ps(y.a, x.a, m.a), _mm256_blendv_ps(y.b, x.b, m.b)};
}
INLINE Vec keep(Mask m, Vec x) { return {_mm256_and_ps(m.a, x.a), _mm256_and_ps(m.b, x.b)}; }
INLINE Vec fma_where(Mask m, Vec x, Vec y, Vec z) { return fma(x, keep(m, y), z); }
INLINE Vec mul_where(Mask m, Vec x, Vec y) { return keep(m, x * y); }

INLINE Vec with_signs(Vec d, Vec x, Vec y, Vec z) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_or_ps(d.a, _mm256_and_ps(sign, _mm256_or_ps(_mm256_or_ps(x.a, y.a), z.a))),
          _mm256_or_ps(d.b, _mm256_and_ps(sign, _mm256_or_ps(_mm256_or_ps(x.b, y.b), z.b)))};
}
INLINE Vec flip_sign(Vec x, Vec s) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_xor_ps(x.a, _mm256_and_ps(sign, s.a)), _mm256_xor_ps(x.b, _mm256_and_ps(sign, s.b))};
}
INLINE __m256 scale_exp2(__m256 p, __m256 n) {  // n is shifted by 1.5 · 2^23, so its low bits hold the exponent
  return _mm256_castsi256_ps(
      _mm256_add_epi32(_mm256_castps_si256(p), _mm256_slli_epi32(_mm256_castps_si256(n), 23)));
}
INLINE Vec exp2(Vec x) {
  x = max(x, all(-126.f));
  const Vec n = x + all(12582912.0f);
  const Vec f = x - (n - all(12582912.0f));
  const Vec half = fma(fma(f, all(kExpRound[4]), all(kExpRound[3])), f, all(kExpRound[2]));
  const Vec p = fma(fma(half, f, all(kExpRound[1])), f, all(kExpRound[0]));
  return {scale_exp2(p.a, n.a), scale_exp2(p.b, n.b)};
}
INLINE Vec grow(Vec product, Vec e, Mask m, float full) {
  return min(fma_where(m, product, e, product), all(full));
}
INLINE Vec reciprocal(Vec x) { return all(1.0f) / x; }
INLINE Vec from_bytes(const uint8_t* p, int64_t stride) {
  float r[16];
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) r[4 * i + j] = p[i * stride + j] ? 1.0f : 0.0f;
  return load(r);
}

#else  // GNU vectors: SSE2 on x86, NEON on ARM, whatever there is elsewhere

typedef float Floats __attribute__((vector_size(64), aligned(4)));
typedef int32_t Ints __attribute__((vector_size(64)));

struct Vec { Floats v; };
struct Mask { Ints m; };

INLINE Ints as_ints(Floats v) { return (Ints)v; }
INLINE Floats as_floats(Ints v) { return (Floats)v; }
INLINE Vec load(const float* p) { Vec r; __builtin_memcpy(&r, p, 64); return r; }
INLINE void store(float* p, Vec a) { __builtin_memcpy(p, &a, 64); }
INLINE Vec all(float a) { return {Floats{} + a}; }
INLINE Vec operator+(Vec a, Vec b) { return {a.v + b.v}; }
INLINE Vec operator-(Vec a, Vec b) { return {a.v - b.v}; }
INLINE Vec operator*(Vec a, Vec b) { return {a.v * b.v}; }
INLINE Vec operator/(Vec a, Vec b) { return {a.v / b.v}; }
INLINE Vec fma(Vec a, Vec b, Vec c) { return {a.v * b.v + c.v}; }
INLINE Vec blend(Ints m, Vec a, Vec b) { return {as_floats((m & as_ints(a.v)) | (~m & as_ints(b.v)))}; }
INLINE Vec min(Vec a, Vec b) { return blend(a.v < b.v, a, b); }
INLINE Vec max(Vec a, Vec b) { return blend(a.v > b.v, a, b); }
INLINE Vec sqrt(Vec a) {
  for (int i = 0; i < kLanes; ++i) a.v[i] = __builtin_sqrtf(a.v[i]);
  return a;
}
INLINE Vec abs(Vec a) { return {as_floats(as_ints(a.v) & INT32_MAX)}; }
INLINE Mask operator>(Vec a, Vec b) { return {a.v > b.v}; }
INLINE Mask operator<=(Vec a, Vec b) { return {a.v <= b.v}; }
INLINE Mask operator&(Mask a, Mask b) { return {a.m & b.m}; }
INLINE Mask without(Mask a, Mask b) { return {a.m & ~b.m}; }
INLINE uint32_t bits(Mask a) {
  uint32_t r = 0;
  for (int i = 0; i < kLanes; ++i) r |= static_cast<uint32_t>(a.m[i] & 1) << i;
  return r;
}
INLINE Vec select(Mask m, Vec a, Vec b) { return blend(m.m, a, b); }
INLINE Vec keep(Mask m, Vec a) { return {as_floats(m.m & as_ints(a.v))}; }
INLINE Vec fma_where(Mask m, Vec a, Vec b, Vec c) { return fma(a, keep(m, b), c); }
INLINE Vec mul_where(Mask m, Vec a, Vec b) { return keep(m, a * b); }
INLINE Vec with_signs(Vec d, Vec a, Vec b, Vec c) {
  return {as_floats(as_ints(d.v) | ((as_ints(a.v) | as_ints(b.v) | as_ints(c.v)) & INT32_MIN))};
}
INLINE Vec flip_sign(Vec a, Vec s) { return {as_floats(as_ints(a.v) ^ (as_ints(s.v) & INT32_MIN))}; }
INLINE Vec exp2(Vec x) {
  x = max(x, all(-126.f));
  const Vec n = x + all(12582912.0f);
  const Vec f = x - (n - all(12582912.0f));
  const Vec half = fma(fma(f, all(kExpRound[4]), all(kExpRound[3])), f, all(kExpRound[2]));
  const Vec p = fma(fma(half, f, all(kExpRound[1])), f, all(kExpRound[0]));
  return {as_floats(as_ints(p.v) + (as_ints(n.v) << 23))};
}
INLINE Vec grow(Vec product, Vec e, Mask m, float full) {
  return min(fma_where(m, product, e, product), all(full));
}
INLINE Vec reciprocal(Vec a) { return all(1.0f) / a; }
INLINE Vec from_bytes(const uint8_t* p, int64_t stride) {
  float r[16];
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) r[4 * i + j] = p[i * stride + j] ? 1.0f : 0.0f;
  return load(r);
}

#endif

INLINE void reduce12(const Vec sums[12], float total[16]) {
  for (int i = 0; i < 12; ++i) {
    float lane[kLanes];
    store(lane, sums[i]);
    float s = 0;
    for (int j = 0; j < kLanes; ++j) s += lane[j];
    total[i] = s;
  }
}

}  // namespace
