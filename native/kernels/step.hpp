// Integrate and fire a tick at a time, for any light and with any of the effects that act on every tick. A pixel's
// charge is a Pair: whole thresholds, signed, and 2^-32 of one. dataset/sim_oracles.py says it in NumPy.
#pragma once
#include "philox.hpp"
#include "ramp.hpp"
#include "spike_kernels.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int AT_ONCE = LANES == 8 ? 1 : 2;  // vectors, whole bytes of output
constexpr int32_t MOST_WHOLE = (1 << 30) - 1;  // thresholds a pixel can owe; a lost charge beyond it is counted

template <bool b>
struct Flag {
  static constexpr bool value = b;
};

struct Charges {
  alignas(64) uint32_t word[PIXELS];
  alignas(64) int32_t whole[PIXELS];
  alignas(64) uint64_t lost[PIXELS];  // light that never became charge, since the last settle()
  alignas(64) unsigned __int128 all_lost[PIXELS];
  int64_t unsettled;  // ticks

  // Light of up to 2^18 thresholds a tick fits 64 bits for 2^14 ticks.
  void settle(int64_t next_ticks) {
    if ((unsettled += next_ticks) <= 8192) return;
    unsettled = next_ticks;
    for (int64_t i = 0; i < PIXELS; ++i) {
      all_lost[i] += lost[i];
      lost[i] = 0;
    }
  }
  double lost_of(int64_t i) const { return static_cast<double>(all_lost[i] + lost[i]) / UNIT; }

  void lose(int64_t i, Pair light) {
    alignas(64) int32_t whole_of[LANES];
    alignas(64) uint32_t word_of[LANES];
    store(whole_of, light.whole);
    store(word_of, light.word);
    for (int k = 0; k < LANES; ++k)
      lost[i + k] += static_cast<uint64_t>(static_cast<uint32_t>(whole_of[k])) << 32 | word_of[k];
  }
};

// What only noise needs.
struct Draws {
  alignas(64) uint32_t number[PIXELS];  // y * width + x
  alignas(64) float electrons[PIXELS], inverse[PIXELS];
  alignas(64) uint32_t shot[4][PIXELS], comparator[4][PIXELS];  // words of four ticks, those of `quad`
  uint8_t before[LENGTH];  // spikes of the tick before
  int64_t quad;
  bool drawn;
};

// The words of `quad` for the pixels from p on: drawn, or those of an earlier stretch of ticks.
inline Four<vu> words_of(uint32_t (&kept)[4][PIXELS], const Draws &d, int64_t quad, const uint32_t key[2], int64_t p) {
  if (d.drawn && d.quad == quad)
    return {{load<vu>(kept[0] + p), load<vu>(kept[1] + p), load<vu>(kept[2] + p), load<vu>(kept[3] + p)}};
  const Four<vu> words = philox(quad, load<vu>(d.number + p), key);
  for (int i = 0; i < 4; ++i) store(kept[i] + p, words.at[i]);
  return words;
}

// Light after shot noise: light + (Poisson count - mean) / electrons, never negative.
inline Four<Pair> shot_noise(const Four<Pair> &light, vf electrons, vf inverse, const Four<vu> &word) {
  const Four<vf> mean =
      each([&](Pair light) { return (to_float(light.whole) + to_float(light.word) * 0x1p-32f) * electrons; }, light);
  return each(
      [&](Pair light, vf count, vf mean) {
        const vf off = (count - mean) * inverse;
        const vf whole = (off + 12582912.0f) - 12582912.0f;  // 1.5 * 2^23: the nearest whole number
        const vi rest = to_whole((off - whole) * 0x1p31f);
        const Pair after = light + Pair{to_whole(whole) + (rest >> 31), (vu)rest << 1};
        return keep(less(wholes(-1), after.whole), after);
      },
      light, poisson(mean, word), mean);
}

// Noise in thresholds times 2^28, to a pair.
inline Pair from_28(vi noise) { return {noise >> 28, (vu)noise << 4}; }

// A share of light, in 2^-32, rounded down.
inline Pair share_of(Pair light, vu share) {
  Pair out{vi{}, high_product(light.word, share)};
  if (any(less(vi{}, light.whole)))
    out = out + Pair{(vi)high_product((vu)light.whole, share), (vu)light.whole * share};
  return out;
}

// Light of the next tick; returns where the low words carried.
inline Mask advance(Pair &v, vu &low, const Ramp &r, int64_t p) {
  const vu next = low + load<vu>(r.d_low + p), word = v.word + load<vu>(r.d_word + p);
  const Mask carry = less(next, low);
  v.whole = (vi)add_one(less(word, v.word), (vu)(v.whole + load<vi>(r.d_whole + p)));
  v.word = add_one(carry, word);
  v.whole = (vi)add_one(zero_where(carry, v.word), (vu)v.whole);
  low = next;
  return carry;
}

// Runs `ticks` ticks, the first numbered `tick`, of AT_ONCE vectors of pixels from `at` on; `most` thresholds of light
// count in a tick. `draws` and `noise` are not looked at without noise.
template <bool ramp, bool shot, bool comparator, bool loss>
void step(Ramp &r, Charges &c, Draws *draws, const Noise *noise, int32_t most, int64_t at, int64_t ticks, int64_t tick,
          uint8_t *out, int64_t frame, int64_t room) {
  constexpr int64_t BYTES = AT_ONCE * LANES / 8;
  const vi limit = wholes(most);
  Pair v[AT_ONCE], charge[AT_ONCE], lost[AT_ONCE];
  vu low[AT_ONCE];
  Mask before[AT_ONCE];
  uint64_t last = 0;
  if (loss) std::memcpy(&last, draws->before + at / 8, BYTES);
#pragma GCC unroll 2
  for (int k = 0; k < AT_ONCE; ++k) {
    const int64_t p = at + k * LANES;
    v[k] = {load<vi>(r.v_whole + p), load<vu>(r.v_word + p)};
    low[k] = load<vu>(r.v_low + p);
    charge[k] = {load<vi>(c.whole + p), load<vu>(c.word + p)};
    lost[k] = Pair{};
    before[k] = from_bits(static_cast<uint32_t>(last >> (k * LANES)) & ((1u << LANES) - 1));
  }
  // Four ticks at a time, those whose numbers differ in the last two bits; of the first and last, some.
  const auto four = [&](auto some, int64_t t, int from, int to) {
    constexpr bool full = !decltype(some)::value;
    const int64_t quad = (tick + t) >> 2;
    uint64_t spikes[4] = {};
#pragma GCC unroll 2
    for (int k = 0; k < AT_ONCE; ++k) {
      const int64_t p = at + k * LANES;
      Four<Pair> in;
#pragma GCC unroll 4
      for (int j = 0; j < 4; ++j) {
        in.at[j] = v[k];
        if (ramp && (full || (j >= from && j < to))) advance(v[k], low[k], r, p);
      }
      if (shot)
        in = shot_noise(in, load<vf>(draws->electrons + p), load<vf>(draws->inverse + p),
                        words_of(draws->shot, *draws, quad, noise->shot_key, p));
      Four<Pair> jitter;
      if (comparator)
        jitter = each([&](vf z) { return from_28(to_whole(z * (noise->sd * 0x1p28f))); },
                      normal(words_of(draws->comparator, *draws, quad, noise->comparator_key, p)));
#pragma GCC unroll 4
      for (int j = 0; j < 4; ++j) {
        if (!full && (j < from || j >= to)) continue;
        Pair now = in.at[j];
        if (loss) {
          const Pair gone = keep(before[k], share_of(now, words(noise->loss)));
          now = now - gone;
          lost[k] = lost[k] + gone;
        }
        const Mask over = inverse(less(now.whole, limit));
        if (any(over)) {
          lost[k] = lost[k] + keep(over, Pair{now.whole - most, now.word});
          now = pick(over, Pair{limit, vu{}}, now);
        }
        charge[k] = charge[k] + now;
        const Mask full_up = less(wholes(MOST_WHOLE), charge[k].whole);
        if (any(full_up)) {
          lost[k].whole += (vi)keep(full_up, (vu)(charge[k].whole - MOST_WHOLE));
          charge[k].whole = pick(full_up, wholes(MOST_WHOLE), charge[k].whole);
        }
        const Pair seen = comparator ? charge[k] + jitter.at[j] : charge[k];
        const Mask spike = less(vi{}, seen.whole);
        charge[k].whole = (vi)add_where(spike, (vu)charge[k].whole, words(0xFFFFFFFFu));
        if (loss) before[k] = spike;
        spikes[j] |= static_cast<uint64_t>(lane_bits(spike)) << (k * LANES);
      }
    }
#pragma GCC unroll 4
    for (int j = 0; j < 4; ++j) {
      if (!full && (j < from || j >= to)) continue;
      uint8_t *row = out + (t + j - (full ? 0 : from)) * frame;
      if (room >= BYTES)
        std::memcpy(row, spikes + j, BYTES);
      else
        std::memcpy(row, spikes + j, static_cast<size_t>(room));
      last = spikes[j];
    }
  };
  for (int64_t t = 0; t < ticks;) {
    const int from = static_cast<int>((tick + t) & 3), to = static_cast<int>(std::min<int64_t>(4, from + ticks - t));
    if (to - from == 4)
      four(Flag<false>{}, t, 0, 4);
    else
      four(Flag<true>{}, t, from, to);
    t += to - from;
  }
  if (loss) std::memcpy(draws->before + at / 8, &last, BYTES);
#pragma GCC unroll 2
  for (int k = 0; k < AT_ONCE; ++k) {
    const int64_t p = at + k * LANES;
    store(r.v_whole + p, v[k].whole);
    store(r.v_word + p, v[k].word);
    store(r.v_low + p, low[k]);
    store(c.word + p, charge[k].word);
    store(c.whole + p, charge[k].whole);
    c.lose(p, lost[k]);
  }
}

}  // namespace
}  // namespace spikerig::SPIKERIG_ISA
