// Integrate and fire in fixed point. A pixel's charge is a uint32 in units of 2^-32 threshold; adding the light of a
// tick either wraps (a spike, the surplus stays) or does not. Light of one threshold a tick or more spikes every tick
// and its excess is counted as clipped, so that in = fired + left + clipped holds exactly, in integers.
//
// The light of tick j of n on a ramp from a to b is floor(V0 + j D), V0 = a + D/2 and D = (b - a)/n held to 2^-32 of
// a unit, rounded the same way on every instruction set (this file is compiled without contraction to fused
// multiply-adds). dataset/oracles.py repeats it with Python's integers.
#include "step.hpp"
#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int64_t GROUP = 64;            // pixels whose charge stays in registers, eight bytes of output
constexpr int VECTORS = WORDS == 16 ? 4 : WORDS == 8 ? 2 : 4;  // registers of charge at a time, whole bytes of output

struct Pixels {
  Ramp ramp;
  Charges charges;
  bool bright[PIXELS / GROUP];  // groups with a pixel at or above one threshold a tick
  bool owing[PIXELS / GROUP];   // groups with a pixel that has a whole threshold left

  // Light below one threshold a tick throughout: 32-bit lanes, a spike is a carry.
  template <bool ramps>
  void run_dim(int64_t g, int64_t ticks, uint8_t *out, int64_t frame, int64_t bytes) {
    constexpr int RUN = VECTORS * WORDS;
    uint32_t *charge = charges.word, *v_word = ramp.v_word, *v_low = ramp.v_low;
    for (int64_t at = g; at < g + GROUP && (at - g) / 8 < bytes; at += RUN) {
      Words c[VECTORS], w[VECTORS], low[VECTORS];
      for (int k = 0; k < VECTORS; ++k) {
        c[k] = flip(load_words(charge + at + k * WORDS));
        w[k] = load_words(v_word + at + k * WORDS);
        low[k] = flip(load_words(v_low + at + k * WORDS));
      }
      const int64_t room = std::min<int64_t>(bytes - (at - g) / 8, RUN / 8);
      for (int64_t t = 0; t < ticks; ++t) {
        uint64_t spikes = 0;
        for (int k = 0; k < VECTORS; ++k) {
          const Words after = add(c[k], w[k]);
          spikes |= static_cast<uint64_t>(wrapped(c[k], after)) << (k * WORDS);
          c[k] = after;
          if (ramps) {
            const Words next = add(low[k], load_words(ramp.d_low + at + k * WORDS));
            w[k] = add_carry(add(w[k], load_words(ramp.d_word + at + k * WORDS)), low[k], next);
            low[k] = next;
          }
        }
        if (room == RUN / 8)
          std::memcpy(out + t * frame + (at - g) / 8, &spikes, RUN / 8);
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

  // Any light; what is above one threshold a tick is clipped. Its sum is not added up tick by tick: it is the sum of
  // all light, n V + D n(n-1)/2 and a unit for every tick after a carry of the low words, less what was fired and left.
  template <bool ramps>
  void run_bright(int64_t g, int64_t ticks, uint8_t *out, int64_t frame, int64_t bytes) {
    constexpr int N = 2;
    constexpr int64_t RUN = N * LANES;
    for (int64_t at = g; at < g + GROUP && (at - g) / 8 < bytes; at += RUN) {
      Pair v[N];
      vu low[N], charge[N], fired[N], carried[N];
#pragma GCC unroll 2
      for (int k = 0; k < N; ++k) {
        const int64_t p = at + k * LANES;
        v[k] = {load<vi>(ramp.v_whole + p), load<vu>(ramp.v_word + p)};
        low[k] = load<vu>(ramp.v_low + p);
        charge[k] = load<vu>(charges.word + p);
        fired[k] = carried[k] = vu{};
      }
      const int64_t room = std::min<int64_t>(bytes - (at - g) / 8, RUN / 8);
      for (int64_t t = 0; t < ticks; ++t) {
        uint64_t spikes = 0;
#pragma GCC unroll 2
        for (int k = 0; k < N; ++k) {
          const Mask dark = less(v[k].whole, wholes(1));
          const vu after = add_where(dark, charge[k], v[k].word);
          const Mask spike = either(inverse(dark), less(after, charge[k]));
          charge[k] = after;
          fired[k] = add_one(spike, fired[k]);
          spikes |= static_cast<uint64_t>(lane_bits(spike)) << (k * LANES);
          if (ramps) {
            const Mask carry = advance(v[k], low[k], ramp, at + k * LANES);
            carried[k] = add_where(carry, carried[k], words(static_cast<uint32_t>(ticks - 1 - t)));
          }
        }
        if (room == RUN / 8)
          std::memcpy(out + t * frame + (at - g) / 8, &spikes, RUN / 8);
        else
          std::memcpy(out + t * frame + (at - g) / 8, &spikes, static_cast<size_t>(room));
      }
#pragma GCC unroll 2
      for (int k = 0; k < N; ++k) {
        const int64_t p = at + k * LANES;
        clip(p, static_cast<uint64_t>(ticks), charge[k], fired[k], carried[k]);
        store(ramp.v_whole + p, v[k].whole);
        store(ramp.v_word + p, v[k].word);
        store(ramp.v_low + p, low[k]);
        store(charges.word + p, charge[k]);
      }
    }
  }

  // Adds what n ticks clipped, from the light and charge at their start, in the arrays, and what came of it.
  void clip(int64_t p, uint64_t n, vu charge, vu fired, vu carried) {
    alignas(64) uint32_t after[LANES], spikes[LANES], units[LANES];
    store(after, charge);
    store(spikes, fired);
    store(units, carried);
    for (int k = 0; k < LANES; ++k) {
      const uint64_t v = static_cast<uint64_t>(ramp.v_whole[p + k]) << 32 | ramp.v_word[p + k];
      const uint64_t d = static_cast<uint64_t>(ramp.d_whole[p + k]) << 32 | ramp.d_word[p + k];
      const uint64_t in = n * v + n * (n - 1) / 2 * d + units[k];
      charges.lost[p + k] += in - (static_cast<uint64_t>(spikes[k]) << 32) - after[k] + charges.word[p + k];
    }
  }

  // Any light, all of which counts.
  template <bool ramps>
  void run_carried(int64_t g, int64_t ticks, uint8_t *out, int64_t frame, int64_t bytes) {
    for (int64_t at = g; at < g + GROUP && (at - g) / 8 < bytes; at += AT_ONCE * LANES)
      step<ramps, false, false, false>(ramp, charges, nullptr, nullptr, INT32_MAX, at, ticks, 0, out + (at - g) / 8,
                                       frame, bytes - (at - g) / 8);
    uint32_t all = 0;
    for (int64_t i = g; i < g + GROUP; ++i) all |= static_cast<uint32_t>(charges.whole[i]);
    owing[g / GROUP] = all != 0;
  }

  template <bool ramps, bool carry>
  void run_segment(int64_t pixels, int64_t whole, int64_t done, int64_t ticks, uint8_t *out, int64_t frame,
                   int64_t bytes) {
    const double share = 1.0 / static_cast<double>(whole);
    for (int64_t g = 0; g < pixels; g += GROUP) {
      bright[g / GROUP] = ramp.reaches_one(g, GROUP);
      if (carry || bright[g / GROUP])
        ramp.begin<ramps, true>(g, GROUP, share);
      else
        ramp.begin<ramps, false>(g, GROUP, share);
      if (ramps) ramp.skip(g, GROUP, done);
    }
    for (int64_t t = 0; t < ticks; t += TICKS) {
      charges.settle(std::min(TICKS, ticks - t));
      for (int64_t g = 0; g < pixels; g += GROUP) {
        const int64_t n = std::min(TICKS, ticks - t);
        uint8_t *to_bits = out + t * frame + g / 8;
        if (carry && (bright[g / GROUP] || owing[g / GROUP]))
          run_carried<ramps>(g, n, to_bits, frame, bytes - g / 8);
        else if (bright[g / GROUP])
          run_bright<ramps>(g, n, to_bits, frame, bytes - g / 8);
        else
          run_dim<ramps>(g, n, to_bits, frame, bytes - g / 8);
      }
    }
  }
};

}  // namespace

void fire(const Light &light, bool carry, int64_t *charge, uint8_t *bits, double *clipped) {
  const int64_t frame = light.height * ((light.width + 7) / 8), image = light.height * light.width;
  parallel(sections(frame, LENGTH), [&](int part) {
    static thread_local Pixels state;
    const Section at = section(frame, LENGTH, part);
    const int64_t pixels = at.bytes() * 8;
    auto each_run = [&](auto copy) {
      runs(at, light.width, [&](int64_t byte, int64_t pixel, int64_t n) { copy((byte - at.begin) * 8, pixel, n); });
    };
    std::memset(static_cast<void *>(&state), 0, sizeof state);
    each_run([&](int64_t i, int64_t pixel, int64_t n) {
      for (int64_t j = 0; j < n; ++j) {
        state.charges.word[i + j] = static_cast<uint32_t>(charge[pixel + j]);
        state.charges.whole[i + j] = static_cast<int32_t>(charge[pixel + j] >> 32);
        if (state.charges.whole[i + j]) state.owing[(i + j) / GROUP] = true;
      }
    });
    each_segment(light, [&](int64_t k, int64_t whole, int64_t done, int64_t first) {
      const float *from = light.rows + k * image, *to = light.hold ? from : from + image;
      each_run([&](int64_t i, int64_t pixel, int64_t n) {
        std::copy_n(from + pixel, n, state.ramp.from + i);
        std::copy_n(to + pixel, n, state.ramp.to + i);
      });
      const int64_t ticks = std::min(light.knots[k + 1], light.end) - first;
      uint8_t *out = bits + (first - light.begin) * frame + at.begin;
      const auto run = [&](auto ramps, auto all) {
        state.run_segment<decltype(ramps)::value, decltype(all)::value>(pixels, whole, done, ticks, out, frame,
                                                                        at.bytes());
      };
      if (light.hold)
        carry ? run(Flag<false>{}, Flag<true>{}) : run(Flag<false>{}, Flag<false>{});
      else
        carry ? run(Flag<true>{}, Flag<true>{}) : run(Flag<true>{}, Flag<false>{});
    });
    each_run([&](int64_t i, int64_t pixel, int64_t n) {
      for (int64_t j = 0; j < n; ++j) {
        charge[pixel + j] = static_cast<int64_t>(state.charges.whole[i + j]) << 32 | state.charges.word[i + j];
        clipped[pixel + j] = state.charges.lost_of(i + j);
      }
    });
  });
}

}  // namespace spikerig::SPIKERIG_ISA
