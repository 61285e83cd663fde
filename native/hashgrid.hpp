// A multiresolution grid of features with hashed vertices, and its gradient. Definitions: train/ray_oracles.py.
#pragma once
#include <cstdint>

#include "dispatch.hpp"

namespace spikerig {

constexpr int GRID_FEATURES = 2;  // numbers a vertex
constexpr int GRID_LEVELS = 24;   // at most
constexpr int GRID_CHUNK = 1024;  // points of one part of the forward pass

struct GridLevel {
  int32_t cells;   // along an axis; vertices are cells + 1
  int32_t mask;    // rows - 1 where hashed (rows is a power of two), -1 where every vertex has a row of its own
  int64_t first;   // row of the table at which this level begins
  int64_t rows;
};

struct GridPlan {
  GridLevel level[GRID_LEVELS];
  int levels;
  const float *points;  // [n, 3] in [0, 1]; beyond is clamped
  int64_t n;
};

#define SPIKERIG_DECLARE(isa)                                                                                 \
  namespace isa {                                                                                             \
  void hash_encode(const GridPlan &plan, const float *table, float *out);   /* out [n, levels * 2] */         \
  void hash_encode_back(const GridPlan &plan, const float *grad, float *table_grad); /* writes all rows */    \
  }
SPIKERIG_EACH_ISA(SPIKERIG_DECLARE)
#undef SPIKERIG_DECLARE

}  // namespace spikerig
