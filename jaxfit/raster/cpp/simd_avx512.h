// Sixteen lanes in one AVX-512 register. simd.h includes this file.
#pragma once

#include <immintrin.h>

namespace {

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
INLINE Vec fms(Vec a, Vec b, Vec c) { return {_mm512_fmsub_ps(a.v, b.v, c.v)}; }
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

// a clamped to [-limit, limit].
INLINE Vec clamp_to(Vec a, Vec limit) { return {_mm512_range_ps(a.v, limit.v, 0x2)}; }
// For d ≥ 0: d where any of a, b, c has a minus sign, else -d.
INLINE Vec negate_unless_any_negative(Vec d, Vec a, Vec b, Vec c) {
  const __m512i any = _mm512_ternarylogic_epi32(_mm512_castps_si512(a.v), _mm512_castps_si512(b.v),
                                                _mm512_castps_si512(c.v), 0xFE);
  return {_mm512_castsi512_ps(_mm512_ternarylogic_epi32(_mm512_castps_si512(d.v), any,
                                                        _mm512_set1_epi32(INT32_MIN), 0xF2))};
}
INLINE Vec negate_if_any_negative(Vec d, Vec a, Vec b, Vec c) {
  const __m512i any = _mm512_ternarylogic_epi32(_mm512_castps_si512(a.v), _mm512_castps_si512(b.v),
                                                _mm512_castps_si512(c.v), 0xFE);
  return {_mm512_castsi512_ps(_mm512_ternarylogic_epi32(_mm512_castps_si512(d.v), any,
                                                        _mm512_set1_epi32(INT32_MIN), 0xF8))};
}
// a, with its sign flipped where s has a minus sign.
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
// product · (1 + e) where m. An infinite product stays infinite.
INLINE Vec grow(Vec product, Vec e, Mask m) { return fma_where(m, product, e, product); }
INLINE Vec reciprocal(Vec a) {  // with one Newton step, to a relative error of 2^-28
  const Vec r = {_mm512_rcp14_ps(a.v)};
  return r * Vec{_mm512_fnmadd_ps(a.v, r.v, _mm512_set1_ps(2.0f))};
}
INLINE float sum(Vec a) { return _mm512_reduce_add_ps(a.v); }
INLINE Vec unequal(const uint8_t* p, int64_t stride, uint8_t value) {
  int32_t r[4];
  for (int i = 0; i < 4; ++i) __builtin_memcpy(&r[i], p + i * stride, 4);
  const __m128i b = _mm_set_epi32(r[3], r[2], r[1], r[0]);
  const __mmask16 other = _mm_cmpneq_epi8_mask(b, _mm_set1_epi8(static_cast<char>(value)));
  return {_mm512_maskz_mov_ps(other, _mm512_set1_ps(1.0f))};
}
INLINE __m512 fold_quarters(__m512 a, __m512 b) {  // quarters of the result: a0 + a2, a1 + a3, b0 + b2, b1 + b3
  return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xEE));
}
INLINE __m512 fold_eighths(__m512 a, __m512 b) {
  return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xDD));
}
INLINE __m512 fold_pairs(__m512 a, __m512 b) {
  return _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x44), _mm512_shuffle_ps(a, b, 0xEE));
}
INLINE __m512 fold_singles(__m512 a, __m512 b) {
  return _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x88), _mm512_shuffle_ps(a, b, 0xDD));
}
INLINE void reduce12(const Vec sums[12], float total[16]) {
  __m512 group[3];
  for (int i = 0; i < 3; ++i) {
    const Vec* s = sums + 4 * i;
    // Quarter q holds sum q of the group, as four partial sums.
    group[i] = fold_eighths(fold_quarters(s[0].v, s[1].v), fold_quarters(s[2].v, s[3].v));
  }
  const __m512 zero = _mm512_setzero_ps();
  const __m512 t = fold_singles(fold_pairs(group[0], group[1]), fold_pairs(group[2], zero));
  // Quarter q holds sum q of the groups 0, 1, 2. In `total`, sum q of group g has the index 4 g + q.
  const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  _mm512_store_ps(total, _mm512_permutexvar_ps(order, t));
}

}  // namespace
