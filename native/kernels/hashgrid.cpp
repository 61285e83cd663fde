#include "hashgrid.hpp"

#include "float_lanes.hpp"
#include "team.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

typedef uint32_t vu __attribute__((vector_size(4 * LANES)));

struct Corners {  // of LANES points in one level: row offsets and weights of the 8 vertices around each
  alignas(64) int32_t row[8][LANES];
  alignas(64) float weight[8][LANES];
};

inline vi whole(vf x) { return __builtin_convertvector(x, vi); }
inline vf real(vi x) { return __builtin_convertvector(x, vf); }

// Cell and place in it of one coordinate: points at 1 belong to the last cell.
inline vi locate(vf x, int32_t cells, vf &part) {
  const vf at = smaller(larger(x, vf{}), splat(1.0f)) * static_cast<float>(cells);
  vi cell = whole(at);
  const vi last = vi{} + (cells - 1);
  cell = choose(at_least(cell, last), last, cell);
  part = at - real(cell);
  return cell;
}

inline void surround(const GridLevel &level, vf x, vf y, vf z, Corners &out) {
  vf fx, fy, fz;
  const vi cx = locate(x, level.cells, fx), cy = locate(y, level.cells, fy), cz = locate(z, level.cells, fz);
  const int32_t side = level.cells + 1;
  for (int k = 0; k < 8; ++k) {
    const vi vx = cx + (k & 1), vy = cy + (k >> 1 & 1), vz = cz + (k >> 2);
    const vf w = (k & 1 ? fx : 1.0f - fx) * (k & 2 ? fy : 1.0f - fy) * (k & 4 ? fz : 1.0f - fz);
    const vi row = level.mask < 0 ? (vz * side + vy) * side + vx
                                  : (vi)((vu)vx ^ (vu)vy * 2654435761u ^ (vu)vz * 805459861u) & level.mask;
    __builtin_memcpy(out.row[k], &row, sizeof row);
    __builtin_memcpy(out.weight[k], &w, sizeof w);
  }
}

inline void take(const float *points, int64_t first, int count, vf &x, vf &y, vf &z) {
  alignas(64) float buffer[3][LANES];
  for (int i = 0; i < LANES; ++i) {
    const float *p = points + 3 * (first + (i < count ? i : 0));
    buffer[0][i] = p[0], buffer[1][i] = p[1], buffer[2][i] = p[2];
  }
  x = load(buffer[0]), y = load(buffer[1]), z = load(buffer[2]);
}

inline int lanes_left(int64_t at, int64_t end) { return end - at < LANES ? static_cast<int>(end - at) : LANES; }

}  // namespace

void hash_encode(const GridPlan &plan, const float *table, float *out) {
  const int width = plan.levels * GRID_FEATURES;
  parallel(static_cast<int>((plan.n + GRID_CHUNK - 1) / GRID_CHUNK), [&](int part) {
    const int64_t begin = static_cast<int64_t>(part) * GRID_CHUNK;
    const int64_t end = begin + GRID_CHUNK < plan.n ? begin + GRID_CHUNK : plan.n;
    Corners around;
    for (int l = 0; l < plan.levels; ++l) {
      const float *rows = table + plan.level[l].first * GRID_FEATURES;
      for (int64_t at = begin; at < end; at += LANES) {
        const int count = lanes_left(at, end);
        vf x, y, z;
        take(plan.points, at, count, x, y, z);
        surround(plan.level[l], x, y, z, around);
        for (int i = 0; i < count; ++i) {
          float a = 0, b = 0;
          for (int k = 0; k < 8; ++k) {
            const float *row = rows + GRID_FEATURES * static_cast<int64_t>(around.row[k][i]);
            a += around.weight[k][i] * row[0], b += around.weight[k][i] * row[1];
          }
          float *to = out + (at + i) * width + l * GRID_FEATURES;
          to[0] = a, to[1] = b;
        }
      }
    }
  });
}

// A level is one part, and its points come in their order: every sum has one order, whatever the team.
void hash_encode_back(const GridPlan &plan, const float *grad, float *table_grad) {
  const int width = plan.levels * GRID_FEATURES;
  parallel(plan.levels, [&](int l) {
    float *rows = table_grad + plan.level[l].first * GRID_FEATURES;
    __builtin_memset(rows, 0, static_cast<size_t>(plan.level[l].rows) * GRID_FEATURES * sizeof(float));
    Corners around;
    for (int64_t at = 0; at < plan.n; at += LANES) {
      const int count = lanes_left(at, plan.n);
      vf x, y, z;
      take(plan.points, at, count, x, y, z);
      surround(plan.level[l], x, y, z, around);
      for (int i = 0; i < count; ++i) {
        const float *from = grad + (at + i) * width + l * GRID_FEATURES;
        if (from[0] == 0.0f && from[1] == 0.0f) continue;
        for (int k = 0; k < 8; ++k) {
          float *row = rows + GRID_FEATURES * static_cast<int64_t>(around.row[k][i]);
          row[0] += around.weight[k][i] * from[0], row[1] += around.weight[k][i] * from[1];
        }
      }
    }
  });
}

}  // namespace spikerig::SPIKERIG_ISA
