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

// A splat's slots, added in tile order, in double.
bool gather(const Frame &f, int64_t i, double *sum) {
  const Footprint &p = f.footprints.data[i];
  for (int k = 0; k < 9; ++k) sum[k] = 0;
  bool some = false;
  int64_t slot = f.first_slot.data[i], last = slot + static_cast<int64_t>(p.x1 - p.x0) * (p.y1 - p.y0);
  for (; slot < last; ++slot) {
    if (!f.touched.data[slot]) continue;
    some = true;
    const float *from = f.slots.data + slot * SLOT;
    for (int k = 0; k < 9; ++k) sum[k] += from[k];
  }
  return some;
}

// Colour gradients to SH gradients; returns d loss / d (mean - centre) in out.
void colour_back(const Frame &f, int64_t i, const double *rgb_grad, float *sh_grad, double *out) {
  const float *mean = f.splats.means + 3 * i, *sh = f.splats.sh + 3 * f.splats.sh_rows * i;
  const Footprint &p = f.footprints.data[i];
  float g[3] = {p.red > 0 ? float(rgb_grad[0]) : 0.0f, p.green > 0 ? float(rgb_grad[1]) : 0.0f,
                p.blue > 0 ? float(rgb_grad[2]) : 0.0f};
  double dx = mean[0] - f.camera.centre[0], dy = mean[1] - f.camera.centre[1], dz = mean[2] - f.camera.centre[2];
  double inverse = 1.0 / __builtin_sqrt(dx * dx + dy * dy + dz * dz);
  dx *= inverse, dy *= inverse, dz *= inverse;
  float basis[16], weight[16], toward[3];
  harmonics(f.sh_degree, float(dx), float(dy), float(dz), basis);
  int rows = (f.sh_degree + 1) * (f.sh_degree + 1);
  for (int k = 0; k < rows; ++k)
    for (int c = 0; c < 3; ++c) sh_grad[3 * k + c] = basis[k] * g[c];
  for (int k = 3 * rows; k < 3 * f.splats.sh_rows; ++k) sh_grad[k] = 0;
  out[0] = out[1] = out[2] = 0;
  if (f.sh_degree == 0) return;
  for (int k = 0; k < rows; ++k) weight[k] = sh[3 * k] * g[0] + sh[3 * k + 1] * g[1] + sh[3 * k + 2] * g[2];
  harmonics_back(f.sh_degree, float(dx), float(dy), float(dz), weight, toward);
  double along = dx * toward[0] + dy * toward[1] + dz * toward[2];
  out[0] = (toward[0] - dx * along) * inverse;
  out[1] = (toward[1] - dy * along) * inverse;
  out[2] = (toward[2] - dz * along) * inverse;
}

void zero(const SplatGrads &out, int64_t i, int sh_rows) {
  for (int k = 0; k < 3; ++k) out.means[3 * i + k] = out.log_scales[3 * i + k] = 0;
  for (int k = 0; k < 4; ++k) out.quats[4 * i + k] = 0;
  for (int k = 0; k < 3 * sh_rows; ++k) out.sh[3 * sh_rows * i + k] = 0;
  out.logits[i] = 0;
  out.means2d[2 * i] = out.means2d[2 * i + 1] = 0;
}

// p = sqrt(c22 / det), r = -c12 / sqrt(c22 det), s = 1 / sqrt(c22) back to the rows a and b.
void footprint_back(const Frame &f, const Geometry &g, const Incoming &in, V3 &ga, V3 &gb) {
  vd p = sqrt_lanes(g.c22 / g.det), r = -g.c12 / sqrt_lanes(g.c22 * g.det), s = 1.0 / sqrt_lanes(g.c22);
  vd g12 = -in.r / sqrt_lanes(g.c22 * g.det);
  vd g22 = (in.p * p - in.r * r - in.s * s) / (2.0 * g.c22);
  vd gdet = -(in.p * p + in.r * r) / (2.0 * g.det);
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
  for (int k = 0; k < 15; ++k) camera_part[k] = 0;
  const double unit = __builtin_sqrt(0.5 / LN2);  // p, r, s of a footprint are `unit` x those of the covariance
  for (int64_t first = begin; first < end; first += WIDE) {
    bool some[WIDE], any_at_all = false;
    Incoming in{};
    for (int l = 0; l < WIDE; ++l) {
      const int64_t i = first + l;
      some[l] = false;
      if (i >= end) continue;
      const Footprint &p = f.footprints.data[i];
      double m[9], toward[3];
      if (p.x0 == p.x1 || !gather(f, i, m)) {
        zero(grads, i, sh_rows);
        continue;
      }
      some[l] = any_at_all = true;
      colour_back(f, i, m + 6, grads.sh + 3 * sh_rows * i, toward);
      in.from_centre.x[l] = toward[0], in.from_centre.y[l] = toward[1], in.from_centre.z[l] = toward[2];
      // log alpha = log opacity - ln 2 (u^2 + v^2), and the sums hold d, d u, d dy, d u dx, d u dy, d dy^2
      in.opacity[l] = m[0];
      in.p[l] = -2 * LN2 * unit * m[3];
      in.r[l] = -2 * LN2 * unit * m[4];
      in.s[l] = -2 * LN2 * unit * p.s * m[5];
      in.x[l] = 2 * LN2 * p.p * m[1];
      in.y[l] = 2 * LN2 * (p.r * m[1] + static_cast<double>(p.s) * p.s * m[2]);
      grads.logits[i] = static_cast<float>(m[0] / (1 + exp(f.splats.logits[i])));
      grads.means2d[2 * i] = static_cast<float>(in.x[l]);
      grads.means2d[2 * i + 1] = static_cast<float>(in.y[l]);
    }
    if (!any_at_all) continue;
    Geometry g;
    V3 ga, gb;
    Outgoing out;
    eye_of(f.camera, f.splats, first, end, g);
    footprint_of(f.camera, lim, f.splats, first, end, g);
    footprint_back(f, g, in, ga, gb);
    geometry_back(f.camera, lim, g, in, ga, gb, out);
    for (int l = 0; l < WIDE; ++l) {
      if (!some[l]) continue;
      const int64_t i = first + l;
      float *mean = grads.means + 3 * i, *scale = grads.log_scales + 3 * i, *quat = grads.quats + 4 * i;
      mean[0] = float(out.mean.x[l]), mean[1] = float(out.mean.y[l]), mean[2] = float(out.mean.z[l]);
      scale[0] = float(out.log_scale.x[l]), scale[1] = float(out.log_scale.y[l]), scale[2] = float(out.log_scale.z[l]);
      quat[0] = float(out.qw[l]), quat[1] = float(out.qx[l]), quat[2] = float(out.qy[l]), quat[3] = float(out.qz[l]);
      for (int k = 0; k < 12; ++k) camera_part[k] += out.camera[k][l];
      camera_part[12] += in.from_centre.x[l], camera_part[13] += in.from_centre.y[l];
      camera_part[14] += in.from_centre.z[l];
    }
  }
}

}  // namespace spikerig::SPIKERIG_ISA
