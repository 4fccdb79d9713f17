// Sixteen float lanes, spelt once for each instruction set. Included by silhouette.cc only, which is compiled once a set.
//
// Everything is in an anonymous namespace and nothing here uses the standard library's templates: a function that
// the linker may share between the sets could otherwise carry AVX-512 into the code for an older processor.
#pragma once

#include <cstdint>

#if defined(JAXFIT_AVX512) || defined(JAXFIT_AVX2)
#include <immintrin.h>
#elif defined(__SSE2__)
#include <emmintrin.h>
#endif

#define INLINE inline __attribute__((always_inline))

namespace {

constexpr int kLanes = 16;
constexpr float kFull = 1e30f;  // products are held below this, or at infinity

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

// a held to [-limit, limit].
INLINE Vec clamp_to(Vec a, Vec limit) { return {_mm512_range_ps(a.v, limit.v, 0x2)}; }
// -d for d ≥ 0, but d where any of a, b, c has a minus sign.
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
INLINE Vec grow(Vec product, Vec e, Mask m) { return fma_where(m, product, e, product); }
INLINE Vec reciprocal(Vec a) {  // one Newton step: 2^-28
  const Vec r = {_mm512_rcp14_ps(a.v)};
  return r * Vec{_mm512_fnmadd_ps(a.v, r.v, _mm512_set1_ps(2.0f))};
}
INLINE float sum(Vec a) { return _mm512_reduce_add_ps(a.v); }
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
INLINE __m256 scale_exp2(__m256 p, __m256 n) {  // n is shifted by 1.5 · 2^23, so its low bits hold the exponent
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
INLINE Vec from_bytes(const uint8_t* p, int64_t stride) {
  int32_t r[4];
  for (int i = 0; i < 4; ++i) __builtin_memcpy(&r[i], p + i * stride, 4);
  const __m128i zero = _mm_setzero_si128();
  const __m128i set = _mm_andnot_si128(_mm_cmpeq_epi8(_mm_set_epi32(r[3], r[2], r[1], r[0]), zero), _mm_set1_epi8(1));
  return {_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(set)),
          _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_unpackhi_epi64(set, zero)))};
}

#else  // GNU vectors of four: SSE2 on x86, NEON on ARM, whatever there is elsewhere

typedef float Floats __attribute__((vector_size(16)));
typedef int32_t Ints __attribute__((vector_size(16)));

struct Vec { Floats q[4]; };
struct Mask { Ints q[4]; };

#define EACH(expression)                      \
  do {                                        \
    for (int i = 0; i < 4; ++i) expression;   \
    return r;                                 \
  } while (0)

INLINE Floats floats(Ints v) { return reinterpret_cast<Floats>(v); }
INLINE Ints ints(Floats v) { return reinterpret_cast<Ints>(v); }
INLINE Floats blend(Ints m, Floats a, Floats b) { return floats((m & ints(a)) | (~m & ints(b))); }

INLINE Vec load(const float* p) { Vec r; __builtin_memcpy(&r, p, 64); return r; }
INLINE void store(float* p, Vec a) { __builtin_memcpy(p, &a, 64); }
INLINE Vec all(float a) { Vec r; EACH(r.q[i] = Floats{} + a); }
INLINE Vec operator+(Vec a, Vec b) { Vec r; EACH(r.q[i] = a.q[i] + b.q[i]); }
INLINE Vec operator-(Vec a, Vec b) { Vec r; EACH(r.q[i] = a.q[i] - b.q[i]); }
INLINE Vec operator*(Vec a, Vec b) { Vec r; EACH(r.q[i] = a.q[i] * b.q[i]); }
INLINE Vec operator/(Vec a, Vec b) { Vec r; EACH(r.q[i] = a.q[i] / b.q[i]); }
INLINE Vec fma(Vec a, Vec b, Vec c) { Vec r; EACH(r.q[i] = a.q[i] * b.q[i] + c.q[i]); }
#if defined(__SSE2__)
INLINE Vec min(Vec a, Vec b) { Vec r; EACH(r.q[i] = _mm_min_ps(a.q[i], b.q[i])); }
INLINE Vec max(Vec a, Vec b) { Vec r; EACH(r.q[i] = _mm_max_ps(a.q[i], b.q[i])); }
INLINE Vec sqrt(Vec a) { Vec r; EACH(r.q[i] = _mm_sqrt_ps(a.q[i])); }
INLINE uint32_t signs(Ints m) { return static_cast<uint32_t>(_mm_movemask_ps(floats(m))); }
#else
INLINE Vec min(Vec a, Vec b) { Vec r; EACH(r.q[i] = blend(a.q[i] < b.q[i], a.q[i], b.q[i])); }
INLINE Vec max(Vec a, Vec b) { Vec r; EACH(r.q[i] = blend(a.q[i] > b.q[i], a.q[i], b.q[i])); }
INLINE Vec sqrt(Vec a) {
  for (int i = 0; i < kLanes; ++i) a.q[i / 4][i % 4] = __builtin_sqrtf(a.q[i / 4][i % 4]);
  return a;
}
INLINE uint32_t signs(Ints m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
#endif
INLINE Vec abs(Vec a) { Vec r; EACH(r.q[i] = floats(ints(a.q[i]) & INT32_MAX)); }
INLINE Mask operator>(Vec a, Vec b) { Mask r; EACH(r.q[i] = a.q[i] > b.q[i]); }
INLINE Mask operator<=(Vec a, Vec b) { Mask r; EACH(r.q[i] = a.q[i] <= b.q[i]); }
INLINE Mask operator&(Mask a, Mask b) { Mask r; EACH(r.q[i] = a.q[i] & b.q[i]); }
INLINE Mask without(Mask a, Mask b) { Mask r; EACH(r.q[i] = a.q[i] & ~b.q[i]); }
INLINE uint32_t bits(Mask a) {
  return signs(a.q[0]) | signs(a.q[1]) << 4 | signs(a.q[2]) << 8 | signs(a.q[3]) << 12;
}
INLINE Vec select(Mask m, Vec a, Vec b) { Vec r; EACH(r.q[i] = blend(m.q[i], a.q[i], b.q[i])); }
INLINE Vec keep(Mask m, Vec a) { Vec r; EACH(r.q[i] = floats(m.q[i] & ints(a.q[i]))); }
INLINE Vec fma_where(Mask m, Vec a, Vec b, Vec c) { return fma(a, keep(m, b), c); }
INLINE Vec clamp_to(Vec a, Vec limit) { return max(min(a, limit), all(0.f) - limit); }
INLINE Vec negate_unless_any_negative(Vec d, Vec a, Vec b, Vec c) {
  Vec r;
  EACH(r.q[i] = floats(ints(d.q[i]) | (~(ints(a.q[i]) | ints(b.q[i]) | ints(c.q[i])) & INT32_MIN)));
}
INLINE Vec negate_if_any_negative(Vec d, Vec a, Vec b, Vec c) {
  Vec r;
  EACH(r.q[i] = floats(ints(d.q[i]) | ((ints(a.q[i]) | ints(b.q[i]) | ints(c.q[i])) & INT32_MIN)));
}
INLINE Vec flip_sign(Vec a, Vec s) { Vec r; EACH(r.q[i] = floats(ints(a.q[i]) ^ (ints(s.q[i]) & INT32_MIN))); }
INLINE Vec scale_exp2(Vec p, Vec n) {  // n is shifted by 1.5 · 2^23, so its low bits hold the exponent
  Vec r;
  EACH(r.q[i] = floats(ints(p.q[i]) + (ints(n.q[i]) << 23)));
}
INLINE float sum(Vec a) {
  const Floats h = (a.q[0] + a.q[1]) + (a.q[2] + a.q[3]);
  return (h[0] + h[1]) + (h[2] + h[3]);
}
#undef EACH

INLINE Vec exp2(Vec x) {
  x = min(max(x, all(-126.f)), all(60.f));
  const Vec n = x + all(12582912.0f);
  const Vec f = x - (n - all(12582912.0f));
  const Vec half = fma(fma(f, all(kExpRound[4]), all(kExpRound[3])), f, all(kExpRound[2]));
  const Vec p = fma(fma(half, f, all(kExpRound[1])), f, all(kExpRound[0]));
  return scale_exp2(p, n);
}
INLINE Vec grow(Vec product, Vec e, Mask m) {
  return min(fma_where(m, product, e, product), all(kFull));
}
INLINE Vec reciprocal(Vec a) { return all(1.0f) / a; }
INLINE Vec from_bytes(const uint8_t* p, int64_t stride) {
  float r[16];
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) r[4 * i + j] = p[i * stride + j] ? 1.0f : 0.0f;
  return load(r);
}

#endif

// The twelve vectors' sums over their lanes.
#if defined(JAXFIT_AVX512)
INLINE __m512 fold_quarters(__m512 a, __m512 b) {  // (a01+a23 | b01+b23), in quarters
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
    // Sums 0 to 3 of the group, each as four partial sums, in the four quarters.
    group[i] = fold_eighths(fold_quarters(s[0].v, s[1].v), fold_quarters(s[2].v, s[3].v));
  }
  const __m512 zero = _mm512_setzero_ps();
  const __m512 t = fold_singles(fold_pairs(group[0], group[1]), fold_pairs(group[2], zero));
  // Quarter q holds sum q of groups 0, 1, 2; four times a group's number plus q is wanted.
  const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  _mm512_store_ps(total, _mm512_permutexvar_ps(order, t));
}
#elif defined(JAXFIT_AVX2)
INLINE void reduce12(const Vec sums[12], float total[16]) {
  for (int i = 0; i < 3; ++i) {
    __m256 h[4];
    for (int j = 0; j < 4; ++j) h[j] = _mm256_add_ps(sums[4 * i + j].a, sums[4 * i + j].b);
    const __m256 t = _mm256_hadd_ps(_mm256_hadd_ps(h[0], h[1]), _mm256_hadd_ps(h[2], h[3]));
    _mm_store_ps(total + 4 * i, _mm_add_ps(_mm256_castps256_ps128(t), _mm256_extractf128_ps(t, 1)));
  }
}
#else
INLINE void reduce12(const Vec sums[12], float total[16]) {
  for (int i = 0; i < 12; ++i) total[i] = sum(sums[i]);
}
#endif

}  // namespace
