// Gaussian splatting and SSIM: what the kernels share. Definitions, in float64: train/oracles.py.
//
// The road of one picture (render.cpp walks it):
//   project     each splat -> Footprint (centre, Cholesky factor of the inverse covariance, colour), tiles it may touch
//   bin         stable radix sort by depth, then a list of splats for each 16 x 16 tile, front to back
//   raster      each tile -> colour and transmittance; which blocks of the tile each splat touched
//   raster_back each tile -> nine sums for each (tile, splat), in a slot of its own; two more where absgrad is asked for
//   project_back each splat: its slots, summed in tile order -> gradients of its parameters and of the camera
// Nothing depends on how the work is spread over threads, so the same bits come out for any thread count.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <new>

#include "dispatch.hpp"

namespace spikerig {

constexpr int TILE = 16;                    // pixels, each way
constexpr float ALPHA_MAX = 0.99f;          // one splat never takes more of the light than this
constexpr float ALPHA_MIN = 1.0f / 255.0f;  // below this a splat leaves a pixel untouched
constexpr float LIGHT_MIN = 1.1e-4f;        // a pixel with less light left is finished; above (1 - ALPHA_MAX)^2, so
                                            // that two clipped splats finish it whatever the rounding
constexpr double DILATION = 0.3;            // pixels^2 added to the covariance of each footprint
constexpr double COMPENSATION_MIN = 0.005;  // floor of the Mip 2D compensation
constexpr double CLAMP_MARGIN = 0.3;        // the EWA Jacobian is frozen beyond the picture plus this x half its size
constexpr double CULL_MARGIN = 1.0;         // centres beyond the picture plus this x half its size are dropped
constexpr double LOG_SCALE_MAX = 30.0;      // log scales are clamped to +-this
constexpr double QUAT_MIN = 1e-24;          // squared length below which a quaternion means "no rotation"
constexpr int SLOT = 12;                    // floats of a gradient slot; nine are used, eleven with absgrad
constexpr int64_t MAX_PAIRS = int64_t(1) << 31;  // (tile, splat) pairs of a picture
constexpr int CHUNK = 512;                  // splats of one part

// A growing array without initialisation; contents are lost on growth.
template <class T>
struct Buffer {
  T *data = nullptr;
  size_t room = 0;
  Buffer() = default;
  Buffer(const Buffer &) = delete;
  Buffer &operator=(const Buffer &) = delete;
  ~Buffer() { std::free(data); }
  T *need(size_t n) {
    if (n > room) {
      std::free(data);
      room = n + n / 4 + 64;
      size_t bytes = (room * sizeof(T) + 63) / 64 * 64;
      data = static_cast<T *>(std::aligned_alloc(64, bytes));
      if (!data) {
        room = 0;
        throw std::bad_alloc();
      }
    }
    return data;
  }
};

struct Camera {
  double fx, fy, cx, cy;      // pixels
  double cam_from_world[12];  // 3 x 4, row by row
  double centre[3];           // -R^T t, world
  int width, height;
  double near;
};

struct Splats {  // float32, C order
  const float *means, *quats, *log_scales, *logits, *sh;
  int64_t n;
  int sh_rows;  // (stored degree + 1)^2
};

struct SplatGrads {
  float *means, *quats, *log_scales, *logits, *sh, *means2d;
  float *absgrad;  // [n, 2] sums over pixels of |d loss / d means2d|, or null
};

struct alignas(64) Footprint {
  double x, y;             // centre, pixels
  float p, r, s;           // power / ln 2 = u^2 + v^2, u = p dx + r dy, v = s dy
  float log2_opacity;      // alpha = 2^(log2_opacity - u^2 - v^2)
  float red, green, blue;  // not negative
  float reach_x, reach_y;  // half size of the box that holds every pixel with alpha >= ALPHA_MIN
  float room;              // u^2 + v^2 on the rim, where alpha = ALPHA_MIN
  float lean;              // dy of the rim's rightmost point; the leftmost is at -dy
};
static_assert(sizeof(Footprint) == 64);

struct Rect {  // tiles, half-open; empty when culled
  uint16_t x0, x1, y0, y1;
};

struct Entry {  // of a tile's list
  uint32_t splat, slot;
};

struct Frame {  // one picture on its way
  Isa isa = Isa::plain;
  Camera camera{};
  Splats splats{};
  float background[3] = {0, 0, 0};
  int sh_degree = 0;
  bool antialias = false;
  int tiles_x = 0, tiles_y = 0;
  int64_t visible = 0, pairs = 0;
  Buffer<Footprint> footprints;    // [n]
  Buffer<Rect> rects;              // [n]
  Buffer<float> depths;            // [n]
  Buffer<uint32_t> first_slot;     // [n] slot of a splat's first tile; its others follow, row by row
  Buffer<uint32_t> keys, keys2, order, order2;  // of the sort
  Buffer<Rect> sorted_rects;       // [visible]
  Buffer<uint32_t> tile_start;     // [tiles + 1]
  Buffer<uint32_t> cursor;         // [tiles]
  Buffer<Entry> list;              // [pairs] by tile, front to back
  Buffer<uint64_t> touched;        // [pairs] by place in `list`: blocks of the tile where the splat left light
  Buffer<float> light;             // [tiles, TILE * TILE] left at the end, in the kernel's order of a tile's pixels
  Buffer<int32_t> finished;        // same: place in the tile's list where the pixel was finished
  Buffer<float> slots;             // [pairs, SLOT]
  Buffer<uint8_t> used;            // [pairs] 1 where the slot holds anything
  Buffer<double> camera_part;    // [chunks, 15]
  float *image = nullptr, *alpha = nullptr;                    // [H, W, 3], [H, W]
  const float *image_grad = nullptr, *alpha_grad = nullptr;  // same shapes
};

constexpr int BAND = 32;       // picture rows of one part of the SSIM
constexpr int TAPS = 11;       // its window, sigma 1.5, zero outside the picture (Inria's)
constexpr int ROW_PAD = 32;    // (at least 15) zeros before and after a row of channels

struct SsimPlan {
  const float *image, *target;  // [H, W, 3]
  const uint8_t *valid;         // [H, W] or null: other pixels count as outside the picture
  float *grad;                  // [H, W, 3] or null
  int width, height;
  double l1_scale, ssim_scale;  // loss = l1_scale * sum |image - target| + ssim_scale * sum (1 - ssim), valid ones
  int stride;                   // floats of a padded row of channels
  float *blurred;               // [3, H, stride]: d ssim / d (mean, square, product), blurred along rows
};

#define SPIKERIG_TRAIN_KERNELS(isa)                                                                                \
  namespace isa {                                                                                                  \
  bool project(Frame &frame, int64_t begin, int64_t end);      /* false: a parameter is not finite */             \
  void raster_tile(Frame &frame, int tile);                                                                        \
  void raster_tile_back(Frame &frame, int tile, bool absgrad);                                                     \
  void project_back(Frame &frame, const SplatGrads &grads, int64_t begin, int64_t end, double *camera_part);       \
  void ssim_band(const SsimPlan &plan, int band, float *scratch, double *sums); /* sums of |.| and of 1 - ssim */ \
  void ssim_band_back(const SsimPlan &plan, int band);                                                             \
  }
SPIKERIG_EACH_ISA(SPIKERIG_TRAIN_KERNELS)

bool render_forward(Frame &frame);  // false: a parameter is not finite, nothing is drawn
void render_backward(Frame &frame, const SplatGrads &grads, double *camera_grad);  // camera_grad[12]
int64_t consulted(const Frame &frame);  // sum over pixels of listed splats up to where the pixel was finished

double l1_ssim(SsimPlan plan);  // the loss; writes plan.grad unless it is null

}  // namespace spikerig
