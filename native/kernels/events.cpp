// An event camera under light that is linear between knots (or held): every crossing of a threshold is solved for, no
// time step is taken. A pixel compares light + eps with a reference level; a threshold of log light is a factor of it,
// so nothing here needs a logarithm and without a photoreceptor no exponential either.
//
// This file is compiled without contraction to fused multiply-adds, so that the bits are those of every instruction
// set; parts are fixed blocks of pixels and each pixel is worked on alone, so that they are those of any thread count.
#include "events.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>

#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int64_t BLOCK = 1024;  // pixels of a part
constexpr double ALWAYS = -std::numeric_limits<double>::infinity();

// What light + eps does from `from` on, and when it reaches a level within a stretch in which it does.
struct Flat {
  double value;
  double operator()(double) const { return value; }
  double when(double, double from, double) const { return from; }
};

struct Line {
  double start, value, slope, stop, last;  // rounding must not carry it below light + eps of its darker end
  double operator()(double t) const {
    const double v = value + slope * (t - start);
    return t >= stop ? last : std::min(std::max(v, std::min(value, last)), std::max(value, last));
  }
  double when(double level, double from, double to) const {
    return std::min(std::max(start + (level - value) / slope, from), to);
  }
};

// A first-order low-pass of a line: value + slope u + rest (exp(-u / tau) - 1).
struct Slow {
  double start, value, slope, rest, tau, eps;
  double operator()(double t) const {
    return std::max(value + slope * (t - start) + rest * std::expm1(-(t - start) / tau), eps);
  }

  // Newton's steps, kept within a bracket that shrinks; monotone between `from` and `to`.
  double when(double level, double from, double to) const {
    const bool rising = (*this)(to) >= level;
    double t = from;
    for (int k = 0; k < 100 && to - from > 1e-4; ++k) {
      const double settled = std::expm1(-(t - start) / tau);
      const double gap = value + slope * (t - start) + rest * settled - level;
      (rising == (gap >= 0) ? to : from) = t;
      double next = t - gap / (slope - rest / tau * (1 + settled));
      if (!(next > from && next < to)) next = 0.5 * (from + to);
      if (std::fabs(next - t) < 1e-4) return next;
      t = next;
    }
    return to;
  }

  // Where it turns, if it does after `start`; else never.
  double turn() const {
    const double share = slope * tau / rest;
    return share > 0 && share < 1 ? start - tau * std::log(share) : std::numeric_limits<double>::infinity();
  }
};

// One pixel on its way through time.
struct Pixel {
  double level;   // its reference: light + eps at the last event
  double free;    // when it sees again, if held
  bool held;
  int64_t noise;  // its next noise event
};

template <class Sink>
struct Walk {
  const EventSensor &s;
  double up, down;
  Pixel &p;
  Sink &sink;

  // Through a stretch in which the light does not turn. False: the sink is full.
  template <class Curve>
  bool advance(const Curve &light, double from, double to) {
    if (p.held) {
      if (p.free > to) return true;
      from = std::max(from, p.free);
      p.level = light(from);
      p.held = false;
    }
    const double last = light(to);
    const bool only_count = !Sink::needs_times && s.refractory == 0 && to + 1 < static_cast<double>(s.end);
    for (;;) {
      const bool rose = p.level * up <= last;
      if (!rose && p.level * down < last) return true;
      const double level = p.level * (rose ? up : down);
      if (!only_count) from = light.when(level, from, to);
      if (!emit(from, rose ? 1 : -1)) return false;
      p.level = level;
      if (p.held) {
        if (p.free > to) return true;
        from = std::max(from, p.free);
        p.level = light(from);
        p.held = false;
      }
    }
  }

  // The same, interrupted by the pixel's noise events.
  template <class Curve>
  bool stretch(const Curve &light, double from, double to, int64_t noises) {
    while (p.noise < noises && s.noise_at[p.noise] <= to) {
      const double at = std::max(s.noise_at[p.noise], from);
      const int sign = s.noise_sign[p.noise++];
      if (!advance(light, from, at)) return false;
      from = at;
      if (p.held) continue;  // a pixel that is held makes no noise
      if (!emit(at, sign)) return false;
      p.level = light(at);
    }
    return advance(light, from, to);
  }

  bool emit(double at, int sign) {
    const double t = std::floor(at + 0.5);
    if (s.refractory > 0) {
      p.free = t + s.refractory;
      p.held = true;
    }
    return static_cast<int64_t>(t) >= s.end || sink.put(static_cast<int64_t>(t), static_cast<int8_t>(sign));
  }
};

struct Counter {
  static constexpr bool needs_times = false;
  int64_t most, total = 0, *count = nullptr;
  bool put(int64_t, int8_t) {
    ++*count;
    return ++total <= most;
  }
};

struct Writer {
  static constexpr bool needs_times = true;
  int64_t *t;
  int8_t *sign;
  bool put(int64_t at, int8_t polarity) {
    *t++ = at;
    *sign++ = polarity;
    return true;
  }
};

struct Block {
  Pixel pixel[BLOCK];
  alignas(64) double slow[BLOCK];          // light behind the photoreceptor
  alignas(64) double above[BLOCK], below[BLOCK];  // light + eps from which there is something to do
  alignas(64) uint8_t due[BLOCK];

  void watch(const EventSensor &s, int64_t i, int64_t pixel_number) {
    const Pixel &p = pixel[i];
    above[i] = p.held ? ALWAYS : p.level * s.up[pixel_number];
    below[i] = p.held ? ALWAYS : p.level * s.down[pixel_number];
  }
};

// All segments for the pixels of one block; `open(i)` gives pixel i's sink, `more()` says after each whether to go on.
template <class Open, class More>
void run(const EventLight &light, const EventSensor &s, int64_t first, int64_t n, Open open, More more) {
  static thread_local Block b;
  for (int64_t i = 0; i < n; ++i) {
    const double start = light.rows[first + i];
    b.pixel[i] = {start + s.eps, 0, false, s.noise_start ? s.noise_start[first + i] : 0};
    b.slow[i] = start;
    b.watch(s, i, first + i);
  }
  for (int64_t k = 0; k < light.segments; ++k) {
    const float *a = light.rows + k * light.pixels + first, *z = light.hold ? a : a + light.pixels;
    const double from = light.at[k], to = light.at[k + 1];
    for (int64_t i = 0; i < n; ++i) {
      // what a photoreceptor gives stays within what it had and what it gets
      const double had = s.tau > 0 ? b.slow[i] : z[i], most = std::max<double>(std::max(a[i], z[i]), had),
                   least = std::min<double>(std::min(a[i], z[i]), had);
      b.due[i] = static_cast<uint8_t>((most + s.eps >= b.above[i]) | (least + s.eps <= b.below[i]));
    }
    const double settled = s.tau > 0 ? std::expm1(-(to - from) / s.tau) : 0;
    for (int64_t i = 0; i < n; ++i) {
      const int64_t pixel = first + i, noises = s.noise_start ? s.noise_start[pixel + 1] : 0;
      Pixel &p = b.pixel[i];
      const double slope = light.hold ? 0.0 : (static_cast<double>(z[i]) - a[i]) / (to - from);
      const Slow slow{from, b.slow[i] + s.eps, slope, b.slow[i] - a[i] + slope * s.tau, s.tau, s.eps};
      if (s.tau > 0) b.slow[i] = std::max(b.slow[i] + slope * (to - from) + slow.rest * settled, 0.0);
      if (!b.due[i] && !(p.noise < noises && s.noise_at[p.noise] <= to)) continue;
      auto &&sink = open(i);
      Walk<std::remove_reference_t<decltype(sink)>> walk{s, s.up[pixel], s.down[pixel], p, sink};
      bool fine;
      if (s.tau > 0) {
        const double turn = slow.turn();
        fine = turn < to ? walk.stretch(slow, from, turn, noises) && walk.stretch(slow, turn, to, noises)
                         : walk.stretch(slow, from, to, noises);
      } else if (light.hold) {
        fine = walk.stretch(Flat{a[i] + s.eps}, from, to, noises);
      } else {
        fine = walk.stretch(Line{from, a[i] + s.eps, slope, to, z[i] + s.eps}, from, to, noises);
      }
      if (!fine) return;
      b.watch(s, i, pixel);
    }
    if (!more()) return;
  }
}

int parts(const EventLight &light) { return static_cast<int>((light.pixels + BLOCK - 1) / BLOCK); }

}  // namespace

int64_t count_events(const EventLight &light, const EventSensor &sensor, int64_t most, int64_t *counts) {
  std::atomic<int64_t> all{0};
  parallel(parts(light), [&](int part) {
    const int64_t first = part * BLOCK, n = std::min(BLOCK, light.pixels - first);
    std::fill_n(counts + first, n, 0);
    Counter counter{most};
    int64_t told = 0;
    auto tell = [&] {
      const int64_t fresh = counter.total - told;
      told = counter.total;
      return all.fetch_add(fresh) + fresh <= most;
    };
    if (!tell()) return;
    run(light, sensor, first, n,
        [&](int64_t i) -> Counter & {
          counter.count = counts + first + i;
          return counter;
        },
        tell);
    tell();
  });
  return all.load();
}

void events(const EventLight &light, const EventSensor &sensor, const int64_t *start, int64_t *t, int8_t *sign) {
  parallel(parts(light), [&](int part) {
    const int64_t first = part * BLOCK, n = std::min(BLOCK, light.pixels - first);
    Writer to[BLOCK];
    for (int64_t i = 0; i < n; ++i) to[i] = {t + start[first + i], sign + start[first + i]};
    run(light, sensor, first, n, [&](int64_t i) -> Writer & { return to[i]; }, [] { return true; });
  });
}

}  // namespace spikerig::SPIKERIG_ISA
