// Float and double vectors of this instruction set's width, and the few operations the train kernels need on them.
// Kernel files see no standard templates: those would be compiled with this file's flags and shared by the linker.
#pragma once
#include <cstdint>
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

namespace spikerig::SPIKERIG_ISA {

#ifdef SPIKERIG_LANES
constexpr int LANES = SPIKERIG_LANES;
#else
constexpr int LANES = 4;
#endif
constexpr int WIDE = LANES / 2;  // doubles in a vector

typedef float vf __attribute__((vector_size(4 * LANES)));
typedef int32_t vi __attribute__((vector_size(4 * LANES)));
typedef double vd __attribute__((vector_size(8 * WIDE)));
typedef int64_t vl __attribute__((vector_size(8 * WIDE)));

inline vf splat(float x) { return x - vf{}; }
inline vd splat(double x) { return x - vd{}; }
inline vf load(const float *p) {
  vf out;
  __builtin_memcpy(&out, p, sizeof out);
  return out;
}
inline vd load_wide(const double *p) {
  vd out;
  __builtin_memcpy(&out, p, sizeof out);
  return out;
}
inline void store(float *p, vf x) { __builtin_memcpy(p, &x, sizeof x); }

// A lane mask, the test for any lane set, and zero where the mask is not set.
#if defined(SPIKERIG_LANES) && SPIKERIG_LANES == 16
using mask = __mmask16;
inline mask at_least(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
inline mask at_least(vi a, vi b) { return _mm512_cmp_epi32_mask((__m512i)a, (__m512i)b, _MM_CMPINT_NLT); }
inline mask both(mask a, mask b) { return static_cast<mask>(a & b); }
inline mask without(mask a, mask b) { return static_cast<mask>(a & ~b); }
inline vi choose(mask m, vi a, vi b) { return (vi)_mm512_mask_mov_epi32((__m512i)b, m, (__m512i)a); }
inline bool any(mask m) { return m != 0; }
inline vf keep(mask m, vf x) { return _mm512_maskz_mov_ps(m, x); }
#else
using mask = vi;
inline mask at_least(vf a, vf b) { return a >= b; }
inline mask at_least(vi a, vi b) { return a >= b; }
inline mask both(mask a, mask b) { return a & b; }
inline mask without(mask a, mask b) { return a & ~b; }
inline vi choose(mask m, vi a, vi b) { return (m & a) | (~m & b); }
inline vf keep(mask m, vf x) { return (vf)(m & (vi)x); }
#if defined(SPIKERIG_LANES)
inline bool any(mask m) { return _mm256_movemask_ps((__m256)m) != 0; }
#elif defined(__x86_64__)
inline bool any(mask m) { return _mm_movemask_ps((__m128)m) != 0; }
#elif defined(__ARM_NEON)
inline bool any(mask m) { return vmaxvq_u32((uint32x4_t)m) != 0; }
#else
inline bool any(mask m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }
#endif
#endif

inline vf smaller(vf a, vf b) { return a < b ? a : b; }
inline vf larger(vf a, vf b) { return a > b ? a : b; }
inline vd smaller(vd a, vd b) { return a < b ? a : b; }
inline vd larger(vd a, vd b) { return a > b ? a : b; }

// 2^x for -126 <= x <= 126, relative error below 2e-7 (a minimax of degree 5 with p(0) = 1); outside it, any value.
inline vf exp2_lanes(vf x) {
  const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer kept in the low bits
  vf shifted = x + magic;
  vf f = x - (shifted - magic);  // in [-1/2, 1/2]
  vf p = splat(1.32647e-3f);
  p = p * f + 9.67151e-3f;
  p = p * f + 5.550734e-2f;
  p = p * f + 2.4022242e-1f;
  p = p * f + 6.9314698e-1f;
  p = p * f + 1.0f;
  return (vf)((vi)p + ((vi)shifted << 23));
}

// e^x for |x| <= 700, relative error a few 1e-16; arguments beyond are clamped.
inline vd exp_lanes(vd x) {
  x = smaller(larger(x, splat(-700.0)), splat(700.0));
  const double magic = 6755399441055744.0;  // 1.5 * 2^52
  vd shifted = x * 1.4426950408889634 + magic;
  vd n = shifted - magic;
  vd r = (x - n * 6.93147180369123816490e-01) - n * 1.90821492927058770002e-10;
  vd p = splat(1.0 / 6227020800.0);
  const double inverse_factorial[] = {1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320,
                                      1.0 / 5040,      1.0 / 720,      1.0 / 120,     1.0 / 24,     1.0 / 6,
                                      0.5,             1.0,            1.0};
  for (double c : inverse_factorial) p = p * r + c;
  return (vd)((vl)p + ((vl)shifted << 52));
}

inline vd sqrt_lanes(vd x) {
  vd out;
  for (int i = 0; i < WIDE; ++i) out[i] = __builtin_sqrt(x[i]);
  return out;
}

// Natural logarithm of normal x > 0, relative error a few 1e-16.
inline vd log_lanes(vd x) {
  const vl bits = (vl)x, root_half = vl{} + 0x3fe6a09e667f3bcd;
  const vl exponent = (bits - root_half) >> 52;  // so that the rest is in [sqrt(1/2), sqrt(2))
  const vd m = (vd)(bits - (exponent << 52));
  const double magic = 6755399441055744.0;
  const vd n = (vd)(exponent + (vl)splat(magic)) - magic;
  const vd t = (m - 1.0) / (m + 1.0), tt = t * t;
  vd p = splat(1.0 / 21);
  for (int odd = 19; odd >= 3; odd -= 2) p = p * tt + 1.0 / odd;
  return n * 6.93147180369123816490e-01 + (2.0 * t + (2.0 * t * tt * p + n * 1.90821492927058770002e-10));
}

// Sum over the lanes, halves first: one fixed order.
inline float sum_lanes(vf x) {
#if defined(SPIKERIG_LANES) && SPIKERIG_LANES == 16
  x += __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7);
  x += __builtin_shufflevector(x, x, 4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11);
  x += __builtin_shufflevector(x, x, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
#elif defined(SPIKERIG_LANES)
  x += __builtin_shufflevector(x, x, 4, 5, 6, 7, 0, 1, 2, 3);
  x += __builtin_shufflevector(x, x, 2, 3, 0, 1, 6, 7, 4, 5);
#else
  x += __builtin_shufflevector(x, x, 2, 3, 0, 1);
#endif
  return x[0] + x[1];
}

inline double sum_lanes(vd x) {
  double total = 0;
  for (int i = 0; i < WIDE; ++i) total += x[i];
  return total;
}

// Sums over the lanes of nine vectors, each in one fixed order, to out[0..8].
#if defined(SPIKERIG_LANES) && SPIKERIG_LANES == 16
inline vf fold_half(vf a, vf b) {  // two sums of 8
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
         __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
}
inline vf fold_quarter(vf a, vf b) {  // four sums of 4: a0 a1 b0 b1
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27) +
         __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
}
inline vf fold_pair(vf a, vf b) {  // eight sums of 2, interleaved inside each quarter
  return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
         __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
}
inline void sum_nine(const vf *x, float *out) {
  vf low = fold_quarter(fold_half(x[0], x[2]), fold_half(x[4], x[6]));
  vf high = fold_quarter(fold_half(x[1], x[3]), fold_half(x[5], x[7]));
  vf g = fold_pair(low, high);  // x0 x0 x1 x1 | x2 x2 x3 x3 | ...
  g += __builtin_shufflevector(g, g, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
  vf packed = __builtin_shufflevector(g, g, 0, 2, 4, 6, 8, 10, 12, 14, 0, 2, 4, 6, 8, 10, 12, 14);
  __builtin_memcpy(out, &packed, 32);
  out[8] = sum_lanes(x[8]);
}
#elif defined(SPIKERIG_LANES)
inline vf fold_half(vf a, vf b) {
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11) +
         __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
}
inline vf fold_pair(vf a, vf b) {
  return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13) +
         __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
}
inline vf fold_one(vf a, vf b) {
  return __builtin_shufflevector(a, b, 0, 2, 8, 10, 4, 6, 12, 14) +
         __builtin_shufflevector(a, b, 1, 3, 9, 11, 5, 7, 13, 15);
}
inline void sum_nine(const vf *x, float *out) {
  vf low = fold_pair(fold_half(x[0], x[4]), fold_half(x[1], x[5]));
  vf high = fold_pair(fold_half(x[2], x[6]), fold_half(x[3], x[7]));
  store(out, fold_one(low, high));
  out[8] = sum_lanes(x[8]);
}
#else
inline vf fold_pair(vf a, vf b) {
  return __builtin_shufflevector(a, b, 0, 1, 4, 5) + __builtin_shufflevector(a, b, 2, 3, 6, 7);
}
inline vf fold_one(vf a, vf b) {
  return __builtin_shufflevector(a, b, 0, 2, 4, 6) + __builtin_shufflevector(a, b, 1, 3, 5, 7);
}
inline void sum_nine(const vf *x, float *out) {
  for (int i = 0; i < 8; i += 4) store(out + i, fold_one(fold_pair(x[i], x[i + 1]), fold_pair(x[i + 2], x[i + 3])));
  out[8] = sum_lanes(x[8]);
}
#endif

}  // namespace spikerig::SPIKERIG_ISA
