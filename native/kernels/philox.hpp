// Random words, normal numbers and Poisson counts of a key, a tick and a pixel. dataset/philox.py defines them in NumPy,
// says where they come from, and agrees in every bit: no fused multiply-adds, the same order of operations.
//
// Everything comes in fours, for four ticks in a row: one hash gives four words, and four chains of dependent
// operations side by side keep the arithmetic units busy where one would wait for itself.
#pragma once
#include "word_lanes.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

template <class V>
struct Four {
  V at[4];
};

// f of each of the four, and of the four of others.
template <class F, class... V>
inline auto each(F f, const Four<V> &...x) {
  return Four<decltype(f(x.at[0]...))>{{f(x.at[0]...), f(x.at[1]...), f(x.at[2]...), f(x.at[3]...)}};
}

inline bool any(const Four<Mask> &m) { return any(either(either(m.at[0], m.at[1]), either(m.at[2], m.at[3]))); }

// One word for each of four ticks, of the pixels in the lanes: Philox4x32-10 of (quad low, quad high, pixel, 0).
// Even and odd lanes are hashed apart, in wide lanes of which only the low word counts.
inline Four<vu> philox(int64_t quad, vu pixel, const uint32_t key[2]) {
  const vw m0 = vw{} + 0xD2511F53u, m1 = vw{} + 0xCD9E8D57u;
  vw c0[2], c1[2], c2[2], c3[2];
  for (int odd = 0; odd < 2; ++odd) {
    c0[odd] = vw{} + static_cast<uint32_t>(quad);
    c1[odd] = vw{} + static_cast<uint32_t>(static_cast<uint64_t>(quad) >> 32);
    c2[odd] = odd ? (vw)pixel >> 32 : (vw)pixel;
    c3[odd] = vw{};
  }
  uint32_t k0 = key[0], k1 = key[1];
#pragma GCC unroll 10
  for (int round = 0; round < 10; ++round) {
#pragma GCC unroll 2
    for (int odd = 0; odd < 2; ++odd) {
      const vw p0 = low_product(m0, c0[odd]), p1 = low_product(m1, c2[odd]);
      c0[odd] = (p1 >> 32) ^ c1[odd] ^ (vw{} + k0);
      c1[odd] = p1;
      c2[odd] = (p0 >> 32) ^ c3[odd] ^ (vw{} + k1);
      c3[odd] = p0;
    }
    k0 += 0x9E3779B9u;
    k1 += 0xBB67AE85u;
  }
  return {{weave(c0[0], c0[1]), weave(c1[0], c1[1]), weave(c2[0], c2[1]), weave(c3[0], c3[1])}};
}

template <int N>
inline Four<vf> polynomial(const float (&rising)[N], const Four<vf> &x) {
  Four<vf> p = each([&](vf) { return floats(rising[N - 1]); }, x);
#pragma GCC unroll 8
  for (int i = N - 2; i >= 0; --i) p = each([&](vf p, vf x) { return p * x + rising[i]; }, p, x);
  return p;
}

constexpr float LOG2[7] = {1.4426935911178589f, -0.7214025855064392f, 0.48106637597084045f, -0.35773220658302307f,
                           0.283658891916275f,  -0.2842307388782501f, 0.2570645809173584f};
constexpr float CENTRE[8] = {1.2533117532730103f,     0.2274535596370697f,     0.00779822887852788f,
                             -0.0010466594249010086f, -7.223698048619553e-05f, 2.0450281226658262e-05f,
                             -1.48395349697239e-06f,  3.8950791036995724e-08f};
constexpr float TAIL[8] = {4.4753618240356445f,    1.184531331062317f,      0.004461626056581736f,
                           -0.002450686413794756f, 0.0012992979027330875f,  -0.0007985380943864584f,
                           0.0003666246775537729f, -7.405880751321092e-05f};
constexpr float EXP2[6] = {0.6931471824645996f,   0.24022650718688965f,  0.055503278970718384f,
                           0.009618005715310574f, 0.0013400283642113209f, 0.00015475897816941142f};

// The standard normal quantile of (word + 1/2) / 2^32.
inline Four<vf> normal(const Four<vu> &word) {
  const Four<vf> p = each(
      [](vu word) {
        const vu near = word ^ (vu)((vi)word >> 31);
        return (to_float((vi)near) + 0.5f) * 0x1p-32f;
      },
      word);
  const Four<vf> y = each([](vf p) { return p * 4.0f * (1.0f - p); }, p);
  const Four<vi> exponent = each([](vf y) { return ((vi)y - 0x3F2AAAAB) >> 23; }, y);
  const Four<vf> t = each([](vf y, vi e) { return (vf)((vi)y - (e << 23)) - 1.0f; }, y, exponent);
  const Four<vf> log = each([](vi e, vf t, vf p) { return -(to_float(e) + t * p); }, exponent, t, polynomial(LOG2, t));
  Four<vf> ratio = polynomial(CENTRE, log);
  const Four<Mask> tail = each([](vf log) { return inverse(less(log, floats(8.0f))); }, log);
  if (any(tail)) {
    const Four<vf> r = each([](Mask m, vf log) { return root(pick(m, log, floats(8.0f))) - 4.0f; }, tail, log);
    ratio = each([](Mask m, vf a, vf b) { return pick(m, a, b); }, tail, polynomial(TAIL, r), ratio);
  }
  return each(
      [](vu word, vf ratio) { return (to_float((vi)(word ^ 0x80000000u)) + 0.5f) * 0x1p-31f * ratio; }, word, ratio);
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

// The count whose chance of being reached or passed is still above 1 - u, in float64.
[[maybe_unused]] __attribute__((noinline)) vf poisson_rare(vf mean, vu word) {
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
      term = term * (m * (1.0 / k));
      above = above - term;
    }
    const half_floats found = __builtin_convertvector(count, half_floats);
    std::memcpy(out + half * LANES / 2, &found, sizeof found);
  }
  return load<vf>(out);
}

// Counts of means below eight, by inversion.
[[maybe_unused]] __attribute__((noinline)) Four<vf> poisson_few(const Four<vf> &mean, const Four<vu> &word) {
  Four<vf> chance = each([](vu word) { return (to_float(~word) + 0.5f) * 0x1p-32f; }, word);
  const Four<Mask> rare = each([](vf chance) { return less(chance, floats(0x1p-12f)); }, chance);
  chance = each([](Mask rare, vf chance) { return pick(rare, floats(1.0f), chance); }, rare, chance);
  const Four<vf> scaled = each([](vf m) { return m * -1.4426950408889634f; }, mean);
  const Four<vf> n = each([](vf x) { return (x + 12582912.0f) - 12582912.0f; }, scaled);
  const Four<vf> t = each([](vf x, vf n) { return x - n; }, scaled, n);
  const Four<vf> scale = each([](vf n) { return (vf)((to_whole(n) + 127) << 23); }, n);
  const Four<vf> change = each([](vf s, vf t, vf p) { return s * (t * p); }, scale, t, polynomial(EXP2, t));
  Four<vf> term = each([](vf s, vf c) { return s + c; }, scale, change);
  Four<vf> above = each([](vf s, vf c) { return (1.0f - s) - c; }, scale, change);
  Four<vf> count = each([](vf) { return vf{}; }, mean);
  for (int k = 1; k < 64; ++k) {
    const Four<Mask> more = each([](vf chance, vf above) { return less(chance, above); }, chance, above);
    if (!any(more)) break;
    const float inverse_k = static_cast<float>(1.0 / k);
    count = each([](Mask more, vf count) { return add_where(more, count, floats(1.0f)); }, more, count);
    term = each([&](vf term, vf m) { return term * (m * inverse_k); }, term, mean);
    above = each([](vf above, vf term) { return above - term; }, above, term);
  }
  if (any(rare))
    for (int j = 0; j < 4; ++j)
      if (any(rare.at[j])) count.at[j] = pick(rare.at[j], poisson_rare(mean.at[j], word.at[j]), count.at[j]);
  return count;
}

// Counts of means from eight.
inline Four<vf> poisson_many(const Four<vf> &mean, const Four<vu> &word) {
  const Four<vf> z = normal(word);
  const Four<vf> s = each([](vf m) { return root(m); }, mean), r = each([](vf s) { return 1.0f / s; }, s);
  const Four<vf> rr = each([](vf r) { return r * r; }, r);
  Four<vf> change = each(
      [](vf rr, vf r, vf z) { return rr * static_cast<float>(1.0 / 270) * z + r * static_cast<float>(-1.0 / 72); }, rr,
      r, z);
  change = each(
      [](vf c, vf z, vf rr) { return c * z + (static_cast<float>(1.0 / 6) + rr * static_cast<float>(7.0 / 810)); },
      change, z, rr);
  change = each([](vf c, vf z, vf s, vf r) { return c * z + (s - r * static_cast<float>(1.0 / 36)); }, change, z, s, r);
  change = each(
      [](vf c, vf z, vf rr) { return c * z + (static_cast<float>(1.0 / 3) - rr * static_cast<float>(8.0 / 405)); },
      change, z, rr);
  return each(
      [](vf mean, vf change) {
        const vf sum = mean + change, count = pick(less(sum, vf{}), vf{}, sum);
        const Mask fits = less(count, floats(0x1p24f));
        return pick(fits, to_float(to_whole(pick(fits, count, vf{}))), count);
      },
      mean, change);
}

inline Four<vf> poisson(const Four<vf> &mean, const Four<vu> &word) {
  const Four<Mask> few = each([](vf m) { return less(m, floats(8.0f)); }, mean);
  if (!any(few)) return poisson_many(mean, word);
  const Four<vf> counted = poisson_few(each([](Mask few, vf m) { return pick(few, m, vf{}); }, few, mean), word);
  const Four<Mask> many = each([](Mask few) { return inverse(few); }, few);
  if (!any(many)) return counted;
  return each([](Mask few, vf a, vf b) { return pick(few, a, b); }, few, counted,
              poisson_many(each([](Mask few, vf m) { return pick(few, floats(8.0f), m); }, few, mean), word));
}

}  // namespace
}  // namespace spikerig::SPIKERIG_ISA
