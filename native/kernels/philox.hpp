// Random words, normal numbers and Poisson counts of a key, a tick and a pixel. dataset/philox.py defines them in NumPy,
// says where they come from, and agrees in every bit: no fused multiply-adds, the same order of operations.
#pragma once
#include "word_lanes.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

struct Four {
  vu at[4];
};

// One word for each of four ticks, of the pixels in the lanes: Philox4x32-10 of (quad low, quad high, pixel, 0).
// Even and odd lanes are hashed apart, in wide lanes of which only the low word counts.
inline Four philox(int64_t quad, vu pixel, const uint32_t key[2]) {
  const vw m0 = vw{} + 0xD2511F53u, m1 = vw{} + 0xCD9E8D57u;
  vw c0[2], c1[2], c2[2], c3[2];
  for (int odd = 0; odd < 2; ++odd) {
    c0[odd] = vw{} + static_cast<uint32_t>(quad);
    c1[odd] = vw{} + static_cast<uint32_t>(static_cast<uint64_t>(quad) >> 32);
    c2[odd] = odd ? (vw)pixel >> 32 : (vw)pixel;
    c3[odd] = vw{};
  }
  uint32_t k0 = key[0], k1 = key[1];
  for (int round = 0; round < 10; ++round, k0 += 0x9E3779B9u, k1 += 0xBB67AE85u)
    for (int odd = 0; odd < 2; ++odd) {
      const vw p0 = low_product(m0, c0[odd]), p1 = low_product(m1, c2[odd]);
      c0[odd] = (p1 >> 32) ^ c1[odd] ^ (vw{} + k0);
      c1[odd] = p1;
      c2[odd] = (p0 >> 32) ^ c3[odd] ^ (vw{} + k1);
      c3[odd] = p0;
    }
  return {{weave(c0[0], c0[1]), weave(c1[0], c1[1]), weave(c2[0], c2[1]), weave(c3[0], c3[1])}};
}

inline vf polynomial(const float (&rising)[8], vf x) {
  vf p = floats(rising[7]);
  for (int i = 6; i >= 0; --i) p = p * x + rising[i];
  return p;
}

constexpr float LOG2[8] = {1.442694067955017f,  -0.7213439345359802f,  0.4810193181037903f,  -0.36092716455459595f,
                           0.2845945954322815f, -0.23468632996082306f, 0.25199463963508606f, -0.23195520043373108f};
constexpr float CENTRE[8] = {1.2533117532730103f,     0.2274535596370697f,     0.00779822887852788f,
                             -0.0010466594249010086f, -7.223698048619553e-05f, 2.0450281226658262e-05f,
                             -1.48395349697239e-06f,  3.8950791036995724e-08f};
constexpr float TAIL[8] = {4.4753618240356445f,    1.184531331062317f,    0.004461626056581736f, -0.002450686413794756f,
                           0.0012992979027330875f, -0.0007985380943864584f, 0.0003666246775537729f,
                           -7.405880751321092e-05f};

// The standard normal quantile of (word + 1/2) / 2^32.
inline vf normal(vu word) {
  const vu near = word ^ (vu)((vi)word >> 31);
  const vf p = (to_float((vi)near) + 0.5f) * 0x1p-32f;
  const vf y = p * 4.0f * (1.0f - p);
  const vi exponent = ((vi)y - 0x3F2AAAAB) >> 23;
  const vf t = (vf)((vi)y - (exponent << 23)) - 1.0f;
  const vf log = -(to_float(exponent) + t * polynomial(LOG2, t));
  vf ratio = polynomial(CENTRE, log);
  const Mask centre = less(log, floats(8.0f));
  if (any(inverse(centre))) {
    const vf tail = polynomial(TAIL, root(pick(centre, floats(8.0f), log)) - 4.0f);
    ratio = pick(centre, ratio, tail);
  }
  return (to_float((vi)(word ^ 0x80000000u)) + 0.5f) * 0x1p-31f * ratio;
}

typedef double vd __attribute__((vector_size(4 * LANES)));  // half as many
typedef int64_t vl __attribute__((vector_size(4 * LANES)));

inline vd exp_minus(vd x) {
  const double magic = 6755399441055744.0;
  const vd shifted = x * -1.4426950408889634 + magic;
  const vd n = shifted - magic;
  const vd r = (-x - n * 6.93147180369123816490e-01) - n * 1.90821492927058770002e-10;
  vd p = vd{} + 1.0 / 6227020800.0;
  const double factorial[] = {479001600.0, 39916800.0, 3628800.0, 362880.0, 40320.0, 5040.0, 720.0,
                              120.0,       24.0,       6.0,       2.0,      1.0,     1.0};
  for (double f : factorial) p = p * r + 1.0 / f;
  return (vd)((vl)p + ((vl)shifted << 52));
}

// Counts of means below eight, by inversion.
inline vf poisson_few(vf mean, vu word) {
  typedef float half_floats __attribute__((vector_size(2 * LANES)));
  typedef uint32_t half_words __attribute__((vector_size(2 * LANES)));
  float out[LANES];
  for (int half = 0; half < 2; ++half) {
    half_floats m32;
    half_words w32;
    std::memcpy(&m32, reinterpret_cast<const char *>(&mean) + half * sizeof m32, sizeof m32);
    std::memcpy(&w32, reinterpret_cast<const char *>(&word) + half * sizeof w32, sizeof w32);
    const vd m = __builtin_convertvector(m32, vd);
    const vd chance = (__builtin_convertvector(~w32, vd) + 0.5) * 0x1p-32;
    vd term = exp_minus(m), above = 1.0 - term, count{};
    for (int k = 1; k < 64; ++k) {
      const vl more = chance < above;
      bool none = true;
      for (int i = 0; i < LANES / 2; ++i) none &= more[i] == 0;
      if (none) break;
      count += (vd)(more & (vl)(vd{} + 1.0));
      term = term * m * (1.0 / k);
      above = above - term;
    }
    const half_floats found = __builtin_convertvector(count, half_floats);
    std::memcpy(out + half * LANES / 2, &found, sizeof found);
  }
  return load<vf>(out);
}

// Counts of means from eight.
inline vf poisson_many(vf mean, vu word) {
  const vf z = normal(word), s = root(mean), r = 1.0f / s, rr = r * r;
  vf change = rr * static_cast<float>(1.0 / 270) * z + r * static_cast<float>(-1.0 / 72);
  change = change * z + (static_cast<float>(1.0 / 6) + rr * static_cast<float>(7.0 / 810));
  change = change * z + (s - r * static_cast<float>(1.0 / 36));
  change = change * z + (static_cast<float>(1.0 / 3) - rr * static_cast<float>(8.0 / 405));
  const vf sum = mean + change, count = pick(less(sum, vf{}), vf{}, sum);
  const Mask fits = less(count, floats(0x1p24f));
  return pick(fits, to_float(to_whole(pick(fits, count, vf{}))), count);
}

inline vf poisson(vf mean, vu word) {
  const Mask few = less(mean, floats(8.0f));
  if (!any(few)) return poisson_many(mean, word);
  const vf counted = poisson_few(pick(few, mean, vf{}), word);
  if (!any(inverse(few))) return counted;
  return pick(few, counted, poisson_many(pick(few, floats(8.0f), mean), word));
}

}  // namespace
}  // namespace spikerig::SPIKERIG_ISA
