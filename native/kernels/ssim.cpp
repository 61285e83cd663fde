// L1 + SSIM with its gradient. Oracle: train/oracles.py l1_ssim.
//
// A row is its 3 W channels side by side, so the window's columns are 3 floats apart. Forward, a band of rows slides
// down: each new row's five products are blurred along the row into a ring of 11, whose sums down the columns give the
// five means a pixel needs. Three partial derivatives are blurred along the row at once and down the columns in
// ssim_band_back.
#include "../train_kernels.hpp"
#include "float_lanes.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;
constexpr int HALF = TAPS / 2;

struct Window {
  float tap[TAPS];
};

Window gaussian() {
  Window out;
  double weight[TAPS], total = 0;
  for (int k = 0; k < TAPS; ++k) {
    weight[k] = __builtin_exp(-(k - HALF) * (k - HALF) / (2 * 1.5 * 1.5));
    total += weight[k];
  }
  for (int k = 0; k < TAPS; ++k) out.tap[k] = static_cast<float>(weight[k] / total);
  return out;
}

// One padded row blurred along itself; `from` has ROW_PAD floats before and after.
inline void blur_row(const Window &w, const float *from, float *to, int n) {
  for (int i = 0; i < n; i += LANES) {
    vf sum = w.tap[HALF] * load(from + i);
    for (int k = 1; k <= HALF; ++k) sum += w.tap[HALF + k] * (load(from + i - 3 * k) + load(from + i + 3 * k));
    store(to + i, sum);
  }
}

// Rows of channels from the pictures, zero outside and where not valid; the five products.
inline void products(const SsimPlan &p, int y, float *const *rows) {
  const int n = 3 * p.width;
  const float *image = p.image + static_cast<int64_t>(y) * n, *target = p.target + static_cast<int64_t>(y) * n;
  float *a = rows[0] + ROW_PAD, *b = rows[1] + ROW_PAD;
  if (p.valid) {
    const uint8_t *valid = p.valid + static_cast<int64_t>(y) * p.width;
    for (int x = 0; x < p.width; ++x)
      for (int c = 0; c < 3; ++c) {
        a[3 * x + c] = valid[x] ? image[3 * x + c] : 0.0f;
        b[3 * x + c] = valid[x] ? target[3 * x + c] : 0.0f;
      }
  } else {
    __builtin_memcpy(a, image, n * sizeof(float));
    __builtin_memcpy(b, target, n * sizeof(float));
  }
  for (int i = 0; i < n; i += LANES) {  // past the end both are zero
    const vf va = load(a + i), vb = load(b + i);
    store(rows[2] + ROW_PAD + i, va * va);
    store(rows[3] + ROW_PAD + i, vb * vb);
    store(rows[4] + ROW_PAD + i, va * vb);
  }
}

// 1 for each channel that counts, 0 elsewhere and past the row's end.
inline void weights(const SsimPlan &p, int y, float *out) {
  const uint8_t *valid = p.valid ? p.valid + static_cast<int64_t>(y) * p.width : nullptr;
  for (int x = 0; x < p.width; ++x)
    for (int c = 0; c < 3; ++c) out[3 * x + c] = !valid || valid[x] ? 1.0f : 0.0f;
}

struct Ring {
  float *row[5][TAPS];
};

inline vf down(const Window &w, float *const *rows, int oldest, int i) {
  vf sum{};
  for (int k = 0; k < TAPS; ++k) {
    int at = oldest + k;
    sum += w.tap[k] * load(rows[at < TAPS ? at : at - TAPS] + i);
  }
  return sum;
}

// The pixels of row y, whose window is the whole ring: SSIM, and its partials when a gradient is asked for.
inline void similarity(const SsimPlan &p, const Window &w, const Ring &ring, int oldest, const float *weight,
                       float *const *partial, double *sum) {
  vf total{};
  for (int i = 0; i < 3 * p.width; i += LANES) {
    const vf ma = down(w, ring.row[0], oldest, i), mb = down(w, ring.row[1], oldest, i);
    const vf saa = down(w, ring.row[2], oldest, i) - ma * ma, sbb = down(w, ring.row[3], oldest, i) - mb * mb;
    const vf sab = down(w, ring.row[4], oldest, i) - ma * mb, zero{};
    const vf a1 = 2.0f * ma * mb + C1, a2 = 2.0f * sab + C2, b1 = ma * ma + mb * mb + C1;
    const vf b2 = larger(saa, zero) + larger(sbb, zero) + C2;
    const vf inverse = 1.0f / (b1 * b2), s = a1 * a2 * inverse, on = load(weight + i);
    total += on * (1.0f - s);
    if (!p.grad) continue;
    const vf d_square = saa > zero ? -s * b1 * inverse : zero, d_product = 2.0f * a1 * inverse;
    const vf d_mean = 2.0f * (mb * a2 * inverse - ma * s * b2 * inverse - ma * d_square) - mb * d_product;
    store(partial[0] + ROW_PAD + i, on * d_mean);
    store(partial[1] + ROW_PAD + i, on * d_square);
    store(partial[2] + ROW_PAD + i, on * d_product);
  }
  *sum += sum_lanes(total);
}

inline float *blurred_row(const SsimPlan &p, int partial, int y) {
  return p.blurred + (static_cast<size_t>(partial) * p.height + y) * p.stride;
}

inline double absolute(const float *a, const float *b, int n) {
  vf total{};
  for (int i = 0; i < n; i += LANES) {
    const vf d = load(a + i) - load(b + i);
    total += d > 0.0f ? d : -d;
  }
  return sum_lanes(total);
}

}  // namespace

void ssim_band(const SsimPlan &p, int band, float *scratch, double *sums) {
  const Window w = gaussian();
  const int top = band * BAND, bottom = top + BAND < p.height ? top + BAND : p.height, n = 3 * p.width;
  __builtin_memset(scratch, 0, 9 * static_cast<size_t>(p.stride) * sizeof(float));  // the paddings; not the ring
  Ring ring;
  float *rows[5], *partial[3], *next = scratch;
  auto take = [&] {
    float *out = next;
    next += p.stride;
    return out;
  };
  for (auto &row : rows) row = take();
  for (float *&row : partial) row = take();
  float *weight = take();
  for (auto &field : ring.row)
    for (float *&row : field) row = take();
  sums[0] = sums[1] = 0;
  for (int y = top - HALF; y < bottom + HALF; ++y) {
    const int at = (y + TAPS) % TAPS;  // y >= -HALF
    if (y >= 0 && y < p.height) {
      products(p, y, rows);
      for (int f = 0; f < 5; ++f) blur_row(w, rows[f] + ROW_PAD, ring.row[f][at], n);
      if (y >= top && y < bottom) sums[0] += absolute(rows[0] + ROW_PAD, rows[1] + ROW_PAD, n);
    } else {
      for (int f = 0; f < 5; ++f) __builtin_memset(ring.row[f][at], 0, p.stride * sizeof(float));
    }
    const int done = y - HALF;
    if (done < top) continue;
    weights(p, done, weight);
    similarity(p, w, ring, at + 1 < TAPS ? at + 1 : 0, weight, partial, &sums[1]);
    for (int f = 0; p.grad && f < 3; ++f)
      blur_row(w, partial[f] + ROW_PAD, blurred_row(p, f, done), n);
  }
}

void ssim_band_back(const SsimPlan &p, int band) {
  const Window w = gaussian();
  const int top = band * BAND, bottom = top + BAND < p.height ? top + BAND : p.height, n = 3 * p.width;
  const vf zero{}, l1 = splat(static_cast<float>(p.l1_scale)), scale = splat(static_cast<float>(-p.ssim_scale));
  for (int y = top; y < bottom; ++y) {
    const int first = y < HALF ? 0 : y - HALF, last = y + HALF < p.height ? y + HALF : p.height - 1;
    const int64_t row = static_cast<int64_t>(y) * n;
    for (int i = 0; i < n; i += LANES) {
      vf sum[3] = {};
      for (int f = 0; f < 3; ++f)
        for (int from = first; from <= last; ++from)
          sum[f] += w.tap[from - y + HALF] * load(blurred_row(p, f, from) + i);
      const int count = n - i < LANES ? n - i : LANES;
      float tail[3][LANES] = {};  // image, target, gradient; the pictures have no padding to read or write
      __builtin_memcpy(tail[0], p.image + row + i, count * sizeof(float));
      __builtin_memcpy(tail[1], p.target + row + i, count * sizeof(float));
      const vf a = load(tail[0]), b = load(tail[1]);
      const vf sign = a > b ? l1 : a < b ? -l1 : zero;
      store(tail[2], sign + scale * (sum[0] + 2.0f * a * sum[1] + b * sum[2]));
      __builtin_memcpy(p.grad + row + i, tail[2], count * sizeof(float));
    }
    if (!p.valid) continue;
    const uint8_t *valid = p.valid + static_cast<int64_t>(y) * p.width;
    for (int x = 0; x < p.width; ++x)
      for (int c = 0; c < 3; ++c) p.grad[row + 3 * x + c] = valid[x] ? p.grad[row + 3 * x + c] : 0.0f;
  }
}

}  // namespace spikerig::SPIKERIG_ISA
