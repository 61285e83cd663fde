// The road of one picture: project, sort, bin, raster; and back. Orchestration only, compiled once: the arithmetic is
// in kernels/, and the parts handed to the thread team never depend on its size.
#include <cstring>

#include "team.hpp"
#include "train_kernels.hpp"

namespace spikerig {
namespace {

struct Kernels {
  decltype(&plain::project) project;
  decltype(&plain::raster_tile) raster_tile;
  decltype(&plain::raster_tile_back) raster_tile_back;
  decltype(&plain::project_back) project_back;
};

#define SPIKERIG_TABLE(which) \
  if (isa == Isa::which) return {which::project, which::raster_tile, which::raster_tile_back, which::project_back};

Kernels kernels(Isa isa) {
  SPIKERIG_EACH_ISA(SPIKERIG_TABLE)
  return {plain::project, plain::raster_tile, plain::raster_tile_back, plain::project_back};
}

int chunks(int64_t n) { return static_cast<int>((n + CHUNK - 1) / CHUNK); }

int64_t until(int64_t begin, int64_t n) { return begin + CHUNK < n ? begin + CHUNK : n; }

// Ids of the visible splats, nearest first, ties by id: least significant digit first, three digits of 11 bits.
const uint32_t *sort_by_depth(Frame &f) {
  int64_t n = f.splats.n, count = 0;
  uint32_t *key = f.keys.need(n), *key2 = f.keys2.need(n), *id = f.order.need(n), *id2 = f.order2.need(n);
  static thread_local uint32_t histogram[3][2048];
  std::memset(histogram, 0, sizeof histogram);
  for (int64_t i = 0; i < n; ++i) {
    if (f.rects.data[i].x0 == f.rects.data[i].x1) continue;
    uint32_t bits;
    std::memcpy(&bits, &f.depths.data[i], 4);  // positive, so its bits sort as it does
    key[count] = bits;
    id[count++] = static_cast<uint32_t>(i);
    ++histogram[0][bits & 2047], ++histogram[1][bits >> 11 & 2047], ++histogram[2][bits >> 22];
  }
  f.visible = count;
  for (int pass = 0; pass < 3; ++pass) {
    uint32_t total = 0;
    for (uint32_t &h : histogram[pass]) {
      uint32_t here = h;
      h = total;
      total += here;
    }
    for (int64_t k = 0; k < count; ++k) {
      uint32_t to = histogram[pass][key[k] >> 11 * pass & 2047]++;
      key2[to] = key[k], id2[to] = id[k];
    }
    std::swap(key, key2), std::swap(id, id2);
  }
  return id;
}

// How many splats each tile has: corners of the rectangles, then sums along x and along y.
void count_by_tile(const Frame &f, const Rect *rects, uint32_t *start) {
  const int wide = f.tiles_x + 1, tall = f.tiles_y + 1;
  Buffer<int32_t> corners;
  int32_t *c = corners.need(wide * tall);
  std::memset(c, 0, static_cast<size_t>(wide) * tall * sizeof(int32_t));
  for (int64_t k = 0; k < f.visible; ++k) {
    const Rect r = rects[k];
    ++c[r.y0 * wide + r.x0], --c[r.y0 * wide + r.x1], --c[r.y1 * wide + r.x0], ++c[r.y1 * wide + r.x1];
  }
  start[0] = 0;
  for (int y = 0; y < f.tiles_y; ++y)
    for (int x = 0; x < f.tiles_x; ++x) {
      int32_t &here = c[y * wide + x];
      if (x) here += c[y * wide + x - 1];
      if (y) here += c[(y - 1) * wide + x];
      if (x && y) here -= c[(y - 1) * wide + x - 1];
      start[y * f.tiles_x + x + 1] = start[y * f.tiles_x + x] + static_cast<uint32_t>(here);
    }
}

// Lists of splats by tile, front to back; the picture's two halves are independent of each other.
void bin(Frame &f, const uint32_t *sorted) {
  const int tiles = f.tiles_x * f.tiles_y;
  uint32_t *first = f.first_slot.need(f.splats.n);
  f.pairs = 0;
  for (int64_t i = 0; i < f.splats.n; ++i) {
    const Rect r = f.rects.data[i];
    first[i] = static_cast<uint32_t>(f.pairs);
    f.pairs += static_cast<int64_t>(r.x1 - r.x0) * (r.y1 - r.y0);
  }
  if (f.pairs > MAX_PAIRS) throw std::bad_alloc();
  Rect *rects = f.sorted_rects.need(f.visible);
  for (int64_t k = 0; k < f.visible; ++k) rects[k] = f.rects.data[sorted[k]];
  uint32_t *start = f.tile_start.need(tiles + 1), *cursor = f.cursor.need(tiles);
  count_by_tile(f, rects, start);
  std::memcpy(cursor, start, tiles * sizeof(uint32_t));
  Entry *list = f.list.need(f.pairs);
  parallel(2, [&](int half) {
    const int top = half ? f.tiles_y / 2 : 0, bottom = half ? f.tiles_y : f.tiles_y / 2;
    for (int64_t k = 0; k < f.visible; ++k) {
      const Rect r = rects[k];
      const int y0 = r.y0 > top ? r.y0 : top, y1 = r.y1 < bottom ? r.y1 : bottom;
      for (int y = y0; y < y1; ++y) {
        uint32_t slot = first[sorted[k]] + static_cast<uint32_t>((y - r.y0) * (r.x1 - r.x0));
        for (int x = r.x0; x < r.x1; ++x) list[cursor[y * f.tiles_x + x]++] = {sorted[k], slot++};
      }
    }
  });
}

}  // namespace

bool render_forward(Frame &f) {
  const Kernels kernel = kernels(f.isa);
  const int64_t n = f.splats.n;
  f.tiles_x = (f.camera.width + TILE - 1) / TILE;
  f.tiles_y = (f.camera.height + TILE - 1) / TILE;
  f.footprints.need(n), f.rects.need(n), f.depths.need(n);
  Buffer<uint8_t> fit;
  fit.need(chunks(n));
  parallel(chunks(n), [&](int part) {
    int64_t begin = static_cast<int64_t>(part) * CHUNK;
    fit.data[part] = kernel.project(f, begin, until(begin, n));
  });
  for (int part = 0; part < chunks(n); ++part)
    if (!fit.data[part]) return false;
  bin(f, sort_by_depth(f));
  f.touched.need(f.pairs);
  const size_t lanes = static_cast<size_t>(f.tiles_x) * f.tiles_y * TILE * TILE;
  f.light.need(lanes), f.finished.need(lanes);
  parallel(f.tiles_x * f.tiles_y, [&](int tile) { kernel.raster_tile(f, tile); });
  return true;
}

void render_backward(Frame &f, const SplatGrads &grads, double *camera_grad) {
  const Kernels kernel = kernels(f.isa);
  const int64_t n = f.splats.n;
  f.slots.need(f.pairs * SLOT);
  std::memset(f.used.need(f.pairs), 0, f.pairs);
  parallel(f.tiles_x * f.tiles_y, [&](int tile) { kernel.raster_tile_back(f, tile, grads.absgrad != nullptr); });
  const int parts = chunks(n);
  f.camera_part.need(static_cast<size_t>(parts) * 15);
  parallel(parts, [&](int part) {
    int64_t begin = static_cast<int64_t>(part) * CHUNK;
    kernel.project_back(f, grads, begin, until(begin, n), f.camera_part.data + 15 * part);
  });
  double total[15] = {};  // d/d cam_from_world[12], then the sum of d/d (mean - camera centre)
  for (int part = 0; part < parts; ++part)
    for (int k = 0; k < 15; ++k) total[k] += f.camera_part.data[15 * part + k];
  const double *w = f.camera.cam_from_world, *from_centre = total + 12;
  for (int i = 0; i < 3; ++i) {  // mean - centre = mean + R^T t
    for (int j = 0; j < 3; ++j) {
      camera_grad[4 * i + j] = total[4 * i + j] + w[4 * i + 3] * from_centre[j];
    }
    camera_grad[4 * i + 3] = total[4 * i + 3];
    for (int j = 0; j < 3; ++j) camera_grad[4 * i + 3] += w[4 * i + j] * from_centre[j];
  }
}

int64_t consulted(const Frame &f) {
  int64_t total = 0;
  for (int tile = 0; tile < f.tiles_x * f.tiles_y; ++tile) {
    int x0 = tile % f.tiles_x * TILE, y0 = tile / f.tiles_x * TILE;
    for (int y = y0; y < y0 + TILE && y < f.camera.height; ++y)
      for (int x = x0; x < x0 + TILE && x < f.camera.width; ++x) {
        float light = 1;
        const uint32_t end = f.tile_start.data[tile + 1];
        for (uint32_t k = f.tile_start.data[tile]; k < end && light >= LIGHT_MIN; ++k, ++total) {
          const Footprint &p = f.footprints.data[f.list.data[k].splat];
          float dx = static_cast<float>(x + 0.5 - p.x), dy = static_cast<float>(y + 0.5 - p.y);
          float u = p.p * dx + p.r * dy, v = p.s * dy;
          float alpha = __builtin_exp2f(p.log2_opacity - u * u - v * v);
          if (alpha >= ALPHA_MIN) light *= 1 - (alpha < ALPHA_MAX ? alpha : ALPHA_MAX);
        }
      }
  }
  return total;
}

}  // namespace spikerig
