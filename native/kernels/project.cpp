// Splats to footprints. Oracle: train/oracles.py project.
#include <cmath>

#include "geometry.hpp"
#include "harmonics.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

const double LN2 = 0.6931471805599453;

double log_sigmoid(double x) { return (x < 0 ? x : 0.0) - log1p(exp(x < 0 ? x : -x)); }

// SH colour + 0.5, not below 0; false when it is not finite.
bool colour(const Frame &frame, int64_t i, Footprint &out) {
  const float *mean = frame.splats.means + 3 * i;
  const float *sh = frame.splats.sh + 3 * frame.splats.sh_rows * i;
  double dx = mean[0] - frame.camera.centre[0], dy = mean[1] - frame.camera.centre[1];
  double dz = mean[2] - frame.camera.centre[2];
  double inverse = 1.0 / __builtin_sqrt(dx * dx + dy * dy + dz * dz);
  float basis[16], rgb[3] = {0.5f, 0.5f, 0.5f};
  harmonics(frame.sh_degree, float(dx * inverse), float(dy * inverse), float(dz * inverse), basis);
  int rows = (frame.sh_degree + 1) * (frame.sh_degree + 1);
  for (int k = 0; k < rows; ++k)
    for (int c = 0; c < 3; ++c) rgb[c] += basis[k] * sh[3 * k + c];
  out.red = rgb[0] > 0 ? rgb[0] : 0.0f;
  out.green = rgb[1] > 0 ? rgb[1] : 0.0f;
  out.blue = rgb[2] > 0 ? rgb[2] : 0.0f;
  float total = rgb[0] + rgb[1] + rgb[2];
  return total - total == 0.0f;
}

// First and one past the last tile with a pixel centre in [centre - reach, centre + reach]; equal when none.
void tiles(double centre, double reach, int pixels, uint16_t &first, uint16_t &last) {
  double low = ceil(centre - reach - 0.5), high = floor(centre + reach - 0.5);
  if (low < 0) low = 0;
  if (high > pixels - 1) high = pixels - 1;
  first = last = 0;
  if (!(low <= high)) return;
  first = static_cast<uint16_t>(static_cast<int>(low) / TILE);
  last = static_cast<uint16_t>(static_cast<int>(high) / TILE + 1);
}

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

// Lane l of the group's geometry to a footprint; culls what leaves no pixel with alpha >= ALPHA_MIN.
bool settle(const Frame &frame, const Geometry &g, int l, int64_t i, Footprint &out) {
  double log_opacity = log_sigmoid(frame.splats.logits[i]);
  if (frame.antialias) {
    double ratio = g.det0[l] / g.det[l], least = COMPENSATION_MIN * COMPENSATION_MIN;
    log_opacity += 0.5 * log(ratio > least ? ratio : least);
  }
  double room = log_opacity - log(static_cast<double>(ALPHA_MIN));
  if (!(room > 0)) return true;
  const Camera &camera = frame.camera;
  double c11 = g.c11[l], c12 = g.c12[l], c22 = g.c22[l], det = g.det[l];
  double reach_x = __builtin_sqrt(2 * room * c11) * 1.0001 + 1e-3;
  double reach_y = __builtin_sqrt(2 * room * c22) * 1.0001 + 1e-3;
  out.x = camera.fx * g.u[l] + camera.cx;
  out.y = camera.fy * g.v[l] + camera.cy;
  uint16_t x0, x1, y0, y1;
  tiles(out.x, reach_x, camera.width, x0, x1);
  tiles(out.y, reach_y, camera.height, y0, y1);
  if (x0 == x1 || y0 == y1) return true;
  double unit = __builtin_sqrt(0.5 / LN2);  // power in units of ln 2
  out.p = static_cast<float>(unit * __builtin_sqrt(c22 / det));
  out.r = static_cast<float>(-unit * c12 / __builtin_sqrt(c22 * det));
  out.s = static_cast<float>(unit / __builtin_sqrt(c22));
  out.log2_opacity = static_cast<float>(log_opacity / LN2);
  out.reach_x = static_cast<float>(reach_x);
  out.reach_y = static_cast<float>(reach_y);
  out.depth = static_cast<float>(g.eye.z[l]);
  out.x0 = x0, out.x1 = x1, out.y0 = y0, out.y1 = y1;
  return colour(frame, i, out);
}

}  // namespace

bool project(Frame &frame, int64_t begin, int64_t end) {
  const Camera &camera = frame.camera;
  const Splats &s = frame.splats;
  const Limits lim = limits(camera);
  uint32_t unfit = not_finite(s.means + 3 * begin, 3 * (end - begin)) |
                   not_finite(s.log_scales + 3 * begin, 3 * (end - begin)) |
                   not_finite(s.quats + 4 * begin, 4 * (end - begin)) |
                   not_finite(s.logits + begin, end - begin);
  if (unfit) return false;
  for (int64_t first = begin; first < end; first += WIDE) {
    Geometry g;
    eye_of(camera, s, first, end, g);
    vl seen = (g.eye.z > camera.near) & (g.u > lim.cull_x0) & (g.u < lim.cull_x1) & (g.v > lim.cull_y0) &
              (g.v < lim.cull_y1);
    bool some = false;
    for (int l = 0; l < WIDE; ++l) some |= seen[l] != 0;
    if (some) footprint_of(camera, lim, s, first, end, g);
    for (int l = 0; l < WIDE && first + l < end; ++l) {
      Footprint &out = frame.footprints.data[first + l];
      out.x0 = out.x1 = out.y0 = out.y1 = 0;
      if (seen[l] && !settle(frame, g, l, first + l, out)) return false;
    }
  }
  return true;
}

}  // namespace spikerig::SPIKERIG_ISA
