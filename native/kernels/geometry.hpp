// WIDE splats at once, in double: camera coordinates and the rows a, b of the 2 x 3 footprint matrix J W R S.
// Their covariance is a.a + DILATION, a.b, b.b + DILATION; its determinant is a sum of squares (|a x b|^2 and the
// dilation's terms), so needles of any condition lose nothing. Shared by project.cpp and project_back.cpp.
#pragma once
#include "../train_kernels.hpp"
#include "float_lanes.hpp"

namespace spikerig::SPIKERIG_ISA {

struct V3 {
  vd x, y, z;
};
inline V3 operator+(V3 a, V3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline V3 operator-(V3 a, V3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline V3 operator*(V3 a, vd s) { return {a.x * s, a.y * s, a.z * s}; }
inline vd dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline V3 cross(V3 a, V3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

struct Geometry {
  V3 mean, eye;              // world, camera
  vd u, v, uc, vc;           // eye.xy / eye.z, and the same clamped for the Jacobian
  vd qw, qx, qy, qz, unit;   // unit quaternion; 1 / length, or 0 where the length is too small
  V3 scale;                  // e^log_scale
  vl scale_free[3];          // log scale inside its clamp
  V3 column[3];              // of the rotation R
  V3 ta, tb;                 // rows of J W
  V3 a, b, normal;           // rows of J W R S, and a x b
  vd c11, c12, c22, det0, det;
};

struct Limits {  // of eye.xy / eye.z
  double clamp_x0, clamp_x1, clamp_y0, clamp_y1, cull_x0, cull_x1, cull_y0, cull_y1;
};

inline Limits limits(const Camera &c) {
  double half_x = 0.5 * c.width / c.fx, half_y = 0.5 * c.height / c.fy;
  double x0 = -c.cx / c.fx, x1 = (c.width - c.cx) / c.fx, y0 = -c.cy / c.fy, y1 = (c.height - c.cy) / c.fy;
  const double clamp_x = CLAMP_MARGIN * half_x, clamp_y = CLAMP_MARGIN * half_y;
  const double cull_x = CULL_MARGIN * half_x, cull_y = CULL_MARGIN * half_y;
  return {x0 - clamp_x, x1 + clamp_x, y0 - clamp_y, y1 + clamp_y, x0 - cull_x, x1 + cull_x, y0 - cull_y, y1 + cull_y};
}

inline vd clamped(vd x, double low, double high) { return smaller(larger(x, splat(low)), splat(high)); }

// Reads splats first..first+WIDE-1; those at or beyond `end` repeat the last one.
inline vd column(const float *p, int stride, int offset, int64_t first, int64_t end) {
  vd out;
  for (int l = 0; l < WIDE; ++l) {
    int64_t i = first + l < end ? first + l : end - 1;
    out[l] = p[i * stride + offset];
  }
  return out;
}

inline vd scale_of(const float *log_scales, int axis, int64_t first, int64_t end, vl *free) {
  vd raw = column(log_scales, 3, axis, first, end);
  *free = (raw > -LOG_SCALE_MAX) & (raw < LOG_SCALE_MAX);
  return exp_lanes(clamped(raw, -LOG_SCALE_MAX, LOG_SCALE_MAX));
}

inline void eye_of(const Camera &camera, const Splats &s, int64_t first, int64_t end, Geometry &g) {
  const double *w = camera.cam_from_world;
  g.mean = {column(s.means, 3, 0, first, end), column(s.means, 3, 1, first, end), column(s.means, 3, 2, first, end)};
  g.eye = {g.mean.x * w[0] + g.mean.y * w[1] + g.mean.z * w[2] + w[3],
           g.mean.x * w[4] + g.mean.y * w[5] + g.mean.z * w[6] + w[7],
           g.mean.x * w[8] + g.mean.y * w[9] + g.mean.z * w[10] + w[11]};
  g.u = g.eye.x / g.eye.z;
  g.v = g.eye.y / g.eye.z;
}

inline void rotation_of(const Splats &s, int64_t first, int64_t end, Geometry &g) {
  vd w = column(s.quats, 4, 0, first, end), x = column(s.quats, 4, 1, first, end);
  vd y = column(s.quats, 4, 2, first, end), z = column(s.quats, 4, 3, first, end);
  vd length2 = w * w + x * x + y * y + z * z;
  g.unit = length2 >= QUAT_MIN ? 1.0 / sqrt_lanes(length2) : splat(0.0);
  w *= g.unit, x *= g.unit, y *= g.unit, z *= g.unit;
  g.qw = w, g.qx = x, g.qy = y, g.qz = z;
  g.column[0] = {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)};
  g.column[1] = {2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)};
  g.column[2] = {2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)};
}

inline void footprint_of(const Camera &camera, const Limits &lim, const Splats &s, int64_t first, int64_t end,
                         Geometry &g) {
  const double *w = camera.cam_from_world;
  g.uc = clamped(g.u, lim.clamp_x0, lim.clamp_x1);
  g.vc = clamped(g.v, lim.clamp_y0, lim.clamp_y1);
  g.scale.x = scale_of(s.log_scales, 0, first, end, &g.scale_free[0]);
  g.scale.y = scale_of(s.log_scales, 1, first, end, &g.scale_free[1]);
  g.scale.z = scale_of(s.log_scales, 2, first, end, &g.scale_free[2]);
  rotation_of(s, first, end, g);
  vd ix = camera.fx / g.eye.z, iy = camera.fy / g.eye.z;
  g.ta = V3{w[0] - g.uc * w[8], w[1] - g.uc * w[9], w[2] - g.uc * w[10]} * ix;
  g.tb = V3{w[4] - g.vc * w[8], w[5] - g.vc * w[9], w[6] - g.vc * w[10]} * iy;
  g.a = {dot(g.ta, g.column[0]) * g.scale.x, dot(g.ta, g.column[1]) * g.scale.y, dot(g.ta, g.column[2]) * g.scale.z};
  g.b = {dot(g.tb, g.column[0]) * g.scale.x, dot(g.tb, g.column[1]) * g.scale.y, dot(g.tb, g.column[2]) * g.scale.z};
  g.normal = cross(g.a, g.b);
  vd aa = dot(g.a, g.a), bb = dot(g.b, g.b);
  g.c11 = aa + DILATION;
  g.c22 = bb + DILATION;
  g.c12 = dot(g.a, g.b);
  g.det0 = dot(g.normal, g.normal);
  g.det = g.det0 + DILATION * (aa + bb) + DILATION * DILATION;
}

}  // namespace spikerig::SPIKERIG_ISA
