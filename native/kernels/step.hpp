// Integrate and fire a tick at a time, for any light and with any of the effects that act on every tick. A pixel's
// charge is a Pair: whole thresholds, signed, and 2^-32 of one. dataset/sim_oracles.py says it in NumPy.
#pragma once
#include "philox.hpp"
#include "ramp.hpp"
#include "spike_kernels.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int AT_ONCE = LANES == 16 ? 2 : LANES == 8 ? 1 : 2;  // vectors, whole bytes of output
constexpr int32_t MOST_WHOLE = (1 << 30) - 1;  // thresholds a pixel can owe; a lost charge beyond it is counted

struct Charges {
  alignas(64) uint32_t word[PIXELS];
  alignas(64) int32_t whole[PIXELS];
  alignas(64) unsigned __int128 lost[PIXELS];  // light that never became charge
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

// Light of one tick after shot noise: light + (Poisson count - mean) / electrons, never negative.
inline Pair shot_noise(Pair light, vf electrons, vf inverse, vu word) {
  const vf mean = (to_float(light.whole) + to_float(light.word) * 0x1p-32f) * electrons;
  const vf off = (poisson(mean, word) - mean) * inverse;
  const vf whole = (off + 12582912.0f) - 12582912.0f;  // 1.5 * 2^23: the nearest whole number
  const vi rest = to_whole((off - whole) * 0x1p31f);
  const Pair after = light + Pair{to_whole(whole) + (rest >> 31), (vu)rest << 1};
  return keep(less(wholes(-1), after.whole), after);
}

// A share of light, in 2^-32, rounded down.
inline Pair share_of(Pair light, vu share) {
  Pair out{vi{}, high_product(light.word, share)};
  if (any(less(vi{}, light.whole)))
    out = out + Pair{(vi)high_product((vu)light.whole, share), (vu)light.whole * share};
  return out;
}

// Noise in thresholds times 2^28, to a pair.
inline Pair from_28(vi noise) { return {noise >> 28, (vu)noise << 4}; }

// Runs `ticks` ticks, the first numbered `tick`, of AT_ONCE vectors of pixels from `at` on. `most`: thresholds of light
// that count in a tick. Without `whole`: no effects, most = 1 and the charge below one threshold.
template <bool ramp, bool whole, bool shot, bool comparator, bool loss>
void step(Ramp &r, Charges &c, Draws *draws, const Noise *noise, int32_t most, int64_t at, int64_t ticks, int64_t tick,
          uint8_t *out, int64_t frame, int64_t room) {
  constexpr int64_t BYTES = AT_ONCE * LANES / 8;
  const vi limit = wholes(most);
  Pair v[AT_ONCE], charge[AT_ONCE], lost[AT_ONCE];
  vu low[AT_ONCE];
  Mask before[AT_ONCE];
  uint64_t spikes = 0;
  if (loss) std::memcpy(&spikes, draws->before + at / 8, BYTES);
  for (int k = 0; k < AT_ONCE; ++k) {
    const int64_t p = at + k * LANES;
    v[k] = {load<vi>(r.v_whole + p), load<vu>(r.v_word + p)};
    low[k] = load<vu>(r.v_low + p);
    charge[k] = {whole ? load<vi>(c.whole + p) : vi{}, load<vu>(c.word + p)};
    lost[k] = Pair{};
    before[k] = from_bits(static_cast<uint32_t>(spikes >> (k * LANES)) & ((1u << LANES) - 1));
  }
  const size_t bytes = static_cast<size_t>(std::min(room, BYTES));
  for (int64_t t = 0; t < ticks; ++t) {
    const int64_t now = tick + t;
    const bool draw = (shot || comparator) && ((now & 3) == 0 || (t == 0 && !draws->drawn));
    spikes = 0;
    for (int k = 0; k < AT_ONCE; ++k) {
      const int64_t p = at + k * LANES;
      if (draw) {
        const vu number = load<vu>(draws->number + p);
        if (shot) {
          const Four words = philox(now >> 2, number, noise->shot_key);
          for (int i = 0; i < 4; ++i) store(draws->shot[i] + p, words.at[i]);
        }
        if (comparator) {
          const Four words = philox(now >> 2, number, noise->comparator_key);
          for (int i = 0; i < 4; ++i) store(draws->comparator[i] + p, words.at[i]);
        }
      }
      Pair in = v[k];
      if (ramp) {
        const vu next = low[k] + load<vu>(r.d_low + p);
        const vu word = v[k].word + load<vu>(r.d_word + p);
        const Mask carry = less(next, low[k]);
        v[k].whole += load<vi>(r.d_whole + p);
        v[k].whole = (vi)add_one(less(word, v[k].word), (vu)v[k].whole);
        v[k].word = add_one(carry, word);
        v[k].whole = (vi)add_one(zero_where(carry, v[k].word), (vu)v[k].whole);
        low[k] = next;
      }
      if (shot)
        in = shot_noise(in, load<vf>(draws->electrons + p), load<vf>(draws->inverse + p),
                        load<vu>(draws->shot[now & 3] + p));
      if (loss) {
        const Pair gone = keep(before[k], share_of(in, words(noise->loss)));
        in = in - gone;
        lost[k] = lost[k] + gone;
      }
      const Mask fits = less(in.whole, limit);
      if (any(inverse(fits))) {
        lost[k] = lost[k] + keep(inverse(fits), Pair{in.whole - most, in.word});
        in = {pick(fits, in.whole, limit), keep(fits, in.word)};
      }
      Mask spike;
      if (whole) {
        charge[k] = charge[k] + in;
        const Mask over = less(wholes(MOST_WHOLE), charge[k].whole);
        if (any(over)) {
          lost[k].whole += (vi)keep(over, (vu)(charge[k].whole - MOST_WHOLE));
          charge[k].whole = pick(over, wholes(MOST_WHOLE), charge[k].whole);
        }
        Pair seen = charge[k];
        if (comparator)
          seen = seen + from_28(to_whole(normal(load<vu>(draws->comparator[now & 3] + p)) * (noise->sd * 0x1p28f)));
        spike = less(vi{}, seen.whole);
        charge[k].whole = (vi)add_where(spike, (vu)charge[k].whole, words(0xFFFFFFFFu));
      } else {
        const vu sum = charge[k].word + in.word;
        spike = either(inverse(fits), less(sum, charge[k].word));
        charge[k].word = sum;
      }
      if (loss) before[k] = spike;
      spikes |= static_cast<uint64_t>(lane_bits(spike)) << (k * LANES);
    }
    std::memcpy(out + t * frame, &spikes, bytes);
  }
  if (loss) std::memcpy(draws->before + at / 8, &spikes, BYTES);
  for (int k = 0; k < AT_ONCE; ++k) {
    const int64_t p = at + k * LANES;
    store(r.v_whole + p, v[k].whole);
    store(r.v_word + p, v[k].word);
    store(r.v_low + p, low[k]);
    store(c.word + p, charge[k].word);
    if (whole) store(c.whole + p, charge[k].whole);
    for (int i = 0; i < LANES; ++i)
      c.lost[p + i] += (static_cast<unsigned __int128>(static_cast<uint32_t>(lost[k].whole[i])) << 32) + lost[k].word[i];
  }
}

}  // namespace
}  // namespace spikerig::SPIKERIG_ISA
