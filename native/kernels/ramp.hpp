// The light of the pixels of one section between two knots, as whole numbers; see fire.cpp. Internal linkage, and no
// fused multiply-adds, as in word_lanes.hpp.
#pragma once
#include "spike_lanes.hpp"
#include "word_lanes.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int64_t LENGTH = 128;          // bytes of a section
constexpr int64_t PIXELS = LENGTH * 8;
constexpr int64_t TICKS = 64;            // ticks some pixels run before the next ones catch up
constexpr double UNIT = 4294967296.0;    // 2^32
constexpr double ROUND = 6755399441055744.0;  // 1.5 * 2^52: adding it leaves the nearest integer in the low bits

// The integer (two's complement) in a sum to which ROUND was added.
inline Longs as_int(Doubles rounded) { return (Longs)rounded - (Longs)(Doubles{} + ROUND); }

// The least integer not below x.
inline Longs ceiling(Doubles x) {
  const Doubles rounded = x + ROUND;
  return as_int(rounded) - (Longs)((rounded - ROUND) < x);
}

// V0 and D of eight, four or two pixels: whole units, and 2^-32 of a unit in the low words.
struct Slope {
  Longs v, v_low, d, d_low;
};

template <bool ramp>
inline Slope slope(const float *from, const float *to, double share) {
  const Doubles a = load_doubles(from) * UNIT + ROUND;
  if (!ramp) return {as_int(a), Longs{}, Longs{}, Longs{}};
  const Doubles b = load_doubles(to) * UNIT + ROUND;
  const Doubles d = (b - a) * share, half = d * 0.5;
  const Doubles whole = d + ROUND, half_whole = half + ROUND;
  const Longs low = ceiling((d - (whole - ROUND)) * UNIT);
  const Longs half_low = ceiling((half - (half_whole - ROUND)) * UNIT);
  // low parts lie in [-2^31, 2^31]: a negative one borrows a whole unit
  return {as_int(a) + as_int(half_whole) - (half_low >> 63), half_low, as_int(whole) - (low >> 63), low};
}

struct Ramp {
  // Light at both ends of the segment, zero in padding pixels, which therefore never fire.
  alignas(64) float from[PIXELS], to[PIXELS];
  // V and D: whole thresholds, 2^-32 of one, and 2^-32 of that.
  alignas(64) int32_t v_whole[PIXELS], d_whole[PIXELS];
  alignas(64) uint32_t v_word[PIXELS], d_word[PIXELS], v_low[PIXELS], d_low[PIXELS];

  // Whether one of n pixels from i on reaches one threshold a tick. (A float32 below one is below it by 2^-24.)
  bool reaches_one(int64_t i, int64_t n) const {
    int32_t any = 0;
    for (int64_t p = i; p < i + n; ++p) any |= (from[p] >= 1.0f) | (to[p] >= 1.0f);
    return any != 0;
  }

  // Sets n pixels from i on up; whole thresholds only if asked for.
  template <bool ramp, bool whole>
  void begin(int64_t i, int64_t n, double share) {
    for (int64_t p = i; p < i + n; p += DOUBLES) {
      const Slope s = slope<ramp>(from + p, to + p, share);
      store_low(v_word + p, s.v);
      store_low(v_low + p, s.v_low);
      store_low(d_word + p, s.d);
      store_low(d_low + p, s.d_low);
      if (!whole) continue;
      store_low(reinterpret_cast<uint32_t *>(v_whole + p), s.v >> 32);
      store_low(reinterpret_cast<uint32_t *>(d_whole + p), s.d >> 32);
    }
  }

  // Goes some ticks on. Whole thresholds come out right where they were set.
  void skip(int64_t i, int64_t pixels, int64_t ticks) {
    for (int64_t p = i; ticks && p < i + pixels; ++p) {
      const auto joined = [](int32_t whole, uint32_t word, uint32_t low) {
        return static_cast<__int128>(whole) * (static_cast<__int128>(1) << 64) + (static_cast<uint64_t>(word) << 32 | low);
      };
      const __int128 v = joined(v_whole[p], v_word[p], v_low[p]) + ticks * joined(d_whole[p], d_word[p], d_low[p]);
      v_whole[p] = static_cast<int32_t>(v >> 64);
      v_word[p] = static_cast<uint32_t>(v >> 32);
      v_low[p] = static_cast<uint32_t>(v);
    }
  }
};

}  // namespace
}  // namespace spikerig::SPIKERIG_ISA
