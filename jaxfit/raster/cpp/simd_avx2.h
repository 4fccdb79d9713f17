// Sixteen lanes in two AVX2 registers. simd.h includes this file.
#pragma once

#include <immintrin.h>

namespace {

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
INLINE Vec fms(Vec x, Vec y, Vec z) { return {_mm256_fmsub_ps(x.a, y.a, z.a), _mm256_fmsub_ps(x.b, y.b, z.b)}; }
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

INLINE Vec clamp_to(Vec x, Vec limit) { return max(min(x, limit), all(0.f) - limit); }
INLINE Vec negate_unless_any_negative(Vec d, Vec x, Vec y, Vec z) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_or_ps(d.a, _mm256_andnot_ps(_mm256_or_ps(_mm256_or_ps(x.a, y.a), z.a), sign)),
          _mm256_or_ps(d.b, _mm256_andnot_ps(_mm256_or_ps(_mm256_or_ps(x.b, y.b), z.b), sign))};
}
INLINE Vec negate_if_any_negative(Vec d, Vec x, Vec y, Vec z) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_or_ps(d.a, _mm256_and_ps(_mm256_or_ps(_mm256_or_ps(x.a, y.a), z.a), sign)),
          _mm256_or_ps(d.b, _mm256_and_ps(_mm256_or_ps(_mm256_or_ps(x.b, y.b), z.b), sign))};
}
INLINE Vec flip_sign(Vec x, Vec s) {
  const __m256 sign = _mm256_set1_ps(-0.0f);
  return {_mm256_xor_ps(x.a, _mm256_and_ps(sign, s.a)), _mm256_xor_ps(x.b, _mm256_and_ps(sign, s.b))};
}
INLINE __m256 scale_exp2(__m256 p, __m256 n) {  // n has an offset of 1.5 · 2^23, so its low bits hold the exponent
  return _mm256_castsi256_ps(
      _mm256_add_epi32(_mm256_castps_si256(p), _mm256_slli_epi32(_mm256_castps_si256(n), 23)));
}
INLINE Vec exp2(Vec x) {
  x = min(max(x, all(-126.f)), all(60.f));
  const Vec n = x + all(12582912.0f);
  const Vec f = x - (n - all(12582912.0f));
  const Vec half = fma(fma(f, all(kExpRound[4]), all(kExpRound[3])), f, all(kExpRound[2]));
  const Vec p = fma(fma(half, f, all(kExpRound[1])), f, all(kExpRound[0]));
  return {scale_exp2(p.a, n.a), scale_exp2(p.b, n.b)};
}
INLINE Vec grow(Vec product, Vec e, Mask m) {
  return min(fma_where(m, product, e, product), all(kFull));
}
INLINE Vec reciprocal(Vec x) { return all(1.0f) / x; }
INLINE float sum(Vec x) {
  const __m256 h = _mm256_add_ps(x.a, x.b);
  const __m128 q = _mm_add_ps(_mm256_castps256_ps128(h), _mm256_extractf128_ps(h, 1));
  const __m128 p = _mm_add_ps(q, _mm_movehl_ps(q, q));
  return _mm_cvtss_f32(_mm_add_ss(p, _mm_shuffle_ps(p, p, 1)));
}
INLINE Vec unequal(const uint8_t* p, int64_t stride, uint8_t value) {
  int32_t r[4];
  for (int i = 0; i < 4; ++i) __builtin_memcpy(&r[i], p + i * stride, 4);
  const __m128i zero = _mm_setzero_si128();
  const __m128i equal = _mm_cmpeq_epi8(_mm_set_epi32(r[3], r[2], r[1], r[0]), _mm_set1_epi8(static_cast<char>(value)));
  const __m128i other = _mm_andnot_si128(equal, _mm_set1_epi8(1));
  return {_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(other)),
          _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_unpackhi_epi64(other, zero)))};
}
INLINE void reduce12(const Vec sums[12], float total[16]) {
  for (int i = 0; i < 3; ++i) {
    __m256 h[4];
    for (int j = 0; j < 4; ++j) h[j] = _mm256_add_ps(sums[4 * i + j].a, sums[4 * i + j].b);
    const __m256 t = _mm256_hadd_ps(_mm256_hadd_ps(h[0], h[1]), _mm256_hadd_ps(h[2], h[3]));
    _mm_store_ps(total + 4 * i, _mm_add_ps(_mm256_castps256_ps128(t), _mm256_extractf128_ps(t, 1)));
  }
}

}  // namespace
