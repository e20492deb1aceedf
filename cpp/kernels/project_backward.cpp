// Gradients by the splats' moments carried back to the Gaussians' own parameters.
#include "covariance.h"
#include "harmonics.h"

namespace aomgen::AOMGEN_ISA {

namespace {

// Sums over all tiles, in the order of the tiles, one lane per Gaussian.
void gather_moments(const ProjectionBackward& b, const uint32_t rank[16], uint32_t lanes, F moments[16]) {
  for (int lane = 0; lane < 16; ++lane) {
    F sum = zeros();
    if (lanes >> lane & 1)
      for (uint32_t slot = b.slot_begin[rank[lane]]; slot < b.slot_begin[rank[lane] + 1]; ++slot)
        sum = sum + load(b.moments + 16 * static_cast<size_t>(slot));
    moments[lane] = sum;
  }
  transpose(moments);
}

struct ScreenGradient {
  F x, y, xx, xy, yy;  // by the centre and the (dilated) covariance
};

// moments[1..5] are about exp(-1/2 offset^T Q offset), Q the inverse covariance.
ScreenGradient screen_gradient(const ImageCovariance& c, const F moments[16]) {
  F inverse = all(1.0f) / c.determinant;
  F qa = (c.yy + all(kDilation)) * inverse, qb = -(c.xy * inverse), qc = (c.xx + all(kDilation)) * inverse;
  F ga = -0.5f * moments[3], gb = -0.5f * moments[4], gc = -0.5f * moments[5];  // by Q, symmetric
  ScreenGradient s;
  s.x = qa * moments[1] + qb * moments[2];
  s.y = qb * moments[1] + qc * moments[2];
  F m00 = ga * qa + gb * qb, m01 = ga * qb + gb * qc, m10 = gb * qa + gc * qb, m11 = gb * qb + gc * qc;
  s.xx = -(qa * m00 + qb * m10);
  s.xy = -2.0f * (qa * m01 + qb * m11);
  s.yy = -(qb * m01 + qc * m11);
  return s;
}

struct Results {
  F mean[3], quat[4], scale[3], opacity;
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

// by_T: by the (2, 3) matrix T = J V. Adds to the gradient by the centre in the camera frame.
void center_gradient(const ImageCovariance& c, const AomgenView& view, const ScreenGradient& s, const F by_T[6], F by_depth, F by_cam[3]) {
  const float* V = view.world_to_cam;
  F J00 = zeros(), J02 = zeros(), J11 = zeros(), J12 = zeros();
  for (int k = 0; k < 3; ++k) {
    J00 = J00 + V[k] * by_T[k];
    J02 = J02 + V[8 + k] * by_T[k];
    J11 = J11 + V[4 + k] * by_T[3 + k];
    J12 = J12 + V[8 + k] * by_T[3 + k];
  }
  F iz = c.inverse_depth, fx = view.fx * iz, fy = view.fy * iz, one = all(1.0f);
  F slope_x = c.cam[0] * iz, slope_y = c.cam[1] * iz;
  by_cam[0] = fx * (s.x - c.free_x * iz * J02);
  by_cam[1] = fy * (s.y - c.free_y * iz * J12);
  by_cam[2] = by_depth - fx * (slope_x * s.x + iz * J00 - iz * c.slope_x * J02 * (one + c.free_x)) -
              fy * (slope_y * s.y + iz * J11 - iz * c.slope_y * J12 * (one + c.free_y));
}

Results shape_gradient(const ProjectionBackward& b, const Sixteen& g, const F moments[16]) {
  const AomgenView& view = b.forward.view;
  const ImageCovariance c = image_covariance(g, view);
  const ScreenGradient s = screen_gradient(c, moments);
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
  center_gradient(c, view, s, by_T, moments[9], by_cam);
  const float* V = view.world_to_cam;
  for (int k = 0; k < 3; ++k) out.mean[k] = V[k] * by_cam[0] + V[4 + k] * by_cam[1] + V[8 + k] * by_cam[2];
  out.opacity = moments[0] / greater(g.opacity, all(1e-12f));
  return out;
}

// Writes the gradients by the coefficients of the wanted lanes and adds the view direction's part
// to the gradient by the mean.
void color_gradient(const ProjectionBackward& b, const Sixteen& g, const int32_t index[16], uint32_t wanted,
                    const F by_color[3], F by_mean[3]) {
  const AomgenScene& scene = b.forward.scene;
  const int degree = scene.sh_degree, count = (degree + 1) * (degree + 1);
  const size_t stride = 3 * static_cast<size_t>(scene.sh_coefficients);
  F d[3], basis[16], coefficients[48], weights[16];
  F inverse_distance = view_direction(g, b.forward.cam_center, d);
  harmonics(degree, d[0], d[1], d[2], basis);
  if (degree > 0) {
    load_coefficients(scene.sh, stride, 3 * count, index, wanted, coefficients);
    for (int k = 1; k < count; ++k)
      weights[k] = coefficients[3 * k] * by_color[0] + coefficients[3 * k + 1] * by_color[1] + coefficients[3 * k + 2] * by_color[2];
    F by_d[3];
    harmonics_gradient(degree, d[0], d[1], d[2], weights, by_d[0], by_d[1], by_d[2]);
    F along = by_d[0] * d[0] + by_d[1] * d[1] + by_d[2] * d[2];
    for (int k = 0; k < 3; ++k) by_mean[k] = by_mean[k] + (by_d[k] - along * d[k]) * inverse_distance;
  }
  for (int part = 0; part < 3 * count; part += 16) {
    F rows[16];
    for (int i = 0; i < 16; ++i) rows[i] = part + i < 3 * count ? basis[(part + i) / 3] * by_color[(part + i) % 3] : zeros();
    transpose(rows);
    const int width = 3 * count - part < 16 ? 3 * count - part : 16;
    for (uint32_t rest = wanted; rest; rest &= rest - 1) {
      const int lane = __builtin_ctz(rest);
      store_first(b.gradients.sh + stride * static_cast<size_t>(index[lane]) + part, rows[lane], width);
    }
  }
}

void store_results(const ProjectionBackward& b, const Results& r, const int32_t index[16], uint32_t wanted) {
  F rows[16] = {r.mean[0], r.mean[1], r.mean[2], r.quat[0], r.quat[1], r.quat[2], r.quat[3],
                r.scale[0], r.scale[1], r.scale[2], r.opacity, zeros(), zeros(), zeros(), zeros(), zeros()};
  transpose(rows);
  for (; wanted; wanted &= wanted - 1) {
    const int lane = __builtin_ctz(wanted);
    const size_t i = static_cast<size_t>(index[lane]);
    float row[16];
    store(row, rows[lane]);
    memcpy(b.gradients.means + 3 * i, row, 3 * sizeof(float));
    memcpy(b.gradients.quats + 4 * i, row + 3, 4 * sizeof(float));
    memcpy(b.gradients.scales + 3 * i, row + 7, 3 * sizeof(float));
    b.gradients.opacities[i] = row[10];
  }
}

void clear_block(const ProjectionBackward& b, int64_t first, int64_t last) {
  const size_t count = static_cast<size_t>(last - first), stride = 3 * static_cast<size_t>(b.forward.scene.sh_coefficients);
  memset(b.gradients.means + 3 * first, 0, 3 * count * sizeof(float));
  memset(b.gradients.quats + 4 * first, 0, 4 * count * sizeof(float));
  memset(b.gradients.scales + 3 * first, 0, 3 * count * sizeof(float));
  memset(b.gradients.opacities + first, 0, count * sizeof(float));
  memset(b.gradients.sh + stride * static_cast<size_t>(first), 0, stride * count * sizeof(float));
}

}  // namespace

void project_backward(const ProjectionBackward& b, int block) {
  const int64_t first = static_cast<int64_t>(block) * kProjectionBlock, count = b.forward.scene.count;
  clear_block(b, first, first + kProjectionBlock < count ? first + kProjectionBlock : count);
  const uint32_t end = b.block_begin[block + 1];
  for (uint32_t place = b.block_begin[block]; place < end; place += 16) {
    const int lanes = end - place < 16 ? static_cast<int>(end - place) : 16;
    const uint32_t wanted = (1u << lanes) - 1u;
    int32_t index[16];
    uint32_t rank[16];
    float drawn[3][16];
    for (int lane = 0; lane < 16; ++lane) {
      const uint32_t at = place + (lane < lanes ? lane : 0);
      index[lane] = b.gaussians[at];
      rank[lane] = b.ranks[at];
      const Splat& s = b.splats[rank[lane]];
      drawn[0][lane] = s.red;
      drawn[1][lane] = s.green;
      drawn[2][lane] = s.blue;
    }
    F moments[16], by_color[3];
    gather_moments(b, rank, wanted, moments);
    for (int c = 0; c < 3; ++c) by_color[c] = where(load(drawn[c]) > zeros(), moments[6 + c]);  // colors are cut at 0
    const Sixteen g = load_sixteen(b.forward.scene, index);
    Results results = shape_gradient(b, g, moments);
    color_gradient(b, g, index, wanted, by_color, results.mean);
    store_results(b, results, index, wanted);
  }
}

}  // namespace aomgen::AOMGEN_ISA
