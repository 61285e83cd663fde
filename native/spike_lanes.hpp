// What the spike kernels need of a vector unit, in three widths. Included only by files compiled per ISA.
#pragma once
#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace spikerig::SPIKERIG_ISA {

// ---- whole bits: registers for bit-sliced adders -------------------------------------------------------------

#if SPIKERIG_LANES == 16
using Wide = __m512i;
#elif SPIKERIG_LANES == 8
using Wide = __m256i;
#else
typedef long long Wide __attribute__((vector_size(16)));
#endif
constexpr int WIDE = sizeof(Wide);

inline Wide load_wide(const uint8_t *from) {
  Wide w;
  std::memcpy(&w, from, sizeof w);
  return w;
}
inline void store_wide(uint8_t *to, Wide w) { std::memcpy(to, &w, sizeof w); }

// Carry-save adder: a + b + c = low + 2 high, in every bit.
inline void add3(Wide &high, Wide &low, Wide a, Wide b, Wide c) {
#if SPIKERIG_LANES == 16
  high = _mm512_ternarylogic_epi64(a, b, c, 0xE8);
  low = _mm512_ternarylogic_epi64(a, b, c, 0x96);
#else
  const Wide u = a ^ b;
  high = (a & b) | (u & c);
  low = u ^ c;
#endif
}

// Which of eight 64-bit words, 64-byte aligned, are not zero: bit k for word k.
inline uint32_t lit_words(const uint64_t *words) {
#if SPIKERIG_LANES == 16
  const __m512i w = _mm512_load_si512(words);
  return _mm512_test_epi64_mask(w, w);
#elif SPIKERIG_LANES == 8
  const __m256i zero = _mm256_setzero_si256(), *w = reinterpret_cast<const __m256i *>(words);
  const auto dark = [&](int k) { return _mm256_movemask_pd(_mm256_castsi256_pd(_mm256_cmpeq_epi64(w[k], zero))); };
  return static_cast<uint32_t>(dark(0) | dark(1) << 4) ^ 255;
#else
  uint32_t lit = 0;
  for (int k = 0; k < 8; ++k) lit |= static_cast<uint32_t>(words[k] != 0) << k;
  return lit;
#endif
}

// Writes `value` to those of to[0 .. 63] whose bit is set.
inline void put_where(int32_t *to, uint64_t bits, int32_t value) {
#if SPIKERIG_LANES == 16
  if (__builtin_popcountll(bits) > 4) {
    const __m512i v = _mm512_set1_epi32(value);
    for (int k = 0; k < 4; ++k) _mm512_mask_storeu_epi32(to + 16 * k, static_cast<__mmask16>(bits >> (16 * k)), v);
    return;
  }
#elif SPIKERIG_LANES == 8
  if (__builtin_popcountll(bits) > 12) {
    const __m256i v = _mm256_set1_epi32(value), bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    for (int k = 0; k < 8; ++k) {
      const __m256i byte = _mm256_set1_epi32(static_cast<int32_t>(bits >> (8 * k) & 255));
      const __m256i hit = _mm256_cmpeq_epi32(_mm256_and_si256(byte, bit), bit);
      __m256i *at = reinterpret_cast<__m256i *>(to + 8 * k);
      _mm256_storeu_si256(at, _mm256_blendv_epi8(_mm256_loadu_si256(at), v, hit));
    }
    return;
  }
#endif
  for (; bits; bits &= bits - 1) to[__builtin_ctzll(bits)] = value;
}

// ---- bits to bytes: SPREAD pixels from SPREAD/8 bytes ---------------------------------------------------------

inline uint64_t spread8(uint8_t byte) {  // 8 bits to 8 bytes of 0 or 1, first pixel lowest
  const uint64_t x = (byte * 0x0101010101010101ull) & 0x8040201008040201ull;
  return ((x + 0x7f7f7f7f7f7f7f7full) >> 7) & 0x0101010101010101ull;
}

inline uint8_t gather8(uint64_t bytes) {  // its inverse
  return static_cast<uint8_t>((bytes * 0x0102040810204080ull) >> 56);
}

#if SPIKERIG_LANES == 16
using Bytes = __m512i;
inline Bytes spread(const uint8_t *from, uint8_t weight) {
  uint64_t m;
  std::memcpy(&m, from, 8);
  return _mm512_maskz_set1_epi8(m, static_cast<char>(weight));
}
#elif SPIKERIG_LANES == 8
using Bytes = __m256i;
inline Bytes spread(const uint8_t *from, uint8_t weight) {
  int32_t m;
  std::memcpy(&m, from, 4);
  const Bytes byte = _mm256_setr_epi64x(0, 0x0101010101010101ll, 0x0202020202020202ll, 0x0303030303030303ll);
  const Bytes bit = _mm256_set1_epi64x(static_cast<long long>(0x8040201008040201ull));
  const Bytes hit = _mm256_cmpeq_epi8(_mm256_and_si256(_mm256_shuffle_epi8(_mm256_set1_epi32(m), byte), bit), bit);
  return _mm256_and_si256(hit, _mm256_set1_epi8(static_cast<char>(weight)));
}
#else
typedef uint64_t Bytes;
inline Bytes spread(const uint8_t *from, uint8_t weight) { return spread8(*from) * weight; }
#endif
constexpr int SPREAD = sizeof(Bytes);

// ---- 16-bit lanes chosen by spike bits ------------------------------------------------------------------------

#if SPIKERIG_LANES == 16
using Shorts = __m512i;
using ShortMask = __mmask32;
inline ShortMask short_mask(uint32_t bits) { return bits; }
inline Shorts choose(ShortMask m, Shorts yes, Shorts no) { return _mm512_mask_blend_epi16(m, no, yes); }
inline Shorts one_more(Shorts s) {  // s + 1, but 0 stays 0 and 65535 stays 65535
  return _mm512_adds_epu16(s, _mm512_min_epu16(s, _mm512_set1_epi16(1)));
}
inline Shorts all_ones() { return _mm512_set1_epi16(1); }
#elif SPIKERIG_LANES == 8
using Shorts = __m256i;
using ShortMask = __m256i;
inline ShortMask short_mask(uint32_t bits) {
  const Shorts bit = _mm256_setr_epi16(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, -32768);
  return _mm256_cmpeq_epi16(_mm256_and_si256(_mm256_set1_epi16(static_cast<short>(bits)), bit), bit);
}
inline Shorts choose(ShortMask m, Shorts yes, Shorts no) { return _mm256_blendv_epi8(no, yes, m); }
inline Shorts one_more(Shorts s) { return _mm256_adds_epu16(s, _mm256_min_epu16(s, _mm256_set1_epi16(1))); }
inline Shorts all_ones() { return _mm256_set1_epi16(1); }
#else
typedef uint16_t Shorts __attribute__((vector_size(16)));
using ShortMask = Shorts;
inline ShortMask short_mask(uint32_t bits) {
  const Shorts bit = {1, 2, 4, 8, 16, 32, 64, 128};
  return (ShortMask)(((Shorts{} + static_cast<uint16_t>(bits)) & bit) == bit);
}
inline Shorts choose(ShortMask m, Shorts yes, Shorts no) { return (m & yes) | (~m & no); }
inline Shorts one_more(Shorts s) { return s - (Shorts)((s != 0) & (s != 65535)); }
inline Shorts all_ones() { return Shorts{} + 1; }
#endif
constexpr int SHORTS = sizeof(Shorts) / 2;

// ---- 32-bit lanes with carries --------------------------------------------------------------------------------
// AVX2 and SSE2 compare signed numbers only, so there unsigned values are kept with the top bit flipped.

#if SPIKERIG_LANES == 16
using Words = __m512i;
inline Words add(Words a, Words b) { return _mm512_add_epi32(a, b); }
inline Words flip(Words a) { return a; }
inline uint32_t wrapped(Words before, Words after) { return _mm512_cmplt_epu32_mask(after, before); }
inline Words add_carry(Words v, Words before, Words after) {
  return _mm512_mask_sub_epi32(v, _mm512_cmplt_epu32_mask(after, before), v, _mm512_set1_epi32(-1));
}
#elif SPIKERIG_LANES == 8
using Words = __m256i;
inline Words add(Words a, Words b) { return _mm256_add_epi32(a, b); }
inline Words flip(Words a) { return _mm256_xor_si256(a, _mm256_set1_epi32(INT32_MIN)); }
inline uint32_t wrapped(Words before, Words after) {
  return static_cast<uint32_t>(_mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpgt_epi32(before, after))));
}
inline Words add_carry(Words v, Words before, Words after) {
  return _mm256_sub_epi32(v, _mm256_cmpgt_epi32(before, after));
}
#else
typedef int32_t Words __attribute__((vector_size(16)));
inline Words add(Words a, Words b) {
  typedef uint32_t U __attribute__((vector_size(16)));
  return (Words)((U)a + (U)b);
}
inline Words flip(Words a) { return a ^ (Words{} + INT32_MIN); }
inline uint32_t wrapped(Words before, Words after) {
  const Words m = before > after;
#if defined(__x86_64__)
  return static_cast<uint32_t>(_mm_movemask_ps((__m128)m));
#else
  return static_cast<uint32_t>((m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8));
#endif
}
inline Words add_carry(Words v, Words before, Words after) { return v - (before > after); }
#endif
constexpr int WORDS = sizeof(Words) / 4;

inline Words load_words(const uint32_t *from) {
  Words w;
  std::memcpy(&w, from, sizeof w);
  return w;
}
inline void store_words(uint32_t *to, Words w) { std::memcpy(to, &w, sizeof w); }

// ---- doubles and the integers of their width ------------------------------------------------------------------

constexpr int DOUBLES = WIDE / 8;
typedef double Doubles __attribute__((vector_size(WIDE)));
typedef uint64_t Longs __attribute__((vector_size(WIDE)));

inline Doubles load_doubles(const float *from) {
#if SPIKERIG_LANES == 16
  return _mm512_cvtps_pd(_mm256_loadu_ps(from));
#elif SPIKERIG_LANES == 8
  return _mm256_cvtps_pd(_mm_loadu_ps(from));
#else
  return Doubles{from[0], from[1]};
#endif
}

inline void store_low(uint32_t *to, Longs x) {  // the low word of each
#if SPIKERIG_LANES == 16
  _mm256_storeu_si256(reinterpret_cast<__m256i *>(to), _mm512_cvtepi64_epi32((__m512i)x));
#elif SPIKERIG_LANES == 8
  const __m256i even = _mm256_setr_epi32(0, 2, 4, 6, 0, 2, 4, 6);
  const __m256i low = _mm256_permutevar8x32_epi32((__m256i)x, even);
  _mm_storeu_si128(reinterpret_cast<__m128i *>(to), _mm256_castsi256_si128(low));
#else
  to[0] = static_cast<uint32_t>(x[0]);
  to[1] = static_cast<uint32_t>(x[1]);
#endif
}

}  // namespace spikerig::SPIKERIG_ISA
