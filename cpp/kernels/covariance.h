// The image covariance of a group of Gaussians: shared by the projection and its backward pass.
#pragma once

#include "declarations.h"

namespace aomgen::AOMGEN_ISA {

constexpr float kLog2E = 1.44269504f;

// Parameters of as many Gaussians as there are lanes, with real scales and opacities.
struct Group {
  F mean[3], quat[4], scale[3], opacity;
};

// A logit's opacity, and a logarithm's scale.
AOMGEN_INLINE F decoded_opacity(F logit) { return 1.0f / (1.0f + exp2(-kLog2E * logit)); }
AOMGEN_INLINE F decoded_scale(F logarithm) { return exp2(kLog2E * logarithm); }

AOMGEN_INLINE Group load_group(const AomgenScene& scene, const int32_t index[kLanes]) {
  float columns[11][kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const size_t i = static_cast<size_t>(index[lane]);
    for (int k = 0; k < 3; ++k) columns[k][lane] = scene.means[3 * i + k];
    for (int k = 0; k < 4; ++k) columns[3 + k][lane] = scene.quats[4 * i + k];
    for (int k = 0; k < 3; ++k) columns[7 + k][lane] = scene.scales[3 * i + k];
    columns[10][lane] = scene.opacities[i];
  }
  Group g;
  for (int k = 0; k < 3; ++k) g.mean[k] = load(columns[k]);
  for (int k = 0; k < 4; ++k) g.quat[k] = load(columns[3 + k]);
  for (int k = 0; k < 3; ++k) g.scale[k] = load(columns[7 + k]);
  g.opacity = load(columns[10]);
  if (!scene.encoded) return g;
  for (int k = 0; k < 3; ++k) g.scale[k] = decoded_scale(g.scale[k]);
  g.opacity = decoded_opacity(g.opacity);
  return g;
}

// The transform of each lane's part: V (3, 4) row-major, and the camera's centre in the part's frame.
struct Pose {
  F V[12], center[3];
};

AOMGEN_INLINE Pose pose_of_all(const PartPose& part) {
  Pose pose;
  for (int i = 0; i < 12; ++i) pose.V[i] = all(part.cam_from_part[i]);
  for (int i = 0; i < 3; ++i) pose.center[i] = all(part.center[i]);
  return pose;
}

AOMGEN_INLINE Pose load_pose(const Projection& p, const int32_t index[kLanes]) {
  const int32_t* parts = p.scene.parts;
  int32_t part[kLanes];
  bool one = true;
  for (int lane = 0; lane < kLanes; ++lane) {
    part[lane] = parts ? parts[index[lane]] : 0;
    one &= part[lane] == part[0];
  }
  if (one) return pose_of_all(p.poses[part[0]]);
  static_assert(sizeof(PartPose) == 64, "sixteen floats");
  F columns[16];
  load_columns(p.poses[0].cam_from_part, 16, 16, part, ~0u, columns);
  Pose pose;
  for (int i = 0; i < 12; ++i) pose.V[i] = columns[i];
  for (int i = 0; i < 3; ++i) pose.center[i] = columns[12 + i];
  return pose;
}

AOMGEN_INLINE void center_in_camera(const Pose& pose, const F mean[3], F cam[3]) {
  const F* V = pose.V;
  for (int i = 0; i < 3; ++i) cam[i] = fma(V[4 * i], mean[0], fma(V[4 * i + 1], mean[1], fma(V[4 * i + 2], mean[2], V[4 * i + 3])));
}

// Everything between a Gaussian and its ellipse on the image, row-major matrices.
struct ImageCovariance {
  F cam[3];               // centre, camera frame
  F inverse_depth;
  F quat[4], inverse_norm;  // normalised quaternion
  F R[9];                 // rotation of the Gaussian
  F slope_x, slope_y;     // x/z and y/z, limited to a little more than the image
  F free_x, free_y;       // 1 where that limit did not act
  F T[6];                 // (2, 3) Jacobian of the projection times the camera's rotation
  F TR[6];                // T R
  F P[6];                 // T R diag(scale): covariance = P P^T
  F xx, xy, yy;           // covariance [px^2], without dilation
  F area;                 // determinant of the covariance
  F determinant;          // of the dilated covariance
};

// Source: Zwicker et al., "EWA volume splatting", 2001; limits as in 3DGS (Kerbl et al. 2023), dilation as
// in Mip-Splatting (Yu et al. 2024).
AOMGEN_INLINE ImageCovariance image_covariance(const Group& g, const Pose& pose, const AomgenView& view) {
  ImageCovariance c;
  const F* V = pose.V;
  center_in_camera(pose, g.mean, c.cam);
  F safe_depth = where(above(c.cam[2], all(view.near_depth)), c.cam[2], all(1e10f));
  c.inverse_depth = 1.0f / safe_depth;

  F norm2 = g.quat[0] * g.quat[0] + g.quat[1] * g.quat[1] + g.quat[2] * g.quat[2] + g.quat[3] * g.quat[3];
  c.inverse_norm = 1.0f / square_root(norm2 + 1e-20f);
  for (int i = 0; i < 4; ++i) c.quat[i] = g.quat[i] * c.inverse_norm;
  F w = c.quat[0], x = c.quat[1], y = c.quat[2], z = c.quat[3];
  c.R[0] = 1.0f - 2.0f * (y * y + z * z);
  c.R[1] = 2.0f * (x * y - w * z);
  c.R[2] = 2.0f * (x * z + w * y);
  c.R[3] = 2.0f * (x * y + w * z);
  c.R[4] = 1.0f - 2.0f * (x * x + z * z);
  c.R[5] = 2.0f * (y * z - w * x);
  c.R[6] = 2.0f * (x * z - w * y);
  c.R[7] = 2.0f * (y * z + w * x);
  c.R[8] = 1.0f - 2.0f * (x * x + y * y);

  const float margin_x = 0.15f * view.width / view.fx, margin_y = 0.15f * view.height / view.fy;
  F slope_x = c.cam[0] * c.inverse_depth, slope_y = c.cam[1] * c.inverse_depth;
  c.slope_x = clamp(slope_x, all(-view.cx / view.fx - margin_x), all((view.width - view.cx) / view.fx + margin_x));
  c.slope_y = clamp(slope_y, all(-view.cy / view.fy - margin_y), all((view.height - view.cy) / view.fy + margin_y));
  c.free_x = where(same(c.slope_x, slope_x), all(1.0f));
  c.free_y = where(same(c.slope_y, slope_y), all(1.0f));

  F J00 = view.fx * c.inverse_depth, J02 = -(J00 * c.slope_x);
  F J11 = view.fy * c.inverse_depth, J12 = -(J11 * c.slope_y);
  for (int k = 0; k < 3; ++k) {
    c.T[k] = fma(J00, V[k], J02 * V[8 + k]);
    c.T[3 + k] = fma(J11, V[4 + k], J12 * V[8 + k]);
  }
  for (int row = 0; row < 2; ++row)
    for (int k = 0; k < 3; ++k) {
      c.TR[3 * row + k] = c.T[3 * row] * c.R[k] + c.T[3 * row + 1] * c.R[3 + k] + c.T[3 * row + 2] * c.R[6 + k];
      c.P[3 * row + k] = c.TR[3 * row + k] * g.scale[k];
    }
  const F* P = c.P;
  c.xx = P[0] * P[0] + P[1] * P[1] + P[2] * P[2];
  c.xy = P[0] * P[3] + P[1] * P[4] + P[2] * P[5];
  c.yy = P[3] * P[3] + P[4] * P[4] + P[5] * P[5];
  // |p0 x p1|^2 instead of xx yy - xy^2, which loses all digits on thin, large Gaussians.
  F n0 = P[1] * P[5] - P[2] * P[4], n1 = P[2] * P[3] - P[0] * P[5], n2 = P[0] * P[4] - P[1] * P[3];
  c.area = n0 * n0 + n1 * n1 + n2 * n2;
  c.determinant = c.area + kDilation * (c.xx + c.yy) + kDilation * kDilation;
  return c;
}

// Unit direction from the camera to the Gaussians in the frame of their part, and 1 / distance.
AOMGEN_INLINE F view_direction(const Group& g, const Pose& pose, F direction[3]) {
  for (int k = 0; k < 3; ++k) direction[k] = g.mean[k] - pose.center[k];
  F distance2 = direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2];
  F inverse = 1.0f / square_root(distance2 + 1e-20f);
  for (int k = 0; k < 3; ++k) direction[k] = direction[k] * inverse;
  return inverse;
}

}  // namespace aomgen::AOMGEN_ISA
