// Sixteen lanes in four compiler vectors of four lanes. The compiler uses SSE2 on x86, NEON on ARM, and the vector
// instructions of other processors where they exist. simd.h includes this file.
#pragma once

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace {

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
INLINE Vec fms(Vec a, Vec b, Vec c) { Vec r; EACH(r.q[i] = a.q[i] * b.q[i] - c.q[i]); }
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
INLINE Vec scale_exp2(Vec p, Vec n) {  // n has an offset of 1.5 · 2^23, so its low bits hold the exponent
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
INLINE Vec unequal(const uint8_t* p, int64_t stride, uint8_t value) {
  float r[16];
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) r[4 * i + j] = p[i * stride + j] != value ? 1.0f : 0.0f;
  return load(r);
}
INLINE void reduce12(const Vec sums[12], float total[16]) {
  for (int i = 0; i < 12; ++i) total[i] = sum(sums[i]);
}

}  // namespace
