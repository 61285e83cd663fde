// Spikes around an instant (tfi_at) and the enclosing interval at every tick (tfi_all).
#include "spike_kernels.hpp"
#include "spike_lanes.hpp"
#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int64_t NEAR = 4096;  // bytes of a section of tfi_at: a page, read in order
constexpr int64_t LINE = 64;    // bytes that leave the search together
constexpr int64_t AHEAD = 8;    // ticks to prefetch
constexpr int64_t ALL = 64;     // bytes of a section of tfi_all

// Looks for each pixel's rank-th spike over ticks first, first + step, .. (n of them). Lines leave the list as soon
// as all of their pixels are found, so bright pictures end after a few ticks.
struct Search {
  alignas(64) uint8_t open[NEAR];  // pixels still looked for
  uint16_t active[NEAR / LINE];    // lines with an open pixel
  int32_t found[NEAR * 8];
  int32_t left[NEAR * 8];

  void start(Section at, int64_t width, int rank) {
    std::memset(open, 0, sizeof open);
    runs(at, width, [&](int64_t byte, int64_t, int64_t n) {
      uint8_t *to = open + (byte - at.begin);
      std::memset(to, 255, static_cast<size_t>(n / 8));
      if (n % 8) to[n / 8] = static_cast<uint8_t>((1 << (n % 8)) - 1);
    });
    std::fill(found, found + at.bytes() * 8, -1);
    if (rank > 1) std::fill(left, left + at.bytes() * 8, rank);
  }

  // Takes the spikes of a line's open pixels, `lit` saying in which words some are; false when no pixel is left.
  bool hit(int64_t line, uint64_t *spikes, uint32_t lit, int32_t tick, int rank) {
    for (; lit; lit &= lit - 1) {
      const int w = __builtin_ctz(lit);
      const int64_t pixel = (line * LINE + w * 8) * 8;
      if (rank > 1) {
        for (uint64_t s = spikes[w]; s; s &= s - 1)
          if (--left[pixel + __builtin_ctzll(s)] > 0) spikes[w] ^= s & -s;
      }
      put_where(found + pixel, spikes[w], tick);
    }
    alignas(64) uint64_t mine[LINE / 8];
    std::memcpy(mine, open + line * LINE, LINE);
    for (int64_t w = 0; w < LINE / 8; ++w) mine[w] &= ~spikes[w];
    std::memcpy(open + line * LINE, mine, LINE);
    return lit_words(mine) != 0;
  }

  void run(const Packed &s, Section at, int64_t first, int64_t n, int step, int rank) {
    const int64_t lines = (at.bytes() + LINE - 1) / LINE, frame = s.frame(), rest = at.bytes() % LINE;
    int64_t count = 0;
    for (int64_t k = 0; k < lines; ++k) active[count++] = static_cast<uint16_t>(k);
    alignas(64) uint8_t padded[LINE] = {};
    for (int64_t k = 0, tick = first; k < n && count; ++k, tick += step) {
      const uint8_t *row = s.bits + tick * frame + at.begin;
      const int64_t ahead = k + AHEAD < n ? step * AHEAD * frame : 0;
      int64_t keep = 0;
      for (int64_t i = 0; i < count; ++i) {
        const int64_t line = active[i];
        const uint8_t *from = row + line * LINE;
        __builtin_prefetch(from + ahead);
        if (rest && line == lines - 1) {
          std::memcpy(padded, from, static_cast<size_t>(rest));
          from = padded;
        }
        alignas(64) uint64_t spikes[LINE / 8];
        for (int64_t j = 0; j < LINE; j += WIDE) {
          const Wide now = load_wide(from + j) & load_wide(open + line * LINE + j);
          std::memcpy(reinterpret_cast<uint8_t *>(spikes) + j, &now, sizeof now);
        }
        const uint32_t lit = lit_words(spikes);
        active[keep] = static_cast<uint16_t>(line);
        keep += lit ? hit(line, spikes, lit, static_cast<int32_t>(tick), rank) : 1;
      }
      count = keep;
    }
  }
};

}  // namespace

void tfi_at(const Packed &s, int64_t tick, int before, int after, int32_t *previous, int32_t *next) {
  const int parts = sections(s.frame(), NEAR);
  parallel(2 * parts, [&](int part) {
    static thread_local Search search;
    const Section at = section(s.frame(), NEAR, part % parts);
    const bool past = part < parts;
    const int rank = past ? before : after;
    int32_t *out = past ? previous : next;
    search.start(at, s.width, rank);
    if (past)
      search.run(s, at, tick - 1, tick, -1, rank);
    else
      search.run(s, at, tick, s.ticks - tick, 1, rank);
    runs(at, s.width, [&](int64_t byte, int64_t pixel, int64_t n) {
      std::copy_n(search.found + (byte - at.begin) * 8, n, out + pixel);
    });
  });
}

namespace {

// One stretch of at most 8 * ALL pixels over all ticks. Forward: ticks since the last spike, 0 where none was.
// Backward: at a spike that number is the interval's length, and it holds for every tick since the one before.
struct Stretch {
  const Packed &s;
  int64_t byte, pixel, pixels;
  uint16_t *out;

  template <class Step>
  void tick(int64_t t, Step step) const {
    const uint8_t *bits = s.bits + t * s.frame() + byte;
    uint16_t *to = out + t * s.height * s.width + pixel;
    int64_t i = 0;
    for (; i + SHORTS <= pixels; i += SHORTS) {
      uint32_t b = 0;
      std::memcpy(&b, bits + i / 8, SHORTS / 8);
      step(i, short_mask(b), to + i);
    }
    if (i < pixels) {
      uint32_t b = 0;
      std::memcpy(&b, bits + i / 8, static_cast<size_t>((pixels - i + 7) / 8));
      uint16_t lane[SHORTS] = {};
      std::memcpy(lane, to + i, static_cast<size_t>(pixels - i) * 2);
      step(i, short_mask(b), lane);
      std::memcpy(to + i, lane, static_cast<size_t>(pixels - i) * 2);
    }
  }

  void run() const {
    alignas(64) uint16_t state[ALL * 8 + SHORTS] = {};
    auto get = [](const uint16_t *from) {
      Shorts x;
      std::memcpy(&x, from, sizeof x);
      return x;
    };
    auto put = [](uint16_t *to, Shorts x) { std::memcpy(to, &x, sizeof x); };
    for (int64_t t = 0; t < s.ticks; ++t)
      tick(t, [&](int64_t i, ShortMask spike, uint16_t *to) {
        const Shorts since = get(state + i);
        put(to, since);
        put(state + i, choose(spike, all_ones(), one_more(since)));
      });
    std::memset(state, 0, sizeof state);
    for (int64_t t = s.ticks; t-- > 0;)
      tick(t, [&](int64_t i, ShortMask spike, uint16_t *to) {
        const Shorts interval = choose(spike, get(to), get(state + i));
        put(to, interval);
        put(state + i, interval);
      });
  }
};

}  // namespace

void tfi_all(const Packed &s, uint16_t *out) {
  parallel(sections(s.frame(), ALL), [&](int part) {
    runs(section(s.frame(), ALL, part), s.width,
         [&](int64_t byte, int64_t pixel, int64_t n) { Stretch{s, byte, pixel, n, out}.run(); });
  });
}

}  // namespace spikerig::SPIKERIG_ISA
