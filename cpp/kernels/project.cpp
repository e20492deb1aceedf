// Gaussians to splats: what is in view, its ellipse and its color.
#include "covariance.h"
#include "harmonics.h"

namespace aomgen::AOMGEN_ISA {

namespace {

constexpr float kLog2E = 1.44269504f, kLn2 = 0.69314718f;

struct Ellipse {
  F x, y, qxx, qxy, qyy, log2_opacity, half_width, half_height;
  M in_view;  // false for whatever is not a finite number
};

Ellipse ellipse_of(const Sixteen& g, const ImageCovariance& c, const AomgenView& view) {
  Ellipse e;
  F xx = c.xx + all(kDilation), yy = c.yy + all(kDilation);
  F scaled = all(0.5f * kLog2E) / c.determinant;
  e.qxx = scaled * yy;
  e.qyy = scaled * xx;
  e.qxy = -2.0f * (scaled * c.xy);
  e.log2_opacity = log2(greater(g.opacity, all(1e-12f)));
  // alpha >= 1/255 inside offset^T covariance^-1 offset <= 2 ln(255 opacity)
  F reach2 = (2.0f * kLn2) * (e.log2_opacity - all(kMinLog2Alpha));
  F reach = square_root(greater(reach2, zeros()));
  e.half_width = reach * square_root(xx);
  e.half_height = reach * square_root(yy);
  e.x = fma(all(view.fx), c.cam[0] * c.inverse_depth, all(view.cx));
  e.y = fma(all(view.fy), c.cam[1] * c.inverse_depth, all(view.cy));
  const F huge = all(1e12f);
  M finite = (huge > c.cam[2]) & (all(1e30f) > c.determinant) & (all(1.0001f) > g.opacity);
  M inside = (e.x + e.half_width > zeros()) & (all(static_cast<float>(view.width)) > e.x - e.half_width) &
             (e.y + e.half_height > zeros()) & (all(static_cast<float>(view.height)) > e.y - e.half_height);
  e.in_view = finite & inside & (c.cam[2] > all(view.near_depth)) & (reach2 > zeros()) & (c.determinant > zeros());
  return e;
}

void colors_of(const Projection& p, const Sixteen& g, const int32_t index[16], uint32_t wanted, F color[3]) {
  const int degree = p.scene.sh_degree, count = (degree + 1) * (degree + 1);
  F direction[3], basis[16], coefficients[48];
  view_direction(g, p.cam_center, direction);
  harmonics(degree, direction[0], direction[1], direction[2], basis);
  load_coefficients(p.scene.sh, 3 * static_cast<size_t>(p.scene.sh_coefficients), 3 * count, index, wanted, coefficients);
  for (int channel = 0; channel < 3; ++channel) {
    F sum = all(0.5f);
    for (int k = 0; k < count; ++k) sum = fma(basis[k], coefficients[3 * k + channel], sum);
    color[channel] = sum;
  }
}

}  // namespace

void project(const Projection& p, int block) {
  const int64_t first = static_cast<int64_t>(block) * kProjectionBlock;
  const int64_t last = first + kProjectionBlock < p.scene.count ? first + kProjectionBlock : p.scene.count;
  Splat* splats = p.splats + first;
  int32_t* gaussians = p.gaussians + first;
  uint32_t* keys = p.depth_keys + first;
  uint32_t found = 0;
  for (int64_t start = first; start < last; start += 16) {
    const int lanes = last - start < 16 ? static_cast<int>(last - start) : 16;
    int32_t index[16];
    for (int lane = 0; lane < 16; ++lane) index[lane] = static_cast<int32_t>(start + (lane < lanes ? lane : 0));
    const Sixteen g = load_sixteen(p.scene, index);
    const ImageCovariance c = image_covariance(g, p.view);
    const Ellipse e = ellipse_of(g, c, p.view);
    uint32_t visible = bits(e.in_view) & ((1u << lanes) - 1u);
    if (!visible) continue;
    F color[3];
    colors_of(p, g, index, visible, color);
    const F bright = all(1e4f);
    visible &= bits((bright > absolute(color[0])) & (bright > absolute(color[1])) & (bright > absolute(color[2])));
    F rows[16] = {e.x, e.y, e.qxx, e.qxy, e.qyy, e.log2_opacity,
                  greater(color[0], zeros()), greater(color[1], zeros()), greater(color[2], zeros()), c.cam[2],
                  all(-0.5f) * e.qxy / e.qyy, all(-0.5f) * e.qxy / e.qxx, e.half_width, e.half_height, g.opacity, zeros()};
    transpose(rows);
    for (; visible; visible &= visible - 1) {
      const int lane = __builtin_ctz(visible);
      store(&splats[found].x, rows[lane]);
      memcpy(&keys[found], &splats[found].depth, sizeof(uint32_t));
      gaussians[found++] = index[lane];
    }
  }
  p.visible[block] = found;
}

}  // namespace aomgen::AOMGEN_ISA
