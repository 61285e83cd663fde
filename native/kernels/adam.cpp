#include "adam.hpp"

#include <algorithm>
#include <cmath>

#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int64_t BLOCK = 16384;  // numbers a part

inline void update(float *p, const float *g, float *m, float *v, int64_t n, float rate, const AdamStep &s) {
  for (int64_t i = 0; i < n; ++i) {
    m[i] = s.beta1 * m[i] + (1.0f - s.beta1) * g[i];
    v[i] = s.beta2 * v[i] + (1.0f - s.beta2) * g[i] * g[i];
    p[i] -= rate * m[i] / (std::sqrt(v[i]) * s.root + s.eps);
  }
}

}  // namespace

void adam(float *param, const float *grad, float *mean, float *square, int64_t rows, int64_t columns, int64_t head,
          const AdamStep &step) {
  int64_t some = std::max<int64_t>(1, BLOCK / std::max<int64_t>(1, columns));
  parallel(static_cast<int>((rows + some - 1) / some), [&](int part) {
    int64_t first = part * some, last = std::min(rows, first + some);
    if (head >= columns) {
      int64_t at = first * columns;
      update(param + at, grad + at, mean + at, square + at, (last - first) * columns, step.rate_head, step);
      return;
    }
    for (int64_t row = first; row < last; ++row) {
      int64_t at = row * columns, rest = at + head;
      update(param + at, grad + at, mean + at, square + at, head, step.rate_head, step);
      update(param + rest, grad + rest, mean + rest, square + rest, columns - head, step.rate_rest, step);
    }
  });
}

}  // namespace spikerig::SPIKERIG_ISA
