// Real spherical harmonics of degree 0..3, signs and order of the 3DGS reference files.
#pragma once

#include "../simd/lanes.h"

namespace aomgen::AOMGEN_ISA {

constexpr float kC0 = 0.28209479177387814f;
constexpr float kC1 = 0.4886025119029199f;
constexpr float kC2xy = 1.0925484305920792f, kC2zz = 0.31539156525252005f, kC2xx = 0.5462742152960396f;
constexpr float kC3a = 0.5900435899266435f, kC3b = 2.890611442640554f, kC3c = 0.4570457994644658f;
constexpr float kC3d = 0.3731763325901154f, kC3e = 1.445305721320277f;

// Basis values at the unit direction (x, y, z).
AOMGEN_INLINE void harmonics(int degree, F x, F y, F z, F basis[16]) {
  basis[0] = all(kC0);
  if (degree < 1) return;
  basis[1] = -kC1 * y;
  basis[2] = kC1 * z;
  basis[3] = -kC1 * x;
  if (degree < 2) return;
  F xx = x * x, yy = y * y, zz = z * z;
  basis[4] = kC2xy * (x * y);
  basis[5] = -kC2xy * (y * z);
  basis[6] = kC2zz * (zz + zz - xx - yy);
  basis[7] = -kC2xy * (x * z);
  basis[8] = kC2xx * (xx - yy);
  if (degree < 3) return;
  basis[9] = -kC3a * (y * (3.0f * xx - yy));
  basis[10] = kC3b * (x * y * z);
  basis[11] = -kC3c * (y * (4.0f * zz - xx - yy));
  basis[12] = kC3d * (z * (2.0f * zz - 3.0f * (xx + yy)));
  basis[13] = -kC3c * (x * (4.0f * zz - xx - yy));
  basis[14] = kC3e * (z * (xx - yy));
  basis[15] = -kC3a * (x * (xx - 3.0f * yy));
}

// Gradient by (x, y, z) of sum_k weights[k] * basis[k], with x, y, z taken as free variables.
AOMGEN_INLINE void harmonics_gradient(int degree, F x, F y, F z, const F w[16], F& gx, F& gy, F& gz) {
  gx = -kC1 * w[3];
  gy = -kC1 * w[1];
  gz = kC1 * w[2];
  if (degree < 2) return;
  gx = gx + kC2xy * (y * w[4] - z * w[7]) - 2 * kC2zz * (x * w[6]) + 2 * kC2xx * (x * w[8]);
  gy = gy + kC2xy * (x * w[4] - z * w[5]) - 2 * kC2zz * (y * w[6]) - 2 * kC2xx * (y * w[8]);
  gz = gz - kC2xy * (y * w[5] + x * w[7]) + 4 * kC2zz * (z * w[6]);
  if (degree < 3) return;
  F xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
  gx = gx - 6 * kC3a * (xy * w[9]) + kC3b * (yz * w[10]) + 2 * kC3c * (xy * w[11]) - 6 * kC3d * (xz * w[12]) -
       kC3c * ((4.0f * zz - 3.0f * xx - yy) * w[13]) + 2 * kC3e * (xz * w[14]) - 3 * kC3a * ((xx - yy) * w[15]);
  gy = gy - 3 * kC3a * ((xx - yy) * w[9]) + kC3b * (xz * w[10]) - kC3c * ((4.0f * zz - xx - 3.0f * yy) * w[11]) -
       6 * kC3d * (yz * w[12]) + 2 * kC3c * (xy * w[13]) - 2 * kC3e * (yz * w[14]) + 6 * kC3a * (xy * w[15]);
  gz = gz + kC3b * (xy * w[10]) - 8 * kC3c * (yz * w[11]) + kC3d * ((6.0f * zz - 3.0f * (xx + yy)) * w[12]) -
       8 * kC3c * (xz * w[13]) + kC3e * ((xx - yy) * w[14]);
}

}  // namespace aomgen::AOMGEN_ISA
