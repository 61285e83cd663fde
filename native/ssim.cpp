// Bands of the SSIM over the thread team; the arithmetic is in kernels/ssim.cpp.
#include "team.hpp"
#include "train_kernels.hpp"

namespace spikerig {

double l1_ssim(SsimPlan plan) {
  const int bands = (plan.height + BAND - 1) / BAND;
  plan.stride = (3 * plan.width + 15) / 16 * 16 + 2 * ROW_PAD;
  Buffer<float> blurred;
  Buffer<double> sums;
  plan.blurred = plan.grad ? blurred.need(static_cast<size_t>(3) * plan.height * plan.stride) : nullptr;
  sums.need(2 * bands);
  parallel(bands, [&](int band) {
    static thread_local Buffer<float> scratch;
    float *mine = scratch.need((5 * TAPS + 9) * static_cast<size_t>(plan.stride));
    DISPATCH(ssim_band, plan, band, mine, sums.data + 2 * band);
  });
  if (plan.grad) parallel(bands, [&](int band) { DISPATCH(ssim_band_back, plan, band); });
  double total = 0;
  for (int band = 0; band < bands; ++band)
    total += plan.l1_scale * sums.data[2 * band] + plan.ssim_scale * sums.data[2 * band + 1];
  return total;
}

}  // namespace spikerig
