// Integrate and fire in fixed point. A pixel's charge is a uint32 in units of 2^-32 threshold; adding the light of a
// tick either wraps (a spike, the surplus stays) or does not. Light of one threshold a tick or more spikes every tick
// and its excess is counted as clipped, so that in = fired + left + clipped holds exactly, in integers.
//
// The light of tick j of n on a ramp from a to b is floor(V0 + j D), V0 = a + D/2 and D = (b - a)/n held to 2^-32 of
// a unit, rounded the same way on every instruction set (this file is compiled without contraction to fused
// multiply-adds). dataset/oracles.py repeats it with Python's integers.
#include "spike_kernels.hpp"
#include "spike_lanes.hpp"
#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int64_t LENGTH = 128;          // bytes of a section
constexpr int64_t PIXELS = LENGTH * 8;
constexpr int64_t GROUP = 64;            // pixels whose charge stays in registers, eight bytes of output
constexpr int VECTORS = WORDS == 16 ? 4 : WORDS == 8 ? 2 : 4;  // registers of charge at a time, whole bytes of output
constexpr int64_t TICKS = 64;            // ticks a group runs before the next group catches up
constexpr double UNIT = 4294967296.0;    // 2^32
constexpr double ROUND = 6755399441055744.0;  // 1.5 * 2^52: adding it leaves the nearest integer in the low bits

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

// The integer (two's complement) in a sum to which ROUND was added.
inline Longs as_int(Doubles rounded) { return (Longs)rounded - (Longs)(Doubles{} + ROUND); }

// V0 and D of eight, four or two pixels: whole units, and 2^-32 of a unit in the low words. `ends` has every bit that
// the light at either end has.
struct Slope {
  Longs v, v_low, d, d_low, ends;
};

template <bool ramp>
inline Slope slope(const float *from, const float *to, double share) {
  const Doubles a = load_doubles(from) * UNIT + ROUND;
  if (!ramp) return {as_int(a), Longs{}, Longs{}, Longs{}, as_int(a)};
  const Doubles b = load_doubles(to) * UNIT + ROUND;
  const Doubles d = (b - a) * share, half = d * 0.5;
  const Doubles whole = d + ROUND, half_whole = half + ROUND;
  const Longs low = as_int((d - (whole - ROUND)) * UNIT + ROUND);
  const Longs half_low = as_int((half - (half_whole - ROUND)) * UNIT + ROUND);
  // low parts lie in [-2^31, 2^31]: a negative one borrows a whole unit
  return {as_int(a) + as_int(half_whole) - (half_low >> 63), half_low, as_int(whole) - (low >> 63), low,
          as_int(a) | as_int(b)};
}

struct Pixels {
  // Light at both ends of the segment, zero in padding pixels, which therefore never fire.
  alignas(64) float from[PIXELS], to[PIXELS];
  // V and D as integer part and 2^-32 parts; the low words do for light below one threshold a tick.
  alignas(64) int64_t v[PIXELS], d[PIXELS];
  alignas(64) uint32_t v_low[PIXELS], d_low[PIXELS], v_word[PIXELS], d_word[PIXELS];
  alignas(64) uint32_t charge[PIXELS];
  alignas(64) uint64_t clipped[PIXELS];      // of one stretch of at most TICKS ticks
  alignas(64) unsigned __int128 lost[PIXELS];  // of all before it
  bool bright[PIXELS / GROUP];  // groups with a pixel at or above one threshold a tick

  template <bool ramp>
  void begin_segment(int64_t pixels, int64_t ticks) {
    const double share = 1.0 / static_cast<double>(ticks);
    for (int64_t g = 0; g < pixels; g += GROUP) {
      Longs ends{};
      for (int64_t i = g; i < g + GROUP; i += DOUBLES) {
        const Slope s = slope<ramp>(from + i, to + i, share);
        ends |= s.ends;
        store_low(v_word + i, s.v);
        store_low(v_low + i, s.v_low);
        store_low(d_word + i, s.d);
        store_low(d_low + i, s.d_low);
      }
      uint64_t either = 0;
      for (int k = 0; k < DOUBLES; ++k) either |= ends[k];
      bright[g / GROUP] = (either >> 32) != 0;
      if (!bright[g / GROUP]) continue;
      for (int64_t i = g; i < g + GROUP; i += DOUBLES) {
        const Slope s = slope<ramp>(from + i, to + i, share);
        store(v + i, s.v);
        store(d + i, s.d);
      }
    }
  }

  // Light below one threshold a tick throughout: 32-bit lanes, a spike is a carry.
  template <bool ramp>
  void run_dim(int64_t g, int64_t ticks, uint8_t *out, int64_t frame, int64_t bytes) {
    constexpr int LANES = VECTORS * WORDS;
    for (int64_t at = g; at < g + GROUP && (at - g) / 8 < bytes; at += LANES) {
      Words c[VECTORS], w[VECTORS], low[VECTORS];
      for (int k = 0; k < VECTORS; ++k) {
        c[k] = flip(load_words(charge + at + k * WORDS));
        w[k] = load_words(v_word + at + k * WORDS);
        low[k] = flip(load_words(v_low + at + k * WORDS));
      }
      const int64_t room = std::min<int64_t>(bytes - (at - g) / 8, LANES / 8);
      for (int64_t t = 0; t < ticks; ++t) {
        uint64_t spikes = 0;
        for (int k = 0; k < VECTORS; ++k) {
          const Words after = add(c[k], w[k]);
          spikes |= static_cast<uint64_t>(wrapped(c[k], after)) << (k * WORDS);
          c[k] = after;
          if (ramp) {
            const Words next = add(low[k], load_words(d_low + at + k * WORDS));
            w[k] = add_carry(add(w[k], load_words(d_word + at + k * WORDS)), low[k], next);
            low[k] = next;
          }
        }
        if (room == LANES / 8)
          std::memcpy(out + t * frame + (at - g) / 8, &spikes, LANES / 8);
        else
          std::memcpy(out + t * frame + (at - g) / 8, &spikes, static_cast<size_t>(room));
      }
      for (int k = 0; k < VECTORS; ++k) {
        store_words(charge + at + k * WORDS, flip(c[k]));
        store_words(v_word + at + k * WORDS, w[k]);
        store_words(v_low + at + k * WORDS, flip(low[k]));
      }
    }
  }

  // Any light: 64-bit lanes, at most one threshold a tick is integrated, the rest is clipped.
  void run_bright(int64_t g, int64_t ticks, uint8_t *out, int64_t frame, int64_t bytes) {
    constexpr int64_t one = int64_t{1} << 32;
    for (int64_t t = 0; t < ticks; ++t) {
      alignas(64) uint8_t spike[GROUP];
      for (int64_t i = g; i < g + GROUP; ++i) {
        const int64_t in = std::min(v[i], one);
        clipped[i] += static_cast<uint64_t>(v[i] - in);
        const int64_t sum = static_cast<int64_t>(charge[i]) + in;
        charge[i] = static_cast<uint32_t>(sum);
        spike[i - g] = static_cast<uint8_t>(sum >> 32);
        const uint64_t low = uint64_t{v_low[i]} + d_low[i];
        v_low[i] = static_cast<uint32_t>(low);
        v[i] += d[i] + static_cast<int64_t>(low >> 32);
      }
      uint8_t packed[GROUP / 8];
      for (int64_t k = 0; k < GROUP / 8; ++k) {
        uint64_t eight;
        std::memcpy(&eight, spike + k * 8, 8);
        packed[k] = gather8(eight);
      }
      std::memcpy(out + t * frame, packed, static_cast<size_t>(std::min(bytes, GROUP / 8)));
    }
    for (int64_t i = g; i < g + GROUP; ++i) {
      lost[i] += clipped[i];
      clipped[i] = 0;
    }
  }
};

}  // namespace

void fire(const Light &light, uint32_t *charge, uint8_t *bits, double *clipped) {
  const int64_t frame = light.height * ((light.width + 7) / 8), image = light.height * light.width;
  parallel(sections(frame, LENGTH), [&](int part) {
    static thread_local Pixels state;
    const Section at = section(frame, LENGTH, part);
    const int64_t pixels = at.bytes() * 8;
    auto each_run = [&](auto copy) {
      runs(at, light.width, [&](int64_t byte, int64_t pixel, int64_t n) { copy((byte - at.begin) * 8, pixel, n); });
    };
    std::memset(&state, 0, sizeof state);
    each_run([&](int64_t i, int64_t pixel, int64_t n) { std::copy_n(charge + pixel, n, state.charge + i); });
    for (int64_t k = 0; k < light.segments; ++k) {
      const int64_t ticks = light.knots[k + 1] - light.knots[k];
      if (ticks == 0) continue;
      const float *from = light.rows + k * image, *to = light.hold ? from : from + image;
      each_run([&](int64_t i, int64_t pixel, int64_t n) {
        std::copy_n(from + pixel, n, state.from + i);
        std::copy_n(to + pixel, n, state.to + i);
      });
      if (light.hold)
        state.begin_segment<false>(pixels, ticks);
      else
        state.begin_segment<true>(pixels, ticks);
      uint8_t *out = bits + (light.knots[k] - light.knots[0]) * frame + at.begin;
      for (int64_t t = 0; t < ticks; t += TICKS) {
        const int64_t n = std::min(TICKS, ticks - t);
        for (int64_t g = 0; g < pixels; g += GROUP) {
          uint8_t *to_bits = out + t * frame + g / 8;
          if (state.bright[g / GROUP])
            state.run_bright(g, n, to_bits, frame, at.bytes() - g / 8);
          else if (light.hold)
            state.run_dim<false>(g, n, to_bits, frame, at.bytes() - g / 8);
          else
            state.run_dim<true>(g, n, to_bits, frame, at.bytes() - g / 8);
        }
      }
    }
    each_run([&](int64_t i, int64_t pixel, int64_t n) {
      std::copy_n(state.charge + i, n, charge + pixel);
      for (int64_t j = 0; j < n; ++j) clipped[pixel + j] = static_cast<double>(state.lost[i + j]) / UNIT;
    });
  });
}

}  // namespace spikerig::SPIKERIG_ISA
