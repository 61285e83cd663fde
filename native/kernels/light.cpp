// Plain loops over blocks of pixels: no branches, so the compiler vectorises them for each instruction set.
#include "light.hpp"

#include <algorithm>
#include <cstring>
#include <vector>

#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int64_t BLOCK = 4096;  // pixels a part; fixed, so sums do not depend on the thread count
constexpr int CHUNK = 256;       // pixels that stay in the first-level cache between the loops

inline float bits_to_float(int32_t i) { float f; std::memcpy(&f, &i, 4); return f; }
inline int32_t float_to_bits(float f) { int32_t i; std::memcpy(&i, &f, 4); return i; }

// x^p for x in [1e-30, 1e30], relative error < 1e-6 for |p log2 x| < 20.
inline float power(float x, float p) {
  int32_t i = float_to_bits(x);
  int32_t e = (i - 0x3f3504f3) >> 23;  // x = m 2^e with m in [sqrt(1/2), sqrt(2))
  float m = bits_to_float(i - (e << 23));
  float s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
  float log2m = s * (2.88539008f + s2 * (0.961796694f + s2 * (0.577078016f + s2 * (0.412198583f + s2 * 0.320598898f))));
  float y = p * (static_cast<float>(e) + log2m);
  float k = (y + 12582912.0f) - 12582912.0f;  // nearest integer
  float f = y - k;
  float r = 1.0f + f * (0.693147181f + f * (0.240226507f + f * (0.0555041087f + f * (0.00961812911f +
            f * (0.00133335581f + f * (0.000154035304f + f * 0.0000152527338f))))));
  return r * bits_to_float((static_cast<int32_t>(k) + 127) << 23);
}

inline float larger(float a, float b) { return a > b ? a : b; }

inline float linear(float code) {
  float curve = power((larger(code, 0.04045f) + 0.055f) * (1.0f / 1.055f), 2.4f);
  return code <= 0.04045f ? code * (1.0f / 12.92f) : curve;
}

inline float linear_slope(float code, float light) {
  return code <= 0.04045f ? 1.0f / 12.92f : 2.4f * light / (larger(code, 0.04045f) + 0.055f);
}

inline float coded(float light) {
  float curve = 1.055f * power(larger(light, 0.0031308f), 1.0f / 2.4f) - 0.055f;
  return light <= 0.0031308f ? 12.92f * light : curve;
}

inline float coded_slope(float light, float code) {
  return light <= 0.0031308f ? 12.92f : (code + 0.055f) / (2.4f * larger(light, 0.0031308f));
}

// Sums by lane: floats within a chunk, doubles over chunks; the order is the same for any thread count.
constexpr int LANES = 16;
static_assert(CHUNK % LANES == 0);

struct Sums {
  double value = 0, gray[4] = {0, 0, 0, 0};
};

inline double lane_sum(const float *x) {
  float lane[LANES] = {};
  for (int p = 0; p < CHUNK; p += LANES)
    for (int l = 0; l < LANES; ++l) lane[l] += x[p + l];
  double sum = 0;
  for (int l = 0; l < LANES; ++l) sum += lane[l];
  return sum;
}

template <Domain domain>
void tfs_chunk(const float *image, const float *texture, const float *weight, const float *gray, int n,
               float *grad_image, Sums &sums) {
  float light[3 * CHUNK], slope[3 * CHUNK], spread[3 * CHUNK], pull[CHUNK] = {}, loss[CHUNK] = {};
  for (int i = 0; i < 3 * n; ++i) {
    float code = image[i];
    light[i] = domain == Domain::code ? code : linear(code);
    slope[i] = domain == Domain::code ? 1.0f : linear_slope(code, light[i]);
  }
  for (int p = 0; p < n; ++p) {
    float y = gray[0] * light[3 * p] + gray[1] * light[3 * p + 1] + gray[2] * light[3 * p + 2] + gray[3];
    float z = domain == Domain::encoded ? coded(y) : y;
    float r = z - texture[p];
    float wr = weight[p] > 0.0f ? weight[p] * r : 0.0f;  // a masked texture may hold anything
    loss[p] = weight[p] > 0.0f ? wr * r : 0.0f;
    pull[p] = 2.0f * wr * (domain == Domain::encoded ? coded_slope(y, z) : 1.0f);
  }
  for (int p = 0; p < n; ++p)
    for (int c = 0; c < 3; ++c) spread[3 * p + c] = pull[p] * gray[c];
  for (int i = 0; i < 3 * n; ++i) grad_image[i] = spread[i] * slope[i];
  sums.value += lane_sum(loss);
  sums.gray[3] += lane_sum(pull);
  for (int c = 0; c < 3; ++c) {
    float product[CHUNK] = {};
    for (int p = 0; p < n; ++p) product[p] = pull[p] * light[3 * p + c];
    sums.gray[c] += lane_sum(product);
  }
}

template <Domain domain>
double tfs_in(const float *image, const float *texture, const float *weight, const float *gray, int64_t pixels,
              float *grad_image, double *grad_gray) {
  int parts = static_cast<int>((pixels + BLOCK - 1) / BLOCK);
  std::vector<Sums> sums(parts);
  parallel(parts, [&](int part) {
    int64_t end = std::min(pixels, (part + 1) * BLOCK);
    for (int64_t p = part * BLOCK; p < end; p += CHUNK)
      tfs_chunk<domain>(image + 3 * p, texture + p, weight + p, gray, static_cast<int>(std::min<int64_t>(CHUNK, end - p)),
                        grad_image + 3 * p, sums[part]);
  });
  Sums total;
  for (const Sums &s : sums) {
    total.value += s.value;
    for (int c = 0; c < 4; ++c) total.gray[c] += s.gray[c];
  }
  std::copy(total.gray, total.gray + 4, grad_gray);
  return total.value;
}

}  // namespace

double tfs(const float *image, const float *texture, const float *weight, const float *gray, int64_t pixels,
           Domain domain, float *grad_image, double *grad_gray) {
  switch (domain) {
    case Domain::encoded: return tfs_in<Domain::encoded>(image, texture, weight, gray, pixels, grad_image, grad_gray);
    case Domain::linear: return tfs_in<Domain::linear>(image, texture, weight, gray, pixels, grad_image, grad_gray);
    default: return tfs_in<Domain::code>(image, texture, weight, gray, pixels, grad_image, grad_gray);
  }
}

void decode(const float *code, int64_t count, float *light) {
  parallel(static_cast<int>((count + BLOCK - 1) / BLOCK), [&](int part) {
    int64_t end = std::min(count, (part + 1) * BLOCK);
    for (int64_t i = part * BLOCK; i < end; ++i) light[i] = linear(code[i]);
  });
}

void average(const float *const *images, int fresh, const float *base, int n, int64_t count, float *out,
             float *light) {
  parallel(static_cast<int>((count + BLOCK - 1) / BLOCK), [&](int part) {
    int64_t begin = part * BLOCK, end = std::min(count, begin + BLOCK);
    for (int64_t i = begin; i < end; ++i) light[i] = base ? base[i] : 0.0f;
    for (int j = 0; j < fresh; ++j)
      for (int64_t i = begin; i < end; ++i) light[i] += linear(images[j][i]);
    float share = 1.0f / static_cast<float>(n);
    for (int64_t i = begin; i < end; ++i) {
      light[i] *= share;
      out[i] = coded(light[i]);
    }
  });
}

void average_back(const float *const *images, int fresh, int n, int64_t count, const float *out, const float *light,
                  const float *grad, float *const *grad_images) {
  float share = 1.0f / static_cast<float>(n);
  parallel(static_cast<int>((count + BLOCK - 1) / BLOCK), [&](int part) {
    int64_t begin = part * BLOCK, end = std::min(count, begin + BLOCK);
    for (int j = 0; j < fresh; ++j) {
      const float *image = images[j];
      float *to = grad_images[j];
      for (int64_t i = begin; i < end; ++i)
        to[i] = grad[i] * share * coded_slope(light[i], out[i]) * linear_slope(image[i], linear(image[i]));
    }
  });
}

}  // namespace spikerig::SPIKERIG_ISA
