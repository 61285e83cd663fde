// One step of Adam on a tensor seen as rows x columns, the first `head` columns at one rate and the others at another.
#pragma once
#include <cstdint>

#include "dispatch.hpp"

namespace spikerig {

struct AdamStep {
  float beta1, beta2, eps;
  float rate_head, rate_rest;  // learning rate / (1 - beta1^t)
  float root;                  // 1 / sqrt(1 - beta2^t)
};

#define SPIKERIG_DECLARE(isa)                                                                                   \
  namespace isa {                                                                                               \
  void adam(float *param, const float *grad, float *mean, float *square, int64_t rows, int64_t columns,         \
            int64_t head, const AdamStep &step);                                                                \
  }
SPIKERIG_EACH_ISA(SPIKERIG_DECLARE)
#undef SPIKERIG_DECLARE

}  // namespace spikerig
