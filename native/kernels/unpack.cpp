// Packed spikes to one byte a pixel.
#include "spike_kernels.hpp"
#include "spike_lanes.hpp"
#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

void line(const uint8_t *from, int64_t pixels, uint8_t *out) {
  int64_t i = 0;
  for (; i + SPREAD <= pixels; i += SPREAD) {
    const Bytes b = spread(from + i / 8, 1);
    std::memcpy(out + i, &b, sizeof b);
  }
  for (; i + 8 <= pixels; i += 8) {
    const uint64_t b = spread8(from[i / 8]);
    std::memcpy(out + i, &b, 8);
  }
  if (i < pixels) {
    const uint64_t b = spread8(from[i / 8]);
    std::memcpy(out + i, &b, static_cast<size_t>(pixels - i));
  }
}

}  // namespace

void unpack(const Packed &s, uint8_t *out) {
  // The whole stream is one tall frame.
  const int64_t all = s.ticks * s.frame(), length = 1 << 15;
  parallel(sections(all, length), [&](int part) {
    runs(section(all, length, part), s.width,
         [&](int64_t byte, int64_t pixel, int64_t n) { line(s.bits + byte, n, out + pixel); });
  });
}

}  // namespace spikerig::SPIKERIG_ISA
