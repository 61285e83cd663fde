// The spike kernels, declared for every instruction set. dataset/oracles.py defines what each returns.
#pragma once
#include <algorithm>
#include <cstdint>

#include "dispatch.hpp"

namespace spikerig {

// uint8[ticks, height, row()]: top row first, rows padded to bytes, pixel x is bit x%8 of byte x/8.
struct Packed {
  const uint8_t *bits;
  int64_t ticks, height, width;
  int64_t row() const { return (width + 7) / 8; }
  int64_t frame() const { return height * row(); }
};

// A frame is cut into sections: byte ranges [begin, end) of fixed length, each worked on by one thread.
struct Section {
  int64_t begin, end;
  int64_t bytes() const { return end - begin; }
};

inline int sections(int64_t frame_bytes, int64_t length) {
  return static_cast<int>((frame_bytes + length - 1) / length);
}

inline Section section(int64_t frame_bytes, int64_t length, int part) {
  return {part * length, std::min(frame_bytes, (part + 1) * length)};
}

// Calls run(byte, pixel, n) for each stretch of a section whose n pixels follow each other both in the packed
// frame (from `byte`) and in an unpadded image (from `pixel`): the whole section where rows need no padding.
template <class Run>
void runs(Section s, int64_t width, Run run) {
  if (width % 8 == 0) {
    run(s.begin, s.begin * 8, s.bytes() * 8);
    return;
  }
  const int64_t row = (width + 7) / 8;
  for (int64_t byte = s.begin; byte < s.end;) {
    const int64_t y = byte / row, x = (byte - y * row) * 8;
    const int64_t stop = std::min(s.end, (y + 1) * row);
    run(byte, y * width + x, std::min((stop - byte) * 8, width - x));
    byte = stop;
  }
}

// Light at knots, in thresholds a tick; see fire() in dataset/oracles.py.
struct Light {
  const float *rows;       // float32[.., height, width]
  const int64_t *knots;    // int64[segments + 1]
  int64_t segments, height, width;
  bool hold;               // rows[k] over segment k; else linear from rows[k] to rows[k + 1]
  int64_t begin, end;      // ticks that are run, within the knots
  int64_t ticks() const { return end - begin; }
};

// Calls run(k, ticks, done, first) for each segment that is run at least in part: how many ticks the segment has, how
// many of them were before, and the tick it starts with; run(k, ...) runs first .. min(knots[k + 1], end).
template <class Run>
void each_segment(const Light &light, Run run) {
  for (int64_t k = 0; k < light.segments; ++k) {
    const int64_t from = light.knots[k], to = light.knots[k + 1], first = std::max(from, light.begin);
    if (first < std::min(to, light.end)) run(k, to - from, first - from, first);
  }
}

// Noise of fire_noisy(), in dataset/sim_oracles.py.
struct Noise {
  const float *electrons;      // [height, width] electrons that make a threshold; null: no shot noise
  uint32_t shot_key[2];
  float sd;                    // of the comparator, thresholds; 0: no noise
  uint32_t comparator_key[2];
  uint32_t loss;               // share of a tick's light lost after a spike, in 2^-32
};

#define SPIKERIG_DECLARE_SPIKE_KERNELS(isa)                                                                     \
  namespace isa {                                                                                               \
  void unpack(const Packed &s, uint8_t *out);                                                                   \
  void count(const Packed &s, int64_t t0, int64_t t1, uint32_t *out);                                           \
  void tfi_at(const Packed &s, int64_t tick, int before, int after, int32_t *previous, int32_t *next);          \
  void tfi_all(const Packed &s, uint16_t *out);                                                                 \
  void fire(const Light &light, bool carry, int64_t *charge, uint8_t *bits, double *clipped);                   \
  void fire_noisy(const Light &light, int64_t first_tick, const Noise &noise, bool carry, int64_t *charge,      \
                  const uint8_t *before, uint8_t *bits, double *lost);                                          \
  }
SPIKERIG_EACH_ISA(SPIKERIG_DECLARE_SPIKE_KERNELS)

}  // namespace spikerig
