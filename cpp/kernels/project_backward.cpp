// Gradients by the splats' moments carried back to the Gaussians' own parameters and to the poses.
#include "covariance.h"
#include "harmonics.h"

namespace aomgen::AOMGEN_ISA {

namespace {

// Up to kLanes Gaussians of a block: where they are, and which lanes are filled.
struct Members {
  int32_t index[kLanes];   // in the scene
  uint32_t slot[kLanes];
  size_t row[kLanes];      // where their gradients go
  uint32_t wanted;
};

// Sums over all tiles, in a fixed order, one lane per Gaussian; columns up to 16.
void gather_moments(const ProjectionBackward& b, const Members& m, F moments[16]) {
  for (int lane = 0; lane < kLanes; ++lane) {
    F sums[kParts] = {};
    if (m.wanted >> lane & 1) {
      const uint32_t* entry = b.entries.entries + b.entries.begin[m.slot[lane]];
      for (uint32_t left = b.entries.count[m.slot[lane]]; left; --left, ++entry)
        for (int part = 0; part < kParts; ++part)
          sums[part] = sums[part] + load(b.moments + 16 * static_cast<size_t>(*entry) + part * kLanes);
    }
    for (int part = 0; part < kParts; ++part) moments[part * kLanes + lane] = sums[part];
  }
  for (int part = 0; part < kParts; ++part) transpose(moments + part * kLanes);
}

void prefetch_moments(const ProjectionBackward& b, uint32_t first_slot, uint32_t end_slot, uint32_t last_slot) {
  for (uint32_t slot = first_slot; slot < end_slot && slot < last_slot; ++slot) {
    const uint32_t* entry = b.entries.entries + b.entries.begin[slot];
    for (uint32_t left = b.entries.count[slot] < 8 ? b.entries.count[slot] : 8; left; --left, ++entry)
      __builtin_prefetch(b.moments + 16 * static_cast<size_t>(*entry));
  }
}

struct ScreenGradient {
  F x, y, xx, xy, yy;  // by the centre and the (dilated) covariance
};

// moments[1..5] are about exp(-1/2 offset^T Q offset), Q the inverse covariance.
ScreenGradient screen_gradient(const ImageCovariance& c, const F moments[16], bool antialiased) {
  F inverse = 1.0f / c.determinant;
  F xx = c.xx + kDilation, yy = c.yy + kDilation;
  F qa = yy * inverse, qb = -(c.xy * inverse), qc = xx * inverse;
  F ga = -0.5f * moments[3], gb = -0.5f * moments[4], gc = -0.5f * moments[5];  // by Q, symmetric
  ScreenGradient s;
  s.x = qa * moments[1] + qb * moments[2];
  s.y = qb * moments[1] + qc * moments[2];
  F m00 = ga * qa + gb * qb, m01 = ga * qb + gb * qc, m10 = gb * qa + gc * qb, m11 = gb * qb + gc * qc;
  s.xx = -(qa * m00 + qb * m10);
  s.xy = -2.0f * (qa * m01 + qb * m11);
  s.yy = -(qb * m01 + qc * m11);
  if (antialiased) {  // opacity is multiplied by sqrt(area / determinant)
    F by_log = 0.5f * moments[0], by_area = by_log / maximum(c.area, all(1e-30f)), by_determinant = by_log * inverse;
    s.xx = s.xx + by_area * c.yy - by_determinant * yy;
    s.yy = s.yy + by_area * c.xx - by_determinant * xx;
    s.xy = s.xy - 2.0f * c.xy * (by_area - by_determinant);
  }
  return s;
}

struct Results {
  F mean[3], quat[4], scale[3], opacity;
  F V[12], center[3];  // by the pose
};

void quaternion_gradient(const ImageCovariance& c, const F r[9], F out[4]) {  // r: by the rotation matrix
  F w = c.quat[0], x = c.quat[1], y = c.quat[2], z = c.quat[3];
  F by_w = 2.0f * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1]));
  F by_x = 2.0f * (y * (r[3] + r[1]) + z * (r[6] + r[2]) + w * (r[7] - r[5]) - 2.0f * (x * (r[4] + r[8])));
  F by_y = 2.0f * (x * (r[3] + r[1]) + z * (r[7] + r[5]) + w * (r[2] - r[6]) - 2.0f * (y * (r[0] + r[8])));
  F by_z = 2.0f * (x * (r[6] + r[2]) + y * (r[7] + r[5]) + w * (r[3] - r[1]) - 2.0f * (z * (r[0] + r[4])));
  F along = by_w * w + by_x * x + by_y * y + by_z * z;  // the normalisation takes this part away
  out[0] = (by_w - along * w) * c.inverse_norm;
  out[1] = (by_x - along * x) * c.inverse_norm;
  out[2] = (by_y - along * y) * c.inverse_norm;
  out[3] = (by_z - along * z) * c.inverse_norm;
}

// By the centre in the camera frame. by_T: by the (2, 3) matrix T = J V.
void center_gradient(const ImageCovariance& c, const Pose& pose, const AomgenView& view, const ScreenGradient& s, const F by_T[6], F by_depth, F by_cam[3]) {
  const F* V = pose.V;
  F J00 = zeros(), J02 = zeros(), J11 = zeros(), J12 = zeros();
  for (int k = 0; k < 3; ++k) {
    J00 = J00 + V[k] * by_T[k];
    J02 = J02 + V[8 + k] * by_T[k];
    J11 = J11 + V[4 + k] * by_T[3 + k];
    J12 = J12 + V[8 + k] * by_T[3 + k];
  }
  F iz = c.inverse_depth, fx = view.fx * iz, fy = view.fy * iz;
  F slope_x = c.cam[0] * iz, slope_y = c.cam[1] * iz;
  by_cam[0] = fx * (s.x - c.free_x * iz * J02);
  by_cam[1] = fy * (s.y - c.free_y * iz * J12);
  by_cam[2] = by_depth - fx * (slope_x * s.x + iz * J00 - iz * c.slope_x * J02 * (1.0f + c.free_x)) -
              fy * (slope_y * s.y + iz * J11 - iz * c.slope_y * J12 * (1.0f + c.free_y));
}

// cam = V (mean, 1) and T = J V: what the pose does through the centre and through the covariance.
void pose_gradient(const Group& g, const ImageCovariance& c, const AomgenView& view, const F by_cam[3], const F by_T[6], F by_V[12]) {
  F J00 = view.fx * c.inverse_depth, J02 = -(J00 * c.slope_x), J11 = view.fy * c.inverse_depth, J12 = -(J11 * c.slope_y);
  for (int k = 0; k < 3; ++k) {
    by_V[k] = by_cam[0] * g.mean[k] + J00 * by_T[k];
    by_V[4 + k] = by_cam[1] * g.mean[k] + J11 * by_T[3 + k];
    by_V[8 + k] = by_cam[2] * g.mean[k] + J02 * by_T[k] + J12 * by_T[3 + k];
    by_V[4 * k + 3] = by_cam[k];
  }
}

Results shape_gradient(const ProjectionBackward& b, const Group& g, const Pose& pose, const F moments[16]) {
  const AomgenView& view = b.forward.view;
  const ImageCovariance c = image_covariance(g, pose, view);
  const ScreenGradient s = screen_gradient(c, moments, view.antialiased);
  F by_P[6], by_TR[6], by_R[9], by_T[6];
  Results out;
  for (int k = 0; k < 3; ++k) {
    by_P[k] = 2.0f * (s.xx * c.P[k]) + s.xy * c.P[3 + k];
    by_P[3 + k] = 2.0f * (s.yy * c.P[3 + k]) + s.xy * c.P[k];
    out.scale[k] = by_P[k] * c.TR[k] + by_P[3 + k] * c.TR[3 + k];
    by_TR[k] = by_P[k] * g.scale[k];
    by_TR[3 + k] = by_P[3 + k] * g.scale[k];
  }
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) by_R[3 * i + k] = c.T[i] * by_TR[k] + c.T[3 + i] * by_TR[3 + k];
  for (int row = 0; row < 2; ++row)
    for (int i = 0; i < 3; ++i)
      by_T[3 * row + i] = by_TR[3 * row] * c.R[3 * i] + by_TR[3 * row + 1] * c.R[3 * i + 1] + by_TR[3 * row + 2] * c.R[3 * i + 2];
  quaternion_gradient(c, by_R, out.quat);
  F by_cam[3];
  center_gradient(c, pose, view, s, by_T, moments[9], by_cam);
  for (int k = 0; k < 3; ++k) out.mean[k] = pose.V[k] * by_cam[0] + pose.V[4 + k] * by_cam[1] + pose.V[8 + k] * by_cam[2];
  if (b.pose_sums) pose_gradient(g, c, view, by_cam, by_T, out.V);
  out.opacity = b.forward.scene.encoded ? moments[0] * (1.0f - g.opacity) : moments[0] / maximum(g.opacity, all(1e-12f));
  if (b.forward.scene.encoded)
    for (int k = 0; k < 3; ++k) out.scale[k] = out.scale[k] * g.scale[k];
  return out;
}

// Writes the gradients by the coefficients and adds the view direction's part to the gradients by the
// mean and by the camera's centre.
void color_gradient(const ProjectionBackward& b, const Group& g, const Pose& pose, const Members& m, const F by_color[3], Results& out) {
  const AomgenScene& scene = b.forward.scene;
  const int degree = scene.sh_degree, count = (degree + 1) * (degree + 1);
  const size_t stride = 3 * static_cast<size_t>(scene.sh_coefficients);
  F d[3], basis[16], coefficients[48], weights[16];
  F inverse_distance = view_direction(g, pose, d);
  harmonics(degree, d[0], d[1], d[2], basis);
  for (int k = 0; k < 3; ++k) out.center[k] = zeros();
  if (degree > 0) {
    load_columns(scene.sh, stride, 3 * count, m.index, m.wanted, coefficients);
    for (int k = 1; k < count; ++k)
      weights[k] = coefficients[3 * k] * by_color[0] + coefficients[3 * k + 1] * by_color[1] + coefficients[3 * k + 2] * by_color[2];
    F by_d[3];
    harmonics_gradient(degree, d[0], d[1], d[2], weights, by_d[0], by_d[1], by_d[2]);
    F along = by_d[0] * d[0] + by_d[1] * d[1] + by_d[2] * d[2];
    for (int k = 0; k < 3; ++k) {
      F by_offset = (by_d[k] - along * d[k]) * inverse_distance;
      out.mean[k] = out.mean[k] + by_offset;
      out.center[k] = -by_offset;
    }
  }
  for (int part = 0; part < 3 * count; part += kLanes) {
    F rows[kLanes];
    for (int i = 0; i < kLanes; ++i) rows[i] = part + i < 3 * count ? basis[(part + i) / 3] * by_color[(part + i) % 3] : zeros();
    transpose(rows);
    const int width = 3 * count - part < kLanes ? 3 * count - part : kLanes;
    for (uint32_t rest = m.wanted; rest; rest &= rest - 1) {
      const int lane = __builtin_ctz(rest);
      float* to = b.gradients.sh + stride * m.row[lane] + part;
      if (width == kLanes) store(to, rows[lane]);
      else store_first(to, rows[lane], width);
    }
  }
  if (3 * static_cast<size_t>(count) == stride || !b.gradients.rows) return;  // dense rows are zero already
  for (uint32_t rest = m.wanted; rest; rest &= rest - 1)
    memset(b.gradients.sh + stride * m.row[__builtin_ctz(rest)] + 3 * count, 0, (stride - 3 * count) * sizeof(float));
}

void store_results(const ProjectionBackward& b, const Results& r, const Members& m) {
  F rows[16] = {r.mean[0], r.mean[1], r.mean[2], r.quat[0], r.quat[1], r.quat[2], r.quat[3],
                r.scale[0], r.scale[1], r.scale[2], r.opacity, zeros(), zeros(), zeros(), zeros(), zeros()};
  for (int part = 0; part < kParts; ++part) transpose(rows + part * kLanes);
  for (uint32_t rest = m.wanted; rest; rest &= rest - 1) {
    const int lane = __builtin_ctz(rest);
    const size_t i = m.row[lane];
    float row[16];
    for (int part = 0; part < kParts; ++part) store(row + part * kLanes, rows[part * kLanes + lane]);
    memcpy(b.gradients.means + 3 * i, row, 3 * sizeof(float));
    memcpy(b.gradients.quats + 4 * i, row + 3, 4 * sizeof(float));
    memcpy(b.gradients.scales + 3 * i, row + 7, 3 * sizeof(float));
    b.gradients.opacities[i] = row[10];
    if (b.gradients.rows) b.gradients.rows[i] = m.index[lane];
  }
}

// Adds every lane's gradient by the pose to the sums of its part.
void add_pose_gradients(const ProjectionBackward& b, const Results& r, const Members& m, float* sums) {
  F rows[16];
  for (int k = 0; k < 12; ++k) rows[k] = r.V[k];
  for (int k = 0; k < 3; ++k) rows[12 + k] = r.center[k];
  rows[15] = zeros();
  for (int part = 0; part < kParts; ++part) transpose(rows + part * kLanes);
  for (uint32_t rest = m.wanted; rest; rest &= rest - 1) {
    const int lane = __builtin_ctz(rest);
    float* to = sums + 16 * static_cast<size_t>(b.forward.scene.parts ? b.forward.scene.parts[m.index[lane]] : 0);
    for (int part = 0; part < kParts; ++part) store(to + part * kLanes, load(to + part * kLanes) + rows[part * kLanes + lane]);
  }
}

void store_feature_gradients(const ProjectionBackward& b, const Members& m) {
  const size_t count = b.forward.scene.feature_count;
  for (uint32_t rest = m.wanted; rest; rest &= rest - 1) {
    const int lane = __builtin_ctz(rest);
    float* to = b.gradients.features + count * m.row[lane];
    memset(to, 0, count * sizeof(float));
    const uint32_t* entry = b.entries.entries + b.entries.begin[m.slot[lane]];
    for (uint32_t left = b.entries.count[m.slot[lane]]; left; --left, ++entry)
      for (size_t d = 0; d < count; ++d) to[d] += b.feature_moments[count * *entry + d];
  }
}

void clear_block(const ProjectionBackward& b, int64_t first, int64_t last) {
  const AomgenScene& scene = b.forward.scene;
  const size_t count = static_cast<size_t>(last - first), stride = 3 * static_cast<size_t>(scene.sh_coefficients), features = scene.feature_count;
  memset(b.gradients.means + 3 * first, 0, 3 * count * sizeof(float));
  memset(b.gradients.quats + 4 * first, 0, 4 * count * sizeof(float));
  memset(b.gradients.scales + 3 * first, 0, 3 * count * sizeof(float));
  memset(b.gradients.opacities + first, 0, count * sizeof(float));
  memset(b.gradients.sh + stride * static_cast<size_t>(first), 0, stride * count * sizeof(float));
  if (b.gradients.features) memset(b.gradients.features + features * static_cast<size_t>(first), 0, features * count * sizeof(float));
}

Members members_of(const ProjectionBackward& b, int block, uint32_t start, uint32_t count) {
  const uint32_t first_slot = static_cast<uint32_t>(block) * kProjectionBlock;
  const uint32_t lanes = count - start < kLanes ? count - start : kLanes;
  Members m;
  m.wanted = (1u << lanes) - 1u;
  for (uint32_t lane = 0; lane < kLanes; ++lane) {
    const uint32_t i = start + (lane < lanes ? lane : 0);
    m.slot[lane] = first_slot + i;
    m.index[lane] = b.forward.gaussians[first_slot + i];
    m.row[lane] = b.gradients.rows ? b.block_begin[block] + i : static_cast<size_t>(m.index[lane]);
  }
  return m;
}

}  // namespace

void project_backward(const ProjectionBackward& b, int block) {
  const int64_t first = static_cast<int64_t>(block) * kProjectionBlock, end = b.forward.scene.count;
  if (!b.gradients.rows) clear_block(b, first, first + kProjectionBlock < end ? first + kProjectionBlock : end);
  float* pose_sums = nullptr;
  if (b.pose_sums) {
    const size_t floats = 16 * static_cast<size_t>(b.forward.view.part_count);
    pose_sums = b.pose_sums + floats * static_cast<size_t>(block);
    memset(pose_sums, 0, floats * sizeof(float));
  }
  const uint32_t count = b.forward.visible[block];
  for (uint32_t start = 0; start < count; start += kLanes) {
    const Members m = members_of(b, block, start, count);
    prefetch_moments(b, m.slot[0] + kLanes, m.slot[0] + 2 * kLanes, static_cast<uint32_t>(block) * kProjectionBlock + count);
    float drawn[3][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const Splat& s = b.forward.splats[m.slot[lane]];
      drawn[0][lane] = s.red;
      drawn[1][lane] = s.green;
      drawn[2][lane] = s.blue;
    }
    F moments[16], by_color[3];
    gather_moments(b, m, moments);
    for (int c = 0; c < 3; ++c) by_color[c] = where(above(load(drawn[c]), zeros()), moments[6 + c]);  // colors are cut at 0
    const Group g = load_group(b.forward.scene, m.index);
    const Pose pose = load_pose(b.forward, m.index);
    Results results = shape_gradient(b, g, pose, moments);
    color_gradient(b, g, pose, m, by_color, results);
    store_results(b, results, m);
    if (pose_sums) add_pose_gradients(b, results, m, pose_sums);
    if (b.gradients.features) store_feature_gradients(b, m);
  }
}

}  // namespace aomgen::AOMGEN_ISA
