// One tile of the picture, forward and backward. Oracle: train/oracles.py raster.
//
// A vector is a block of pixels, 4 wide and LANES / 4 tall; a tile is 4 blocks wide. Each splat of the tile's list
// visits the blocks its rim meets: light T and colour live in the tile, the splat's sums in registers.
#include "../train_kernels.hpp"
#include "float_lanes.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

constexpr int TALL = LANES / 4;              // pixel rows of a block
constexpr int BLOCK_ROWS = TILE / TALL;      // block rows of a tile
constexpr int BLOCKS = 4 * BLOCK_ROWS;
constexpr int AHEAD = 6;                      // list entries whose footprint is fetched ahead
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
      visit((y / TALL * 4 + x / 4) * LANES + y % TALL * 4 + x % 4,
            static_cast<int64_t>(c.y + y) * f.camera.width + c.x + x);
}

}  // namespace

void raster_tile(Frame &f, int tile) {
  alignas(64) vf light[BLOCKS], red[BLOCKS], green[BLOCKS], blue[BLOCKS];
  alignas(64) vi finished[BLOCKS];
  const Offsets at = offsets();
  const Corner c = corner(f, tile);
  for (int b = 0; b < BLOCKS; ++b) light[b] = red[b] = green[b] = blue[b] = vf{}, finished[b] = vi{} + INT32_MAX;
  each_pixel(f, c, [&](int lane, int64_t) { reinterpret_cast<float *>(light)[lane] = 1.0f; });
  const vf never = splat(NEVER), least = splat(LIGHT_MIN), most = splat(ALPHA_MAX);
  uint64_t live = 0;
  for (int b = 0; b < BLOCKS; ++b) live |= static_cast<uint64_t>(any(at_least(light[b], least))) << b;
  const Entry *list = f.list.data + f.tile_start.data[tile];
  uint64_t *touched = f.touched.data + f.tile_start.data[tile];
  const int count = static_cast<int>(f.tile_start.data[tile + 1] - f.tile_start.data[tile]);
  int k = 0;
  for (; k < count && live; ++k) {
    if (k + AHEAD < count) __builtin_prefetch(&f.footprints.data[list[k + AHEAD].splat]);
    const Footprint &s = f.footprints.data[list[k].splat];
    const float x = static_cast<float>(s.x - c.x), y = static_cast<float>(s.y - c.y);
    uint64_t todo = blocks_met(s, x, y) & live, met = 0;
    for (; todo; todo &= todo - 1) {
      const int b = __builtin_ctzll(todo);
      const vf dx = at.x + (4 * (b % 4) - x), dy = at.y + (TALL * (b / 4) - y);
      const vf u = s.p * dx + s.r * dy, v = s.s * dy;
      const vf power = s.log2_opacity - v * v - u * u;
      const vf before = light[b];
      const mask on = both(at_least(power, never), at_least(before, least));
      if (!any(on)) continue;
      met |= uint64_t{1} << b;
      const vf alpha = keep(on, smaller(exp2_lanes(power), most)), w = alpha * before;
      const vf after = before * (1.0f - alpha);
      light[b] = after;
      red[b] += w * s.red;
      green[b] += w * s.green;
      blue[b] += w * s.blue;
      const mask still = at_least(after, least), now = without(on, still);
      if (!any(now)) continue;
      finished[b] = choose(now, vi{} + k, finished[b]);
      if (!any(still)) live &= ~(uint64_t{1} << b);
    }
    touched[k] = met;
  }
  for (; k < count; ++k) touched[k] = 0;  // the tile was finished before
  const size_t lanes = static_cast<size_t>(tile) * TILE * TILE;
  __builtin_memcpy(f.light.data + lanes, light, sizeof light);
  __builtin_memcpy(f.finished.data + lanes, finished, sizeof finished);
  each_pixel(f, c, [&](int lane, int64_t pixel) {
    float t = reinterpret_cast<float *>(light)[lane], *out = f.image + 3 * pixel;
    out[0] = reinterpret_cast<float *>(red)[lane] + t * f.background[0];
    out[1] = reinterpret_cast<float *>(green)[lane] + t * f.background[1];
    out[2] = reinterpret_cast<float *>(blue)[lane] + t * f.background[2];
    f.alpha[pixel] = 1.0f - t;
  });
}

namespace {

// Back to front: the light T is undone by 1 / (1 - alpha) >= 1, which is at most 100, and S, the loss's share of all
// that lies behind, grows from small to large. So both keep their relative accuracy however deep the stack.
// d(loss)/d(alpha) = T <colour, gradient> - S / (1 - alpha).
template <bool ABSGRAD>
void tile_back(Frame &f, int tile) {
  alignas(64) vf light[BLOCKS], behind[BLOCKS], red[BLOCKS], green[BLOCKS], blue[BLOCKS];
  alignas(64) vi finished[BLOCKS];
  const Offsets at = offsets();
  const Corner c = corner(f, tile);
  const size_t lanes = static_cast<size_t>(tile) * TILE * TILE;
  __builtin_memcpy(light, f.light.data + lanes, sizeof light);
  __builtin_memcpy(finished, f.finished.data + lanes, sizeof finished);
  for (int b = 0; b < BLOCKS; ++b) behind[b] = red[b] = green[b] = blue[b] = vf{};
  each_pixel(f, c, [&](int lane, int64_t pixel) {
    const float *g = f.image_grad + 3 * pixel, *end = f.background;
    reinterpret_cast<float *>(red)[lane] = g[0];
    reinterpret_cast<float *>(green)[lane] = g[1];
    reinterpret_cast<float *>(blue)[lane] = g[2];
    reinterpret_cast<float *>(behind)[lane] =
        reinterpret_cast<float *>(light)[lane] * (g[0] * end[0] + g[1] * end[1] + g[2] * end[2] - f.alpha_grad[pixel]);
  });
  const vf never = splat(NEVER), most = splat(ALPHA_MAX);
  const Entry *list = f.list.data + f.tile_start.data[tile];
  const uint64_t *touched = f.touched.data + f.tile_start.data[tile];
  for (int k = static_cast<int>(f.tile_start.data[tile + 1] - f.tile_start.data[tile]) - 1; k >= 0; --k) {
    if (k >= AHEAD && touched[k - AHEAD]) {
      __builtin_prefetch(&f.footprints.data[list[k - AHEAD].splat]);
      __builtin_prefetch(f.slots.data + static_cast<size_t>(list[k - AHEAD].slot) * SLOT, 1);
    }
    uint64_t todo = touched[k];
    if (!todo) continue;
    const Footprint &s = f.footprints.data[list[k].splat];
    const float x = static_cast<float>(s.x - c.x), y = static_cast<float>(s.y - c.y);
    vf sum[ABSGRAD ? 11 : 9] = {};
    for (; todo; todo &= todo - 1) {
      const int b = __builtin_ctzll(todo);
      const vf dx = at.x + (4 * (b % 4) - x), dy = at.y + (TALL * (b / 4) - y);
      const vf u = s.p * dx + s.r * dy, v = s.s * dy;
      const vf power = s.log2_opacity - v * v - u * u;
      const mask on = both(at_least(power, never), at_least(finished[b], vi{} + k));
      const vf free = exp2_lanes(power);
      const vf alpha = keep(on, smaller(free, most)), undo = 1.0f / (1.0f - alpha);
      const vf t = light[b] * undo, w = alpha * t, rest = behind[b];
      const vf shade = s.red * red[b] + s.green * green[b] + s.blue * blue[b];
      light[b] = t;
      behind[b] = rest + w * shade;
      sum[6] += w * red[b];
      sum[7] += w * green[b];
      sum[8] += w * blue[b];
      const vf d = keep(at_least(most, free), alpha * (t * shade - rest * undo));  // d loss / d log alpha
      const vf du = d * u, dv = d * dy;
      sum[0] += d;
      sum[1] += du;
      sum[2] += dv;
      sum[3] += du * dx;
      sum[4] += du * dy;
      sum[5] += dv * dy;
      if constexpr (ABSGRAD) {  // d loss / d centre of this pixel alone, up to 2 ln 2 (and p)
        const vf along = s.r * du + s.s * s.s * dv;
        sum[9] += larger(du, -du);
        sum[10] += larger(along, -along);
      }
    }
    float *slot = f.slots.data + static_cast<size_t>(list[k].slot) * SLOT;
    sum_nine(sum, slot);
    if constexpr (ABSGRAD) slot[9] = sum_lanes(sum[9]), slot[10] = sum_lanes(sum[10]);
    f.used.data[list[k].slot] = 1;
  }
}

}  // namespace

void raster_tile_back(Frame &f, int tile, bool absgrad) {
  if (absgrad)
    tile_back<true>(f, tile);
  else
    tile_back<false>(f, tile);
}

}  // namespace spikerig::SPIKERIG_ISA
