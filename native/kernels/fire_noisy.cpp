// Integrate and fire with noise: shot noise and comparator noise drawn anew for every pixel and tick, light lost in
// resets. What is off is not compiled into the loop that runs.
#include "step.hpp"
#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

struct State {
  Ramp ramp;
  Charges charges;
  Draws draws;
};

using Step = decltype(&step<true, true, true, true>);

// By shot, comparator and loss.
Step step_for(const Noise &noise) {
  static const Step table[8] = {
      step<true, false, false, false>, step<true, true, false, false>, step<true, false, true, false>,
      step<true, true, true, false>,   step<true, false, false, true>, step<true, true, false, true>,
      step<true, false, true, true>,   step<true, true, true, true>,
  };
  return table[(noise.electrons ? 1 : 0) + (noise.sd > 0 ? 2 : 0) + (noise.loss ? 4 : 0)];
}

}  // namespace

void fire_noisy(const Light &light, int64_t first_tick, const Noise &noise, bool carry, int64_t *charge,
                const uint8_t *before, uint8_t *bits, double *lost) {
  const int64_t frame = light.height * ((light.width + 7) / 8), image = light.height * light.width;
  const Step run = step_for(noise);
  parallel(sections(frame, LENGTH), [&](int part) {
    static thread_local State s;
    const Section at = section(frame, LENGTH, part);
    const int64_t pixels = at.bytes() * 8;
    auto each_run = [&](auto copy) {
      runs(at, light.width, [&](int64_t byte, int64_t pixel, int64_t n) { copy((byte - at.begin) * 8, pixel, n); });
    };
    std::memset(static_cast<void *>(&s), 0, sizeof s);
    for (int64_t i = 0; i < PIXELS; ++i) s.charges.whole[i] = -(1 << 30);  // padding pixels: noise is not enough
    each_run([&](int64_t i, int64_t pixel, int64_t n) {
      for (int64_t j = 0; j < n; ++j) {
        s.charges.whole[i + j] = static_cast<int32_t>(charge[pixel + j] >> 32);
        s.charges.word[i + j] = static_cast<uint32_t>(charge[pixel + j]);
        s.draws.number[i + j] = static_cast<uint32_t>(pixel + j);
        s.draws.electrons[i + j] = noise.electrons ? noise.electrons[pixel + j] : 1.0f;
        s.draws.inverse[i + j] = 1.0f / s.draws.electrons[i + j];
      }
    });
    if (before) std::memcpy(s.draws.before, before + at.begin, static_cast<size_t>(at.bytes()));
    each_segment(light, [&](int64_t k, int64_t whole, int64_t done, int64_t begin) {
      const float *from = light.rows + k * image, *to = light.hold ? from : from + image;
      each_run([&](int64_t i, int64_t pixel, int64_t n) {
        std::copy_n(from + pixel, n, s.ramp.from + i);
        std::copy_n(to + pixel, n, s.ramp.to + i);
      });
      const double share = 1.0 / static_cast<double>(whole);
      if (light.hold)
        s.ramp.begin<false, true>(0, PIXELS, share);
      else
        s.ramp.begin<true, true>(0, PIXELS, share);
      s.ramp.skip(0, PIXELS, done);
      const int64_t end = std::min(light.knots[k + 1], light.end);
      for (int64_t t = begin; t < end; t += TICKS) {
        const int64_t n = std::min(TICKS, end - t), since = t - light.begin, first = first_tick + since;
        s.charges.settle(n);
        for (int64_t i = 0; i < pixels; i += AT_ONCE * LANES)
          run(s.ramp, s.charges, &s.draws, &noise, carry ? INT32_MAX : 1, i, n, first,
              bits + since * frame + at.begin + i / 8, frame, at.bytes() - i / 8);
        s.draws.quad = (first + n - 1) >> 2;
        s.draws.drawn = true;
      }
    });
    each_run([&](int64_t i, int64_t pixel, int64_t n) {
      for (int64_t j = 0; j < n; ++j) {
        charge[pixel + j] = static_cast<int64_t>(static_cast<uint64_t>(s.charges.whole[i + j]) << 32 |
                                                 s.charges.word[i + j]);
        lost[pixel + j] = s.charges.lost_of(i + j);
      }
    });
  });
}

}  // namespace spikerig::SPIKERIG_ISA
