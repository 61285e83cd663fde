// Splats to footprints. Oracle: train/oracles.py project.
#include <cmath>

#include "geometry.hpp"
#include "harmonics.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

const double LN2 = 0.6931471805599453;

// 1 when one of the n values is infinite or not a number, else 0.
uint32_t not_finite(const float *p, int64_t n) {
  uint32_t found = 0;
  for (int64_t k = 0; k < n; ++k) {
    uint32_t bits;
    __builtin_memcpy(&bits, p + k, 4);
    found |= (bits & 0x7f800000u) == 0x7f800000u;
  }
  return found;
}

// SH colour + 0.5, not below 0; false when it is not finite.
bool colour(const Frame &frame, int64_t i, Footprint &out) {
  const float *sh = frame.splats.sh + 3 * frame.splats.sh_rows * i;
  float basis[16], rgb[3] = {0.5f, 0.5f, 0.5f};
  direction_basis(frame, i, basis, nullptr);
  const int rows = (frame.sh_degree + 1) * (frame.sh_degree + 1);
  for (int k = 0; k < rows; ++k)
    for (int c = 0; c < 3; ++c) rgb[c] += basis[k] * sh[3 * k + c];
  out.red = rgb[0] > 0 ? rgb[0] : 0.0f;
  out.green = rgb[1] > 0 ? rgb[1] : 0.0f;
  out.blue = rgb[2] > 0 ? rgb[2] : 0.0f;
  const float total = rgb[0] + rgb[1] + rgb[2];
  return total - total == 0.0f;
}

// First and one past the last tile with a pixel centre in [centre - reach, centre + reach]; equal when none.
void tiles(double centre, double reach, int pixels, uint16_t &first, uint16_t &last) {
  double low = centre - reach - 0.5, high = centre + reach - 0.5;
  first = last = 0;
  if (!(high >= 0 && low <= pixels - 1)) return;
  const int from = low > 0 ? static_cast<int>(ceil(low)) : 0;
  const int to = high < pixels - 1 ? static_cast<int>(high) : pixels - 1;
  if (from > to) return;
  first = static_cast<uint16_t>(from / TILE);
  last = static_cast<uint16_t>(to / TILE + 1);
}

struct Settled {  // what Footprint holds, for WIDE splats
  vd x, y, p, r, s, log2_opacity, reach_x, reach_y, room, lean;
  vl seen;
};

Settled settle(const Frame &frame, const Geometry &g, vl seen, int64_t first, int64_t end) {
  const Camera &camera = frame.camera;
  const vd logit = column(frame.splats.logits, 1, 0, first, end), zero = splat(0.0);
  vd log_opacity = smaller(logit, zero) - log_lanes(1.0 + exp_lanes(logit < zero ? logit : -logit));
  if (frame.antialias) {
    const double least = COMPENSATION_MIN * COMPENSATION_MIN;
    log_opacity += 0.5 * log_lanes(larger(g.det0 / g.det, splat(least)));
  }
  const vd room = log_opacity - std::log(static_cast<double>(ALPHA_MIN));
  const vd reach = sqrt_lanes(larger(2.0 * room, zero)), root22 = sqrt_lanes(g.c22), root = sqrt_lanes(g.det);
  const double unit = __builtin_sqrt(0.5 / LN2);  // power in units of ln 2
  Settled out;
  out.seen = seen & (room > zero);
  out.x = camera.fx * g.u + camera.cx;
  out.y = camera.fy * g.v + camera.cy;
  out.reach_x = reach * sqrt_lanes(g.c11) * 1.0001 + 1e-3;
  out.reach_y = reach * root22 * 1.0001 + 1e-3;
  out.p = unit * root22 / root;
  out.r = -unit * g.c12 / (root22 * root);
  out.s = unit / root22;
  out.log2_opacity = log_opacity * (1 / LN2);
  out.room = room * (1 / LN2);
  out.lean = reach * g.c12 / sqrt_lanes(g.c11);
  return out;
}

}  // namespace

bool project(Frame &frame, int64_t begin, int64_t end) {
  const Camera &camera = frame.camera;
  const Splats &s = frame.splats;
  const Limits lim = limits(camera);
  const uint32_t unfit = not_finite(s.means + 3 * begin, 3 * (end - begin)) |
                         not_finite(s.log_scales + 3 * begin, 3 * (end - begin)) |
                         not_finite(s.quats + 4 * begin, 4 * (end - begin)) |
                         not_finite(s.logits + begin, end - begin);
  if (unfit) return false;
  for (int64_t first = begin; first < end; first += WIDE) {
    const int count = end - first < WIDE ? static_cast<int>(end - first) : WIDE;
    Geometry g;
    eye_of(camera, s, first, end, g);
    const vl seen = (g.eye.z > camera.near) & (g.u > lim.cull_x0) & (g.u < lim.cull_x1) & (g.v > lim.cull_y0) &
                    (g.v < lim.cull_y1);
    int64_t some = 0;
    for (int l = 0; l < WIDE; ++l) some |= seen[l];
    for (int l = 0; l < count; ++l) frame.rects.data[first + l] = {0, 0, 0, 0};
    if (!some) continue;
    footprint_of(camera, lim, s, first, end, g);
    const Settled all = settle(frame, g, seen, first, end);
    for (int l = 0; l < count; ++l) {
      if (!all.seen[l]) continue;
      const int64_t i = first + l;
      Rect rect;
      tiles(all.x[l], all.reach_x[l], camera.width, rect.x0, rect.x1);
      tiles(all.y[l], all.reach_y[l], camera.height, rect.y0, rect.y1);
      if (rect.x0 == rect.x1 || rect.y0 == rect.y1) continue;
      frame.rects.data[i] = rect;
      frame.depths.data[i] = static_cast<float>(g.eye.z[l]);
      Footprint &out = frame.footprints.data[i];
      out.x = all.x[l], out.y = all.y[l];
      out.p = float(all.p[l]), out.r = float(all.r[l]), out.s = float(all.s[l]);
      out.log2_opacity = float(all.log2_opacity[l]);
      out.reach_x = float(all.reach_x[l]), out.reach_y = float(all.reach_y[l]);
      out.room = float(all.room[l]), out.lean = float(all.lean[l]);
      if (!colour(frame, i, out)) return false;
    }
  }
  return true;
}

}  // namespace spikerig::SPIKERIG_ISA
