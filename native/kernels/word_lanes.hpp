// Vectors of 32-bit words, whole numbers and floats, lane masks, and 64-bit numbers held as two words, for kernels that
// promise the same bits on every instruction set. All of it has internal linkage: the files that include it are
// compiled without contraction to fused multiply-adds, and must not share a function with files that are not.
#pragma once
#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace spikerig::SPIKERIG_ISA {
namespace {

#ifdef SPIKERIG_LANES
constexpr int LANES = SPIKERIG_LANES;
#else
constexpr int LANES = 4;
#endif

typedef uint32_t vu __attribute__((vector_size(4 * LANES)));
typedef int32_t vi __attribute__((vector_size(4 * LANES)));
typedef float vf __attribute__((vector_size(4 * LANES)));
typedef uint64_t vw __attribute__((vector_size(4 * LANES)));  // half as many, twice as wide

template <class V, class T>
inline V load(const T *from) {
  V x;
  std::memcpy(&x, from, sizeof x);
  return x;
}
template <class V, class T>
inline void store(T *to, V x) {
  std::memcpy(to, &x, sizeof x);
}
inline vu words(uint32_t x) { return x - vu{}; }
inline vi wholes(int32_t x) { return x - vi{}; }
inline vf floats(float x) { return x - vf{}; }

// ---- masks: a bit a lane with AVX-512, else -1 and 0 ------------------------------------------------------------

#if SPIKERIG_LANES == 16
using Mask = __mmask16;
inline Mask less(vu a, vu b) { return _mm512_cmplt_epu32_mask((__m512i)a, (__m512i)b); }
inline Mask less(vi a, vi b) { return _mm512_cmplt_epi32_mask((__m512i)a, (__m512i)b); }
inline Mask less(vf a, vf b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ); }
inline Mask both(Mask a, Mask b) { return static_cast<Mask>(a & b); }
inline Mask either(Mask a, Mask b) { return static_cast<Mask>(a | b); }
inline Mask inverse(Mask a) { return static_cast<Mask>(~a); }
inline Mask zero_where(Mask m, vu a) { return _mm512_mask_testn_epi32_mask(m, (__m512i)a, (__m512i)a); }
inline bool any(Mask m) { return m != 0; }
inline uint32_t lane_bits(Mask m) { return m; }
inline Mask from_bits(uint32_t bits) { return static_cast<Mask>(bits); }
inline vu pick(Mask m, vu a, vu b) { return (vu)_mm512_mask_mov_epi32((__m512i)b, m, (__m512i)a); }
inline vu keep(Mask m, vu x) { return (vu)_mm512_maskz_mov_epi32(m, (__m512i)x); }
inline vu add_where(Mask m, vu a, vu b) { return (vu)_mm512_mask_add_epi32((__m512i)a, m, (__m512i)a, (__m512i)b); }
inline vf add_where(Mask m, vf a, vf b) { return (vf)_mm512_mask_add_ps((__m512)a, m, (__m512)a, (__m512)b); }
inline vu add_one(Mask m, vu a) {
  return (vu)_mm512_mask_sub_epi32((__m512i)a, m, (__m512i)a, _mm512_set1_epi32(-1));
}
#else
using Mask = vi;
inline Mask less(vu a, vu b) { return a < b; }
inline Mask less(vi a, vi b) { return a < b; }
inline Mask less(vf a, vf b) { return a < b; }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Mask either(Mask a, Mask b) { return a | b; }
inline Mask inverse(Mask a) { return ~a; }
inline Mask zero_where(Mask m, vu a) { return m & (Mask)(a == 0); }
inline vu pick(Mask m, vu a, vu b) { return ((vu)m & a) | (~(vu)m & b); }
inline vu keep(Mask m, vu x) { return (vu)m & x; }
inline vu add_where(Mask m, vu a, vu b) { return a + ((vu)m & b); }
inline vf add_where(Mask m, vf a, vf b) { return a + (vf)((vu)m & (vu)b); }
inline vu add_one(Mask m, vu a) { return a - (vu)m; }
#if SPIKERIG_LANES == 8
inline uint32_t lane_bits(Mask m) { return static_cast<uint32_t>(_mm256_movemask_ps((__m256)m)); }
constexpr vu LANE_BIT = {1, 2, 4, 8, 16, 32, 64, 128};
#else
constexpr vu LANE_BIT = {1, 2, 4, 8};
#if defined(__x86_64__)
inline uint32_t lane_bits(Mask m) { return static_cast<uint32_t>(_mm_movemask_ps((__m128)m)); }
#else
inline uint32_t lane_bits(Mask m) {
  return static_cast<uint32_t>((m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8));
}
#endif
#endif
inline bool any(Mask m) { return lane_bits(m) != 0; }
inline Mask from_bits(uint32_t bits) { return (Mask)((words(bits) & LANE_BIT) != 0); }
#endif
inline vi pick(Mask m, vi a, vi b) { return (vi)pick(m, (vu)a, (vu)b); }
inline vf pick(Mask m, vf a, vf b) { return (vf)pick(m, (vu)a, (vu)b); }

// ---- products of words and square roots --------------------------------------------------------------------------

// 64-bit products of the low words of the wide lanes.
inline vw low_product(vw a, vw b) {
#if SPIKERIG_LANES == 16
  return (vw)_mm512_mul_epu32((__m512i)a, (__m512i)b);
#elif SPIKERIG_LANES == 8
  return (vw)_mm256_mul_epu32((__m256i)a, (__m256i)b);
#elif defined(__x86_64__)
  return (vw)_mm_mul_epu32((__m128i)a, (__m128i)b);
#else
  return (a & 0xFFFFFFFFu) * (b & 0xFFFFFFFFu);
#endif
}

// Words in order from the low words of `even` and of `odd`.
inline vu weave(vw even, vw odd) {
#if SPIKERIG_LANES == 16
  return (vu)_mm512_mask_mov_epi32((__m512i)even, 0xAAAA, (__m512i)(odd << 32));
#elif SPIKERIG_LANES == 8
  return (vu)_mm256_blend_epi32((__m256i)even, (__m256i)(odd << 32), 0xAA);
#else
  return (vu)((even & 0xFFFFFFFFu) | (odd << 32));
#endif
}

inline vu high_product(vu a, vu b) {
  const vw even = low_product((vw)a, (vw)b), odd = low_product((vw)a >> 32, (vw)b >> 32);
  return weave(even >> 32, odd >> 32);
}

inline vf root(vf x) {
#if SPIKERIG_LANES == 16
  return (vf)_mm512_sqrt_ps((__m512)x);
#elif SPIKERIG_LANES == 8
  return (vf)_mm256_sqrt_ps((__m256)x);
#elif defined(__x86_64__)
  return (vf)_mm_sqrt_ps((__m128)x);
#else
  for (int i = 0; i < LANES; ++i) x[i] = __builtin_sqrtf(x[i]);
  return x;
#endif
}

inline vf to_float(vi x) { return __builtin_convertvector(x, vf); }
inline vi to_whole(vf x) { return __builtin_convertvector(x, vi); }  // towards zero
inline vf to_float(vu x) {  // the nearest float: both halves are exact, one rounding
#if SPIKERIG_LANES == 16
  return (vf)_mm512_cvtepu32_ps((__m512i)x);
#else
  return to_float((vi)(x >> 16)) * 65536.0f + to_float((vi)(x & 0xFFFF));
#endif
}

// ---- 64-bit numbers in 2^-32 of a unit: whole units, signed, and the word below -----------------------------------

struct Pair {
  vi whole;
  vu word;
};

inline Pair operator+(Pair a, Pair b) {
  const vu word = a.word + b.word;
  return {(vi)add_one(less(word, a.word), (vu)(a.whole + b.whole)), word};
}

inline Pair operator-(Pair a, Pair b) {
  return {a.whole - b.whole + (vi)keep(less(a.word, b.word), words(0xFFFFFFFFu)), a.word - b.word};
}

inline Pair keep(Mask m, Pair x) { return {(vi)keep(m, (vu)x.whole), keep(m, x.word)}; }
inline Pair pick(Mask m, Pair a, Pair b) { return {pick(m, a.whole, b.whole), pick(m, a.word, b.word)}; }

}  // namespace
}  // namespace spikerig::SPIKERIG_ISA
