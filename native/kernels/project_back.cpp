// Sums of the tiles to gradients of a splat's parameters and of the camera. Oracle: train/oracles.py, by autograd.
#include <cmath>

#include "geometry.hpp"
#include "harmonics.hpp"

namespace spikerig::SPIKERIG_ISA {
namespace {

const double LN2 = 0.6931471805599453;

struct Incoming {  // d loss / d: log opacity, p, r, s (in units of the power itself), centre; per lane
  vd opacity, p, r, s, x, y;
  V3 from_centre;  // mean - camera centre, through the SH direction
};

// A splat's slots, added in tile order, in double; false when all are empty. The last two: those of absgrad, if asked.
bool gather(const Frame &f, int64_t i, bool absgrad, double *sum) {
  const Rect r = f.rects.data[i];
  vd low[8 / WIDE] = {};
  double last_sum = 0, absolute[2] = {};
  bool some = false;
  size_t slot = f.first_slot.data[i];
  const size_t last = slot + static_cast<size_t>(r.x1 - r.x0) * (r.y1 - r.y0);
  for (; slot < last; ++slot) {
    if (!f.used.data[slot]) continue;
    some = true;
    const float *from = f.slots.data + slot * SLOT;
    for (int k = 0; k < 8; ++k) low[k / WIDE][k % WIDE] += from[k];
    last_sum += from[8];
    if (absgrad) absolute[0] += from[9], absolute[1] += from[10];
  }
  __builtin_memcpy(sum, low, sizeof low);
  sum[8] = last_sum, sum[9] = absolute[0], sum[10] = absolute[1];
  return some;
}

// Colour gradients to SH gradients; returns d loss / d (mean - centre) in out.
void colour_back(const Frame &f, int64_t i, const double *rgb_grad, float *sh_grad, double *out) {
  const float *sh = f.splats.sh + 3 * f.splats.sh_rows * i;
  const Footprint &p = f.footprints.data[i];
  const float g[3] = {p.red > 0 ? float(rgb_grad[0]) : 0.0f, p.green > 0 ? float(rgb_grad[1]) : 0.0f,
                      p.blue > 0 ? float(rgb_grad[2]) : 0.0f};
  float basis[16], weight[16], toward[3];
  Direction d{};
  direction_basis(f, i, basis, &d);
  const int rows = (f.sh_degree + 1) * (f.sh_degree + 1);
  for (int k = 0; k < rows; ++k)
    for (int c = 0; c < 3; ++c) sh_grad[3 * k + c] = basis[k] * g[c];
  for (int k = 3 * rows; k < 3 * f.splats.sh_rows; ++k) sh_grad[k] = 0;
  out[0] = out[1] = out[2] = 0;
  if (f.sh_degree == 0) return;
  for (int k = 0; k < rows; ++k) weight[k] = sh[3 * k] * g[0] + sh[3 * k + 1] * g[1] + sh[3 * k + 2] * g[2];
  harmonics_back(f.sh_degree, float(d.x), float(d.y), float(d.z), weight, toward);
  const double along = d.x * toward[0] + d.y * toward[1] + d.z * toward[2];
  out[0] = (toward[0] - d.x * along) * d.inverse;
  out[1] = (toward[1] - d.y * along) * d.inverse;
  out[2] = (toward[2] - d.z * along) * d.inverse;
}

void zero(const SplatGrads &out, int64_t i, int sh_rows) {
  for (int k = 0; k < 3; ++k) out.means[3 * i + k] = out.log_scales[3 * i + k] = 0;
  for (int k = 0; k < 4; ++k) out.quats[4 * i + k] = 0;
  for (int k = 0; k < 3 * sh_rows; ++k) out.sh[3 * sh_rows * i + k] = 0;
  out.logits[i] = 0;
  out.means2d[2 * i] = out.means2d[2 * i + 1] = 0;
  if (out.absgrad) out.absgrad[2 * i] = out.absgrad[2 * i + 1] = 0;
}

// p = sqrt(c22 / det), r = -c12 / sqrt(c22 det), s = 1 / sqrt(c22) back to the rows a and b.
void footprint_back(const Frame &f, const Geometry &g, const Incoming &in, V3 &ga, V3 &gb) {
  const vd root22 = sqrt_lanes(g.c22), root = 1.0 / sqrt_lanes(g.det), s = 1.0 / root22;
  const vd p = root22 * root, g12 = -in.r * s * root, r = -g.c12 * s * root;
  const vd g22 = 0.5 * (in.p * p - in.r * r - in.s * s) * s * s;
  vd gdet = -0.5 * (in.p * p + in.r * r) * root * root;
  vd gdet0 = gdet;  // through det = det0 + ...
  if (f.antialias) {  // log opacity += log(det0 / det) / 2 above its floor
    vl free = g.det0 > COMPENSATION_MIN * COMPENSATION_MIN * g.det;
    vd half = free ? 0.5 * in.opacity : splat(0.0);
    gdet -= half / g.det;
    gdet0 = gdet + (free ? half / g.det0 : splat(0.0));
  }
  vd dilated = 2.0 * DILATION * gdet;
  ga = g.b * g12 + g.a * dilated + cross(g.b, g.normal) * (2.0 * gdet0);
  gb = g.a * g12 + g.b * (2.0 * g22 + dilated) + cross(g.normal, g.a) * (2.0 * gdet0);
}

struct Columns {
  vd of[4];
};

// The lanes that are set, to rows of `stride` floats.
void write(float *to, int stride, int64_t first, vl some, Columns columns) {
  for (int l = 0; l < WIDE; ++l)
    for (int k = 0; k < stride && some[l]; ++k) to[stride * (first + l) + k] = static_cast<float>(columns.of[k][l]);
}

struct Outgoing {
  V3 mean, log_scale;
  vd qw, qx, qy, qz, camera[12];
};

// Rows a and b back to scales, rotation, camera coordinates and the camera.
void geometry_back(const Camera &camera, const Limits &lim, const Geometry &g, const Incoming &in, V3 ga, V3 gb,
                   Outgoing &out) {
  const double *w = camera.cam_from_world;
  const vd zero = splat(0.0);
  out.log_scale = {g.scale_free[0] ? ga.x * g.a.x + gb.x * g.b.x : zero,
                   g.scale_free[1] ? ga.y * g.a.y + gb.y * g.b.y : zero,
                   g.scale_free[2] ? ga.z * g.a.z + gb.z * g.b.z : zero};
  V3 ge = {ga.x * g.scale.x, ga.y * g.scale.y, ga.z * g.scale.z};  // of ta . column[k], tb . column[k]
  V3 gf = {gb.x * g.scale.x, gb.y * g.scale.y, gb.z * g.scale.z};
  V3 gta = g.column[0] * ge.x + g.column[1] * ge.y + g.column[2] * ge.z;
  V3 gtb = g.column[0] * gf.x + g.column[1] * gf.y + g.column[2] * gf.z;
  V3 c0 = g.ta * ge.x + g.tb * gf.x, c1 = g.ta * ge.y + g.tb * gf.y, c2 = g.ta * ge.z + g.tb * gf.z;
  vd qw = g.qw, qx = g.qx, qy = g.qy, qz = g.qz;
  vd gw = 2.0 * (qx * (c1.z - c2.y) + qy * (c2.x - c0.z) + qz * (c0.y - c1.x));
  vd gx = 2.0 * (qw * (c1.z - c2.y) + qy * (c1.x + c0.y) + qz * (c2.x + c0.z) - 2.0 * qx * (c1.y + c2.z));
  vd gy = 2.0 * (qw * (c2.x - c0.z) + qx * (c1.x + c0.y) + qz * (c2.y + c1.z) - 2.0 * qy * (c0.x + c2.z));
  vd gz = 2.0 * (qw * (c0.y - c1.x) + qx * (c2.x + c0.z) + qy * (c2.y + c1.z) - 2.0 * qz * (c0.x + c1.y));
  vd along = gw * qw + gx * qx + gy * qy + gz * qz;
  out.qw = (gw - qw * along) * g.unit, out.qx = (gx - qx * along) * g.unit;
  out.qy = (gy - qy * along) * g.unit, out.qz = (gz - qz * along) * g.unit;
  vd iz = 1.0 / g.eye.z, ix = camera.fx * iz, iy = camera.fy * iz;
  vl free_u = (g.u > lim.clamp_x0) & (g.u < lim.clamp_x1), free_v = (g.v > lim.clamp_y0) & (g.v < lim.clamp_y1);
  vd guc = -ix * (gta.x * w[8] + gta.y * w[9] + gta.z * w[10]);
  vd gvc = -iy * (gtb.x * w[8] + gtb.y * w[9] + gtb.z * w[10]);
  vd gu = (free_u ? guc : zero) + camera.fx * in.x, gv = (free_v ? gvc : zero) + camera.fy * in.y;
  V3 eye = {gu * iz, gv * iz, -(gu * g.u + gv * g.v + dot(gta, g.ta) + dot(gtb, g.tb)) * iz};
  out.mean = {eye.x * w[0] + eye.y * w[4] + eye.z * w[8], eye.x * w[1] + eye.y * w[5] + eye.z * w[9],
              eye.x * w[2] + eye.y * w[6] + eye.z * w[10]};
  out.mean = out.mean + in.from_centre;
  V3 r0 = gta * ix + g.mean * eye.x, r1 = gtb * iy + g.mean * eye.y;
  V3 r2 = g.mean * eye.z - gta * (ix * g.uc) - gtb * (iy * g.vc);
  const vd all[12] = {r0.x, r0.y, r0.z, eye.x, r1.x, r1.y, r1.z, eye.y, r2.x, r2.y, r2.z, eye.z};
  for (int k = 0; k < 12; ++k) out.camera[k] = all[k];
}

}  // namespace

void project_back(Frame &f, const SplatGrads &grads, int64_t begin, int64_t end, double *camera_part) {
  const Limits lim = limits(f.camera);
  const int sh_rows = f.splats.sh_rows;
  const double unit = __builtin_sqrt(0.5 / LN2);  // p, r, s of a footprint are `unit` x those of the covariance
  vd camera[15] = {};
  for (int64_t first = begin; first < end; first += WIDE) {
    vl some{};
    bool any_at_all = false;
    double sums[6][WIDE] = {}, toward[3][WIDE] = {}, factor[3][WIDE] = {};
    for (int l = 0; l < WIDE && first + l < end; ++l) {
      const int64_t i = first + l;
      double m[11], t[3];
      if (f.rects.data[i].x0 == f.rects.data[i].x1 || !gather(f, i, grads.absgrad != nullptr, m)) {
        zero(grads, i, sh_rows);
        continue;
      }
      const Footprint &p = f.footprints.data[i];
      some[l] = -1, any_at_all = true;
      colour_back(f, i, m + 6, grads.sh + 3 * sh_rows * i, t);
      for (int k = 0; k < 6; ++k) sums[k][l] = m[k];
      for (int k = 0; k < 3; ++k) toward[k][l] = t[k];
      factor[0][l] = p.p, factor[1][l] = p.r, factor[2][l] = p.s;
      if (!grads.absgrad) continue;
      grads.absgrad[2 * i] = static_cast<float>(2 * LN2 * p.p * m[9]);
      grads.absgrad[2 * i + 1] = static_cast<float>(2 * LN2 * m[10]);
    }
    if (!any_at_all) continue;
    // log alpha = log opacity - ln 2 (u^2 + v^2), and the sums hold d, d u, d dy, d u dx, d u dy, d dy^2
    const vd p = load_wide(factor[0]), r = load_wide(factor[1]), s = load_wide(factor[2]);
    const vd du = load_wide(sums[1]), dy = load_wide(sums[2]);
    Incoming in;
    in.opacity = load_wide(sums[0]);
    in.p = -2 * LN2 * unit * load_wide(sums[3]);
    in.r = -2 * LN2 * unit * load_wide(sums[4]);
    in.s = -2 * LN2 * unit * s * load_wide(sums[5]);
    in.x = 2 * LN2 * p * du;
    in.y = 2 * LN2 * (r * du + s * s * dy);
    in.from_centre = {load_wide(toward[0]), load_wide(toward[1]), load_wide(toward[2])};
    Geometry g;
    V3 ga, gb;
    Outgoing out;
    eye_of(f.camera, f.splats, first, end, g);
    footprint_of(f.camera, lim, f.splats, first, end, g);
    footprint_back(f, g, in, ga, gb);
    geometry_back(f.camera, lim, g, in, ga, gb, out);
    const vd logit = in.opacity / (1.0 + exp_lanes(column(f.splats.logits, 1, 0, first, end)));
    const V3 scale = out.log_scale, mean = out.mean;
    write(grads.means, 3, first, some, {{mean.x, mean.y, mean.z}});
    write(grads.log_scales, 3, first, some, {{scale.x, scale.y, scale.z}});
    write(grads.quats, 4, first, some, {{out.qw, out.qx, out.qy, out.qz}});
    write(grads.logits, 1, first, some, {{logit}});
    write(grads.means2d, 2, first, some, {{in.x, in.y}});
    for (int k = 0; k < 12; ++k) camera[k] += some ? out.camera[k] : splat(0.0);
    camera[12] += in.from_centre.x, camera[13] += in.from_centre.y, camera[14] += in.from_centre.z;
  }
  for (int k = 0; k < 15; ++k) camera_part[k] = sum_lanes(camera[k]);
}

}  // namespace spikerig::SPIKERIG_ISA
