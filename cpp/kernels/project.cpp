// Gaussians to splats: what is in view, its ellipse and its color.
#include "covariance.h"
#include "harmonics.h"

namespace aomgen::AOMGEN_ISA {

namespace {

constexpr float kLn2 = 0.69314718f;
// Standard deviations at which an opaque Gaussian's alpha falls to 1/255, a little more.
constexpr float kReach = 3.34f;

// Three numbers each of the Gaussians from `first` on; lanes past the end repeat the last one.
AOMGEN_INLINE void load_run(const float* rows, int64_t first, int64_t last, F out[3]) {
  if (first + kLanes <= last) return load_triples(rows + 3 * first, out, LaneNumbers{});
  float padded[3 * kLanes];
  for (int lane = 0; lane < kLanes; ++lane)
    memcpy(padded + 3 * lane, rows + 3 * (first + lane < last ? first + lane : last - 1), 3 * sizeof(float));
  load_triples(padded, out, LaneNumbers{});
}

// Bounds of the image in slopes (x/z, y/z) that no Gaussian's reach crosses while being drawn.
struct Frustum {
  float stretch_x, stretch_y;  // pixels that one unit of size covers at depth 1, at most
};

Frustum frustum_of(const AomgenView& view) {
  const float left = view.cx, right = view.width - view.cx, top = view.cy, bottom = view.height - view.cy;
  const float slope_x = (0.15f * view.width + (left > right ? left : right)) / view.fx;
  const float slope_y = (0.15f * view.height + (top > bottom ? top : bottom)) / view.fy;
  return {view.fx * sqrtf(1.0f + slope_x * slope_x), view.fy * sqrtf(1.0f + slope_y * slope_y)};
}

// Whether a Gaussian may reach the image, from its centre and largest scale alone.
AOMGEN_INLINE M may_be_seen(const Projection& p, const Frustum& frustum, const Pose& pose, const F mean[3], F size) {
  const AomgenView& view = p.view;
  F cam[3];
  center_in_camera(pose, mean, cam);
  M in_front = above(cam[2], all(view.near_depth));
  F inverse_depth = 1.0f / where(in_front, cam[2], all(1e10f));
  // The dilation adds at most its own standard deviation.
  F reach = kReach * size * inverse_depth;
  F reach_x = fma(all(frustum.stretch_x), reach, all(2.0f)), reach_y = fma(all(frustum.stretch_y), reach, all(2.0f));
  F x = fma(view.fx * cam[0], inverse_depth, all(view.cx)), y = fma(view.fy * cam[1], inverse_depth, all(view.cy));
  return in_front & above(x + reach_x, zeros()) & above(all(static_cast<float>(view.width)), x - reach_x) &
         above(y + reach_y, zeros()) & above(all(static_cast<float>(view.height)), y - reach_y);
}

// Writes the Gaussians of [first, last) that may be seen; returns how many.
int find_candidates(const Projection& p, int64_t first, int64_t last, int32_t* candidates) {
  const Frustum frustum = frustum_of(p.view);
  int count = 0;
  for (int64_t start = first; start < last; start += kLanes) {
    const int lanes = last - start < kLanes ? static_cast<int>(last - start) : kLanes;
    int32_t index[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) index[lane] = static_cast<int32_t>(start + (lane < lanes ? lane : lanes - 1));
    F mean[3], scale[3];
    load_run(p.scene.means, start, last, mean);
    load_run(p.scene.scales, start, last, scale);
    if (p.scene.encoded) for (F& side : scale) side = decoded_scale(side);
    F size = maximum(absolute(scale[0]), maximum(absolute(scale[1]), absolute(scale[2])));
    for (uint32_t rest = bits(may_be_seen(p, frustum, load_pose(p, index), mean, size)) & ((1u << lanes) - 1u); rest; rest &= rest - 1)
      candidates[count++] = index[__builtin_ctz(rest)];
  }
  return count;
}

struct Ellipse {
  F x, y, qxx, qxy, qyy, log2_opacity, half_width, half_height;
  M in_view;  // false for whatever is not a finite number
};

Ellipse ellipse_of(const Group& g, const ImageCovariance& c, const AomgenView& view) {
  Ellipse e;
  F xx = c.xx + kDilation, yy = c.yy + kDilation;
  F scaled = 0.5f * kLog2E / c.determinant;
  e.qxx = scaled * yy;
  e.qyy = scaled * xx;
  e.qxy = -2.0f * (scaled * c.xy);
  F opacity = g.opacity;
  if (view.antialiased) opacity = opacity * square_root(c.area / c.determinant);
  e.log2_opacity = log2(maximum(opacity, all(1e-12f)));
  // alpha >= 1/255 inside offset^T covariance^-1 offset <= 2 ln(255 opacity)
  F reach2 = (2.0f * kLn2) * (e.log2_opacity - kMinLog2Alpha);
  F reach = square_root(maximum(reach2, zeros()));
  e.half_width = reach * square_root(xx);
  e.half_height = reach * square_root(yy);
  e.x = fma(all(view.fx), c.cam[0] * c.inverse_depth, all(view.cx));
  e.y = fma(all(view.fy), c.cam[1] * c.inverse_depth, all(view.cy));
  M finite = above(all(1e12f), c.cam[2]) & above(all(1e30f), c.determinant) & above(all(1.0001f), g.opacity);
  M inside = above(e.x + e.half_width, zeros()) & above(all(static_cast<float>(view.width)), e.x - e.half_width) &
             above(e.y + e.half_height, zeros()) & above(all(static_cast<float>(view.height)), e.y - e.half_height);
  e.in_view = finite & inside & above(c.cam[2], all(view.near_depth)) & above(reach2, zeros()) & above(c.determinant, zeros());
  return e;
}

void colors_of(const Projection& p, const Group& g, const Pose& pose, const int32_t index[kLanes], uint32_t wanted, F color[3]) {
  const int degree = p.scene.sh_degree, count = (degree + 1) * (degree + 1);
  F direction[3], basis[16], coefficients[48];
  view_direction(g, pose, direction);
  harmonics(degree, direction[0], direction[1], direction[2], basis);
  load_columns(p.scene.sh, 3 * static_cast<size_t>(p.scene.sh_coefficients), 3 * count, index, wanted, coefficients);
  for (int channel = 0; channel < 3; ++channel) {
    F sum = all(0.5f);
    for (int k = 0; k < count; ++k) sum = fma(basis[k], coefficients[3 * k + channel], sum);
    color[channel] = sum;
  }
}

// Puts given colors in the place of the harmonics' constant term.
void replace_constant(const Projection& p, const int32_t index[kLanes], F color[3]) {
  const int64_t first = p.scene.count - p.colored;
  float lanes[3][kLanes];
  for (int channel = 0; channel < 3; ++channel) store(lanes[channel], color[channel]);
  for (int lane = 0; lane < kLanes; ++lane)
    for (int channel = 0; index[lane] >= first && channel < 3; ++channel) {
      const float constant = 0.5f + kC0 * p.scene.sh[3 * static_cast<size_t>(p.scene.sh_coefficients) * index[lane] + channel];
      lanes[channel][lane] += p.colors[3 * (index[lane] - first) + channel] - constant;
    }
  for (int channel = 0; channel < 3; ++channel) color[channel] = load(lanes[channel]);
}

// First and last of the tiles along one side that an interval reaches, as two 16-bit numbers in each lane.
AOMGEN_INLINE F tile_range(F low, F high, int size) {
  const F last = all(static_cast<float>((size - 1) / kTile));
  // Limited before the conversion, which must not overflow.
  const I first_tile = __builtin_convertvector(clamp(low * (1.0f / kTile), zeros(), last), I);
  const I last_tile = __builtin_convertvector(clamp(high * (1.0f / kTile), zeros(), last), I);
  return (F)(first_tile | last_tile << 16);
}

AOMGEN_INLINE void store_splats(F fields[16], uint32_t visible, const int32_t index[kLanes], Splat* splats, int32_t* gaussians, uint32_t* keys, uint32_t& found) {
  for (int part = 0; part < 16; part += kLanes) transpose(fields + part);
  for (; visible; visible &= visible - 1) {
    const int lane = __builtin_ctz(visible);
    for (int part = 0; part < 16; part += kLanes) store(&splats[found].x + part, fields[part + lane]);
    memcpy(&keys[found], &splats[found].depth, sizeof(uint32_t));
    gaussians[found++] = index[lane];
  }
}

}  // namespace

void project(const Projection& p, int block) {
  const int64_t first = static_cast<int64_t>(block) * kProjectionBlock;
  const int64_t last = first + kProjectionBlock < p.scene.count ? first + kProjectionBlock : p.scene.count;
  int32_t candidates[kProjectionBlock];
  const int count = find_candidates(p, first, last, candidates);
  uint32_t found = 0;
  for (int start = 0; start < count; start += kLanes) {
    const int lanes = count - start < kLanes ? count - start : kLanes;
    int32_t index[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) index[lane] = candidates[start + (lane < lanes ? lane : 0)];
    const Group g = load_group(p.scene, index);
    const Pose pose = load_pose(p, index);
    const ImageCovariance c = image_covariance(g, pose, p.view);
    const Ellipse e = ellipse_of(g, c, p.view);
    uint32_t visible = bits(e.in_view) & ((1u << lanes) - 1u);
    if (!visible) continue;
    F color[3] = {};
    colors_of(p, g, pose, index, visible, color);
    if (p.colors && index[lanes - 1] >= p.scene.count - p.colored) replace_constant(p, index, color);
    const F bright = all(1e4f);
    visible &= bits(above(bright, absolute(color[0])) & above(bright, absolute(color[1])) & above(bright, absolute(color[2])));
    F fields[16] = {e.x, e.y, e.qxx, e.qxy, e.qyy, e.log2_opacity,
                    maximum(color[0], zeros()), maximum(color[1], zeros()), maximum(color[2], zeros()), c.cam[2],
                    -0.5f * e.qxy / e.qyy, -0.5f * e.qxy / e.qxx, zeros(), zeros(),
                    tile_range(e.x - e.half_width, e.x + e.half_width, p.view.width),
                    tile_range(e.y - e.half_height, e.y + e.half_height, p.view.height)};
    store_splats(fields, visible, index, p.splats + first, p.gaussians + first, p.depth_keys + first, found);
  }
  p.visible[block] = found;
}

}  // namespace aomgen::AOMGEN_ISA
