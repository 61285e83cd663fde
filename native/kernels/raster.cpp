// One tile of the picture, forward and backward. Oracle: train/oracles.py raster.
//
// A vector is a block of pixels, 4 wide and LANES / 4 tall; a tile is 4 blocks wide. Each splat of the tile's list, front
// to back, visits the blocks its box meets: light T and colour live in the tile, the splat's sums in registers.
#include "../train_kernels.hpp"
#include "float_lanes.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int TALL = LANES / 4;              // pixel rows of a block
constexpr int BLOCK_ROWS = TILE / TALL;      // block rows of a tile
constexpr int BLOCKS = 4 * BLOCK_ROWS;
constexpr uint32_t AHEAD = 6;                 // list entries whose footprint is fetched ahead
constexpr float NEVER = -7.994353436858858f;  // log2(ALPHA_MIN)

struct Offsets {
  vf x, y;  // pixel centres of a block's lanes, from its corner
};

Offsets offsets() {
  Offsets out;
  for (int l = 0; l < LANES; ++l) out.x[l] = l % 4 + 0.5f, out.y[l] = l / 4 + 0.5f;
  return out;
}

constexpr int ROWS = BLOCK_ROWS < 8 ? BLOCK_ROWS : LANES;  // block rows looked at together
typedef float rows_f __attribute__((vector_size(4 * ROWS)));
typedef int32_t rows_i __attribute__((vector_size(4 * ROWS)));

// Blocks that the rim alpha = ALPHA_MIN around (x, y), from the tile's corner, can meet; one bit a block, row by row.
// For each block row: the rim's furthest right and left over that row's pixel centres, then the blocks between.
inline uint64_t blocks_met(const Footprint &s, float x, float y) {
  const float room = s.room * 1.0001f + 1e-4f, shrink = 1.0f / s.p, ss = s.s * s.s;
  const float lean = s.r < 0 ? -s.r : s.r, off = y < 0 ? -y : y;
  const float slack = 1e-3f + 1e-6f * (3 + lean * (off + TILE)) * shrink;  // above the rounding of what follows
  const rows_f zero{}, lean_r = zero + s.lean, lean_l = zero - s.lean, last = zero + (TILE - 1);
  uint64_t out = 0;
  for (int first = 0; first < BLOCK_ROWS; first += ROWS) {
    rows_f top, wide_r, wide_l;
    rows_i place;
    for (int j = 0; j < ROWS; ++j) top[j] = TALL * (first + j) + 0.5f, place[j] = 4 * j;
    top -= y;
    const rows_f bottom = top + (TALL - 1);
    const rows_f yr = lean_r < top ? top : lean_r > bottom ? bottom : lean_r;
    const rows_f yl = lean_l < top ? top : lean_l > bottom ? bottom : lean_l;
    const rows_f free_r = room - ss * yr * yr, free_l = room - ss * yl * yl;
    for (int j = 0; j < ROWS; ++j) wide_r[j] = __builtin_sqrtf(free_r[j]), wide_l[j] = __builtin_sqrtf(free_l[j]);
    const rows_f right = (wide_r - s.r * yr) * shrink + (x - 0.5f + slack);
    const rows_f left = (-wide_l - s.r * yl) * shrink + (x + 0.5f - slack);  // + 1: truncation rounds it up
    const rows_i from = __builtin_convertvector(left > zero ? left : zero, rows_i) >> 2;
    const rows_i to = __builtin_convertvector(right < last ? right : last, rows_i) >> 2;
    rows_i columns = (((rows_i{} + 2) << to) - ((rows_i{} + 1) << from));
    columns &= (free_r >= zero) & (right >= zero) & (left < zero + TILE) & (from <= to);
    columns <<= place;
    uint32_t bits = 0;
    for (int j = 0; j < ROWS; ++j) bits |= static_cast<uint32_t>(columns[j]);
    out |= static_cast<uint64_t>(bits) << 4 * first;
  }
  return out;
}

// Copies of the picture's channels for a tile, block by block; lanes outside the picture are 0.
struct Corner {
  int x, y, wide, tall;  // of the tile, and how much of it is inside the picture
};

Corner corner(const Frame &f, int tile) {
  Corner c{tile % f.tiles_x * TILE, tile / f.tiles_x * TILE, TILE, TILE};
  if (c.wide > f.camera.width - c.x) c.wide = f.camera.width - c.x;
  if (c.tall > f.camera.height - c.y) c.tall = f.camera.height - c.y;
  return c;
}

template <class Visit>
inline void each_pixel(const Frame &f, const Corner &c, Visit visit) {  // visit(lane in the tile, pixel in the picture)
  for (int y = 0; y < c.tall; ++y)
    for (int x = 0; x < c.wide; ++x)
      visit((y / TALL * 4 + x / 4) * LANES + y % TALL * 4 + x % 4, static_cast<int64_t>(c.y + y) * f.camera.width + c.x + x);
}

}  // namespace

void raster_tile(Frame &f, int tile) {
  alignas(64) vf light[BLOCKS], red[BLOCKS], green[BLOCKS], blue[BLOCKS];
  const Offsets at = offsets();
  const Corner c = corner(f, tile);
  for (int b = 0; b < BLOCKS; ++b) light[b] = red[b] = green[b] = blue[b] = vf{};
  each_pixel(f, c, [&](int lane, int64_t) { reinterpret_cast<float *>(light)[lane] = 1.0f; });
  const vf never = splat(NEVER), least = splat(LIGHT_MIN), most = splat(ALPHA_MAX);
  uint64_t live = 0;
  for (int b = 0; b < BLOCKS; ++b) live |= static_cast<uint64_t>(any(at_least(light[b], least))) << b;
  const Entry *list = f.list.data;
  const uint32_t end = f.tile_start.data[tile + 1];
  uint32_t k = f.tile_start.data[tile];
  for (; k < end && live; ++k) {
    if (k + AHEAD < end) __builtin_prefetch(&f.footprints.data[list[k + AHEAD].splat]);
    const Footprint &s = f.footprints.data[list[k].splat];
    const float x = static_cast<float>(s.x - c.x), y = static_cast<float>(s.y - c.y);
    uint64_t todo = blocks_met(s, x, y) & live, touched = 0;
    for (; todo; todo &= todo - 1) {
      const int b = __builtin_ctzll(todo);
      const vf dx = at.x + (4 * (b % 4) - x), dy = at.y + (TALL * (b / 4) - y);
      const vf u = s.p * dx + s.r * dy, v = s.s * dy;
      const vf power = s.log2_opacity - v * v - u * u;
      vf t = light[b];
      const mask on = both(at_least(power, never), at_least(t, least));
      if (!any(on)) continue;
      touched |= uint64_t{1} << b;
      const vf w = keep(on, smaller(exp2_lanes(power), most)) * t;
      t -= w;
      light[b] = t;
      red[b] += w * s.red;
      green[b] += w * s.green;
      blue[b] += w * s.blue;
      if (!any(at_least(t, least))) live &= ~(uint64_t{1} << b);
    }
    f.touched.data[k] = touched;
  }
  for (; k < end; ++k) f.touched.data[k] = 0;  // the tile was finished before
  each_pixel(f, c, [&](int lane, int64_t pixel) {
    float t = reinterpret_cast<float *>(light)[lane], *out = f.image + 3 * pixel;
    out[0] = reinterpret_cast<float *>(red)[lane] + t * f.background[0];
    out[1] = reinterpret_cast<float *>(green)[lane] + t * f.background[1];
    out[2] = reinterpret_cast<float *>(blue)[lane] + t * f.background[2];
    f.alpha[pixel] = 1.0f - t;
  });
}

// Front to back again, with the light T recomputed and what lies behind kept as one number a pixel: S starts at
// <picture, gradient> and loses each splat's share, so d(loss)/d(alpha) = T <colour, gradient> - S / (1 - alpha).
void raster_tile_back(Frame &f, int tile) {
  alignas(64) vf light[BLOCKS], behind[BLOCKS], red[BLOCKS], green[BLOCKS], blue[BLOCKS];
  const Offsets at = offsets();
  const Corner c = corner(f, tile);
  for (int b = 0; b < BLOCKS; ++b) light[b] = behind[b] = red[b] = green[b] = blue[b] = vf{};
  each_pixel(f, c, [&](int lane, int64_t pixel) {
    const float *g = f.image_grad + 3 * pixel, *out = f.image + 3 * pixel;
    reinterpret_cast<float *>(light)[lane] = 1.0f;
    reinterpret_cast<float *>(red)[lane] = g[0];
    reinterpret_cast<float *>(green)[lane] = g[1];
    reinterpret_cast<float *>(blue)[lane] = g[2];
    reinterpret_cast<float *>(behind)[lane] = out[0] * g[0] + out[1] * g[1] + out[2] * g[2] - (1.0f - f.alpha[pixel]) * f.alpha_grad[pixel];
  });
  const vf never = splat(NEVER), least = splat(LIGHT_MIN), most = splat(ALPHA_MAX);
  const Entry *list = f.list.data;
  const uint32_t end = f.tile_start.data[tile + 1];
  for (uint32_t k = f.tile_start.data[tile]; k < end; ++k) {
    if (k + AHEAD < end && f.touched.data[k + AHEAD]) {
      __builtin_prefetch(&f.footprints.data[list[k + AHEAD].splat]);
      __builtin_prefetch(f.slots.data + static_cast<size_t>(list[k + AHEAD].slot) * SLOT, 1);
    }
    uint64_t todo = f.touched.data[k];
    if (!todo) continue;
    const Footprint &s = f.footprints.data[list[k].splat];
    const float x = static_cast<float>(s.x - c.x), y = static_cast<float>(s.y - c.y);
    vf sum[9] = {};
    for (; todo; todo &= todo - 1) {
      const int b = __builtin_ctzll(todo);
      const vf dx = at.x + (4 * (b % 4) - x), dy = at.y + (TALL * (b / 4) - y);
      const vf u = s.p * dx + s.r * dy, v = s.s * dy;
      const vf power = s.log2_opacity - v * v - u * u;
      const vf t = light[b];
      const mask on = both(at_least(power, never), at_least(t, least));
      const vf free = exp2_lanes(power);
      const vf alpha = keep(on, smaller(free, most)), w = alpha * t;
      const vf shade = s.red * red[b] + s.green * green[b] + s.blue * blue[b];
      const vf rest = behind[b] - w * shade;
      light[b] = t - w;
      behind[b] = rest;
      sum[6] += w * red[b];
      sum[7] += w * green[b];
      sum[8] += w * blue[b];
      const vf d = keep(at_least(most, free), alpha * (t * shade - rest / (1.0f - alpha)));  // d loss / d log alpha
      const vf du = d * u, dv = d * dy;
      sum[0] += d;
      sum[1] += du;
      sum[2] += dv;
      sum[3] += du * dx;
      sum[4] += du * dy;
      sum[5] += dv * dy;
    }
    sum_nine(sum, f.slots.data + static_cast<size_t>(list[k].slot) * SLOT);
    f.used.data[list[k].slot] = 1;
  }
}

}  // namespace spikerig::SPIKERIG_ISA
