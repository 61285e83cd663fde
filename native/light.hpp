// Kernels on pictures in linear light: the TfS residual with its gradient, and the average of sub-exposures.
#pragma once
#include <cstdint>

#include "dispatch.hpp"

namespace spikerig {

// What is compared with a texture: the sRGB code of the gray of linear light, that gray itself, or the gray of codes.
enum class Domain : int { encoded = 0, linear = 1, code = 2 };

#define SPIKERIG_DECLARE(isa)                                                                                       \
  namespace isa {                                                                                                   \
  /* value = sum_p w[p] (z[p] - texture[p])^2 with z the gray of image[p,3]; its gradients by image and gray[4]. */ \
  double tfs(const float *image, const float *texture, const float *weight, const float *gray, int64_t pixels,      \
             Domain domain, float *grad_image, double *grad_gray);                                                  \
  /* light = linear(code), for `count` sRGB codes. */                                                              \
  void decode(const float *code, int64_t count, float *light);                                                      \
  /* light = (base + sum_j linear(images[j])) / n over `count` numbers each, out = srgb(light); base may be null. */ \
  void average(const float *const *images, int fresh, const float *base, int n, int64_t count, float *out,          \
               float *light);                                                                                       \
  void average_back(const float *const *images, int fresh, int n, int64_t count, const float *out,                  \
                    const float *light, const float *grad, float *const *grad_images);                              \
  }
SPIKERIG_EACH_ISA(SPIKERIG_DECLARE)
#undef SPIKERIG_DECLARE

}  // namespace spikerig
