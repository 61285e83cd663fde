// Real spherical harmonics up to degree 3, in the order and signs of 3D Gaussian Splatting.
#pragma once
#include "../train_kernels.hpp"

namespace spikerig::SPIKERIG_ISA {

inline void harmonics(int degree, float x, float y, float z, float *out) {
  out[0] = 0.28209479177387814f;
  if (degree < 1) return;
  const float c1 = 0.4886025119029199f;
  out[1] = -c1 * y, out[2] = c1 * z, out[3] = -c1 * x;
  if (degree < 2) return;
  float xx = x * x, yy = y * y, zz = z * z;
  out[4] = 1.0925484305920792f * x * y;
  out[5] = -1.0925484305920792f * y * z;
  out[6] = 0.31539156525252005f * (2 * zz - xx - yy);
  out[7] = -1.0925484305920792f * x * z;
  out[8] = 0.5462742152960396f * (xx - yy);
  if (degree < 3) return;
  out[9] = -0.5900435899266435f * y * (3 * xx - yy);
  out[10] = 2.890611442640554f * x * y * z;
  out[11] = -0.4570457994644658f * y * (4 * zz - xx - yy);
  out[12] = 0.3731763325901154f * z * (2 * zz - 3 * xx - 3 * yy);
  out[13] = -0.4570457994644658f * x * (4 * zz - xx - yy);
  out[14] = 1.445305721320277f * z * (xx - yy);
  out[15] = -0.5900435899266435f * x * (xx - 3 * yy);
}

// Gradient of sum_k weight[k] * harmonic_k(x, y, z) as a polynomial in x, y, z, to out[3].
inline void harmonics_back(int degree, float x, float y, float z, const float *weight, float *out) {
  float gx = 0, gy = 0, gz = 0;
  if (degree >= 1) {
    const float c1 = 0.4886025119029199f;
    gx = -c1 * weight[3], gy = -c1 * weight[1], gz = c1 * weight[2];
  }
  if (degree >= 2) {
    float a = 1.0925484305920792f * weight[4], b = -1.0925484305920792f * weight[5];
    float c = 0.31539156525252005f * weight[6], d = -1.0925484305920792f * weight[7];
    float e = 0.5462742152960396f * weight[8];
    gx += a * y + d * z + 2 * x * (e - c);
    gy += a * x + b * z - 2 * y * (e + c);
    gz += b * y + d * x + 4 * c * z;
  }
  if (degree >= 3) {
    float xx = x * x, yy = y * y, zz = z * z;
    float a = -0.5900435899266435f * weight[9], b = 2.890611442640554f * weight[10];
    float c = -0.4570457994644658f * weight[11], d = 0.3731763325901154f * weight[12];
    float e = -0.4570457994644658f * weight[13], f = 1.445305721320277f * weight[14];
    float g = -0.5900435899266435f * weight[15];
    gx += 6 * a * x * y + b * y * z - 2 * c * x * y - 6 * d * x * z + e * (4 * zz - 3 * xx - yy) + 2 * f * x * z +
          3 * g * (xx - yy);
    gy += 3 * a * (xx - yy) + b * x * z + c * (4 * zz - xx - 3 * yy) - 6 * d * y * z - 2 * e * x * y - 2 * f * y * z -
          6 * g * x * y;
    gz += b * x * y + 8 * c * y * z + d * (6 * zz - 3 * xx - 3 * yy) + 8 * e * x * z + f * (xx - yy);
  }
  out[0] = gx, out[1] = gy, out[2] = gz;
}

struct Direction {
  double x, y, z, inverse;  // unit, camera centre to splat; 1 / distance
};

// The harmonics at splat i as the camera sees it; the direction too when `seen` is not null and the degree needs one.
inline void direction_basis(const Frame &f, int64_t i, float *basis, Direction *seen) {
  if (f.sh_degree == 0) return harmonics(0, 0, 0, 0, basis);
  const float *mean = f.splats.means + 3 * i;
  const double *centre = f.camera.centre, x = mean[0] - centre[0], y = mean[1] - centre[1], z = mean[2] - centre[2];
  const double inverse = 1.0 / __builtin_sqrt(x * x + y * y + z * z);
  const Direction d{x * inverse, y * inverse, z * inverse, inverse};
  harmonics(f.sh_degree, static_cast<float>(d.x), static_cast<float>(d.y), static_cast<float>(d.z), basis);
  if (seen) *seen = d;
}

}  // namespace spikerig::SPIKERIG_ISA
