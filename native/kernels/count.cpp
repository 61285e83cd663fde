// Spikes a pixel in a window, without unpacking: eight ticks at a time through carry-save adders into bit planes
// (plane p holds bit p of every pixel's count), planes into counts when they are full.
#include "spike_kernels.hpp"
#include "spike_lanes.hpp"
#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int64_t LENGTH = 1024;  // bytes of a section: its planes stay in L1
constexpr int PLANES = 8;
constexpr int64_t FULL = 248;     // ticks a set of planes can take: a multiple of 8 below 2^PLANES

struct Planes {
  alignas(64) uint8_t bits[PLANES][LENGTH];
};

// Adds eight vectors at byte j of the section to planes 0 .. n - 1; d(k) is the k-th.
template <class Load>
inline void add8(Planes &p, int n, int64_t j, Load d) {
  Wide ones = load_wide(p.bits[0] + j), twos = load_wide(p.bits[1] + j), fours = load_wide(p.bits[2] + j);
  Wide a, b, low, high, up;
  add3(a, ones, ones, d(0), d(1));
  add3(b, ones, ones, d(2), d(3));
  add3(low, twos, twos, a, b);
  add3(a, ones, ones, d(4), d(5));
  add3(b, ones, ones, d(6), d(7));
  add3(high, twos, twos, a, b);
  add3(up, fours, fours, low, high);
  store_wide(p.bits[0] + j, ones);
  store_wide(p.bits[1] + j, twos);
  store_wide(p.bits[2] + j, fours);
  for (int k = 3; k < n; ++k) {
    const Wide x = load_wide(p.bits[k] + j);
    store_wide(p.bits[k] + j, x ^ up);
    up = x & up;
  }
}

void add_ticks(Planes &p, int n, const Packed &s, Section at, int64_t t0, int64_t t1) {
  static const uint8_t dark[LENGTH] = {};
  const int64_t frame = s.frame(), bytes = at.bytes(), whole = bytes / WIDE * WIDE, rest = bytes - whole;
  for (int64_t t = t0; t < t1; t += 8) {
    const uint8_t *row[8];
    for (int k = 0; k < 8; ++k) row[k] = t + k < t1 ? s.bits + (t + k) * frame + at.begin : dark;
    for (int64_t j = 0; j < whole; j += WIDE) add8(p, n, j, [&](int k) { return load_wide(row[k] + j); });
    if (rest) {
      add8(p, n, whole, [&](int k) {
        uint8_t padded[WIDE] = {};
        std::memcpy(padded, row[k] + whole, static_cast<size_t>(rest));
        return load_wide(padded);
      });
    }
  }
}

// Adds what planes 0 .. n - 1 hold from byte `at` on to the counts of `pixels` pixels.
void add_planes(const Planes &p, int n, int64_t at, int64_t pixels, bool first, uint32_t *out) {
  alignas(64) uint8_t sum[SPREAD];
  for (int64_t i = 0; i < pixels; i += SPREAD) {
    Bytes total = spread(p.bits[0] + at + i / 8, 1);
    for (int k = 1; k < n; ++k) total |= spread(p.bits[k] + at + i / 8, static_cast<uint8_t>(1 << k));
    std::memcpy(sum, &total, sizeof total);
    if (i + SPREAD <= pixels) {
      if (first)
        for (int k = 0; k < SPREAD; ++k) out[i + k] = sum[k];
      else
        for (int k = 0; k < SPREAD; ++k) out[i + k] += sum[k];
    } else {
      for (int k = 0; i + k < pixels; ++k) out[i + k] = (first ? 0 : out[i + k]) + sum[k];
    }
  }
}

int bits_for(int64_t n) {
  int k = 3;  // add8 always writes three planes
  while ((int64_t{1} << k) <= n) ++k;
  return k;
}

}  // namespace

void count(const Packed &s, int64_t t0, int64_t t1, uint32_t *out) {
  parallel(sections(s.frame(), LENGTH), [&](int part) {
    const Section at = section(s.frame(), LENGTH, part);
    // spread() may read SPREAD/8 bytes past a run's end: the planes' own slack, never the stream's
    static thread_local struct { Planes planes; uint8_t slack[64]; } room;
    bool first = true;
    for (int64_t t = t0; first || t < t1; t += FULL, first = false) {
      const int64_t stop = std::min(t + FULL, t1);
      const int n = bits_for(stop - t);
      for (int k = 0; k < n; ++k) std::memset(room.planes.bits[k], 0, LENGTH);
      add_ticks(room.planes, n, s, at, t, stop);
      runs(at, s.width, [&](int64_t byte, int64_t pixel, int64_t pixels) {
        add_planes(room.planes, n, byte - at.begin, pixels, first, out + pixel);
      });
    }
  });
}

}  // namespace spikerig::SPIKERIG_ISA
