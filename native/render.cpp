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
    const Footprint &p = f.footprints.data[i];
    if (p.x0 == p.x1) continue;
    uint32_t bits;
    std::memcpy(&bits, &p.depth, 4);  // positive, so its bits sort as it does
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

struct Rect {
  uint16_t x0, x1, y0, y1;
};

// Lists of splats by tile, front to back. Bands of tile rows are independent of each other.
void bin(Frame &f, const uint32_t *sorted) {
  const int tiles = f.tiles_x * f.tiles_y, band_rows = 4, bands = (f.tiles_y + band_rows - 1) / band_rows;
  f.first_slot.need(f.splats.n), f.rects.need(f.visible);
  f.pairs = 0;
  for (int64_t k = 0; k < f.visible; ++k) {
    const Footprint &p = f.footprints.data[sorted[k]];
    Rect rect{p.x0, p.x1, p.y0, p.y1};
    std::memcpy(&f.rects.data[k], &rect, 8);
    f.first_slot.data[sorted[k]] = f.pairs;
    f.pairs += static_cast<int64_t>(p.x1 - p.x0) * (p.y1 - p.y0);
  }
  int64_t *start = f.tile_start.need(tiles + 1), *cursor = f.cursor.need(tiles);
  int32_t *list = f.list.need(f.pairs);
  std::memset(f.touched.need(f.pairs), 0, f.pairs * sizeof(uint64_t));
  auto each = [&](int band, auto visit) {
    int top = band * band_rows, bottom = top + band_rows < f.tiles_y ? top + band_rows : f.tiles_y;
    for (int64_t k = 0; k < f.visible; ++k) {
      Rect rect;
      std::memcpy(&rect, &f.rects.data[k], 8);
      int y0 = rect.y0 > top ? rect.y0 : top, y1 = rect.y1 < bottom ? rect.y1 : bottom;
      for (int y = y0; y < y1; ++y)
        for (int x = rect.x0; x < rect.x1; ++x) visit(k, y * f.tiles_x + x);
    }
  };
  std::memset(cursor, 0, tiles * sizeof(int64_t));
  parallel(bands, [&](int band) { each(band, [&](int64_t, int tile) { ++cursor[tile]; }); });
  start[0] = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    start[tile + 1] = start[tile] + cursor[tile];
    cursor[tile] = start[tile];
  }
  parallel(bands, [&](int band) {
    each(band, [&](int64_t k, int tile) { list[cursor[tile]++] = static_cast<int32_t>(sorted[k]); });
  });
}

}  // namespace

bool render_forward(Frame &f) {
  const Kernels kernel = kernels(f.isa);
  const int64_t n = f.splats.n;
  f.tiles_x = (f.camera.width + TILE - 1) / TILE;
  f.tiles_y = (f.camera.height + TILE - 1) / TILE;
  f.footprints.need(n);
  Buffer<uint8_t> fit;
  fit.need(chunks(n));
  parallel(chunks(n), [&](int part) {
    int64_t begin = static_cast<int64_t>(part) * CHUNK;
    fit.data[part] = kernel.project(f, begin, until(begin, n));
  });
  for (int part = 0; part < chunks(n); ++part)
    if (!fit.data[part]) return false;
  bin(f, sort_by_depth(f));
  parallel(f.tiles_x * f.tiles_y, [&](int tile) { kernel.raster_tile(f, tile); });
  return true;
}

void render_backward(Frame &f, const SplatGrads &grads, double *camera_grad) {
  const Kernels kernel = kernels(f.isa);
  const int64_t n = f.splats.n;
  f.slots.need(f.pairs * SLOT);
  parallel(f.tiles_x * f.tiles_y, [&](int tile) { kernel.raster_tile_back(f, tile); });
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
        for (int64_t k = f.tile_start.data[tile]; k < f.tile_start.data[tile + 1] && light >= LIGHT_MIN; ++k, ++total) {
          const Footprint &p = f.footprints.data[f.list.data[k]];
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
