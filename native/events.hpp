// Events of an event camera, declared for every instruction set. dataset/oracles.py defines what comes out.
#pragma once
#include <cstdint>

#include "dispatch.hpp"

namespace spikerig {

// Linear light at knots; times are nanoseconds from the first knot.
struct EventLight {
  const float *rows;   // float32[.., pixels]
  const double *at;    // [segments + 1]
  int64_t segments, pixels;
  bool hold;           // rows[k] over segment k; else linear from rows[k] to rows[k + 1]
};

struct EventSensor {
  const double *up, *down;     // [pixels], factors of light + eps that make an event: above 1, below 1
  double eps;                  // > 0, light of a dark pixel
  double refractory;           // ns that a pixel is held after an event, a whole number
  double tau;                  // time constant of the photoreceptor, ns; 0: none
  const int64_t *noise_start;  // [pixels + 1], into noise_at; null: no noise
  const double *noise_at;      // ns, increasing within a pixel
  const int8_t *noise_sign;
  int64_t end;                 // events at this time and later are left out
};

#define SPIKERIG_DECLARE_EVENTS(isa)                                                                              \
  namespace isa {                                                                                                 \
  /* Events a pixel into counts; their sum, or something above `most` once there are more than that. */           \
  int64_t count_events(const EventLight &light, const EventSensor &sensor, int64_t most, int64_t *counts);        \
  /* Pixel p's events from t[start[p]] on, in the order of their times. */                                        \
  void events(const EventLight &light, const EventSensor &sensor, const int64_t *start, int64_t *t, int8_t *sign); \
  }
SPIKERIG_EACH_ISA(SPIKERIG_DECLARE_EVENTS)

}  // namespace spikerig
