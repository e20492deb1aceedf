// Gradients of one tile by the parameters of its splats, front to back.
//
// With C = sum_i w_i c_i and w_i = a_i prod_{j<i} (1 - a_j), the derivative of L by a_i is
// T_i (c_i . dL) - (sum_{j>i} w_j c_j . dL) / (1 - a_i). The sum behind splat i is what was drawn in
// total minus what was drawn up to i, so the pass runs in the order of the forward pass, stops as
// early, and keeps no list per pixel.
//
// A splat's log2 alpha is quadratic in the offset (dx, dy), so all its gradients follow from six
// moments of g = alpha dL/dalpha over the tile's pixels, and four color and depth sums:
//   0: g  1: g dx  2: g dy  3: g dx^2  4: g dx dy  5: g dy^2  6-8: w dL/drgb  9: w dL/ddepth
#include "tile.h"

namespace aomgen::AOMGEN_ISA {

namespace {

struct alignas(64) Incoming {
  float red[16][16], green[16][16], blue[16][16], depth[16][16];  // dL by the pixel's sums
  float behind[16][16];         // dL-weighted sum of everything not drawn yet
  float transmittance[16][16];
};

void load_incoming(const BlendBackward& b, int left, int top, Incoming& in) {
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  alignas(64) float drawn[4][16][16], alpha_gradient[16][16] = {}, rest[16][16];
  load_tile(b.images.grad_rgb, left, top, b.view, in.red);
  load_tile(b.images.grad_rgb + plane, left, top, b.view, in.green);
  load_tile(b.images.grad_rgb + 2 * plane, left, top, b.view, in.blue);
  for (int channel = 0; channel < 3; ++channel) load_tile(b.images.rgb + channel * plane, left, top, b.view, drawn[channel]);
  load_tile(b.images.depth, left, top, b.view, drawn[3]);
  load_tile(b.transmittance, left, top, b.view, rest);
  if (b.images.grad_depth) load_tile(b.images.grad_depth, left, top, b.view, in.depth);
  else memset(in.depth, 0, sizeof(in.depth));
  if (b.images.grad_alpha) load_tile(b.images.grad_alpha, left, top, b.view, alpha_gradient);
  for (int block = 0; block < 16; ++block) {
    F sum = load(drawn[0][block]) * load(in.red[block]) + load(drawn[1][block]) * load(in.green[block]) +
            load(drawn[2][block]) * load(in.blue[block]) + load(drawn[3][block]) * load(in.depth[block]);
    store(in.behind[block], sum - load(rest[block]) * load(alpha_gradient[block]));
    store(in.transmittance[block], all(1.0f));
  }
}

struct Parameters {
  F x, y, qxx, qxy, qyy, log2_opacity, red, green, blue, depth;
};

Parameters spread(const Splat& s, float left, float top) {
  return {all(s.x - left), all(s.y - top), all(s.qxx), all(s.qxy), all(s.qyy), all(s.log2_opacity),
          all(s.red), all(s.green), all(s.blue), all(s.depth)};
}

// Adds the block's part to the moments; returns whether the block still lets light through.
AOMGEN_INLINE bool add_block(const Parameters& p, Incoming& in, int block, F moments[kMoments]) {
  F dx = load(kTileGeometry.x[block]) - p.x, dy = load(kTileGeometry.y[block]) - p.y;
  F e = log2_alpha(dx, dy, p.qxx, p.qxy, p.qyy, p.log2_opacity);
  F before = load(in.transmittance[block]);
  M drawn = (e > all(kMinLog2Alpha)) & (before > all(kMinTransmittance));
  F unclamped = exp2(e);
  F alpha = where(drawn, lesser(unclamped, all(kMaxAlpha)));
  F weight = alpha * before, after = fnma(alpha, before, before);
  store(in.transmittance[block], after);
  F red = load(in.red[block]), green = load(in.green[block]), blue = load(in.blue[block]), depth = load(in.depth[block]);
  F own = fma(p.red, red, fma(p.green, green, fma(p.blue, blue, p.depth * depth)));
  F behind = fnma(weight, own, load(in.behind[block]));
  store(in.behind[block], behind);
  F by_alpha = before * own - behind * reciprocal(all(1.0f) - alpha);
  F g = where(all(kMaxAlpha) > unclamped, alpha) * by_alpha;
  F gx = g * dx, gy = g * dy;
  moments[0] = moments[0] + g;
  moments[1] = moments[1] + gx;
  moments[2] = moments[2] + gy;
  moments[3] = fma(gx, dx, moments[3]);
  moments[4] = fma(gx, dy, moments[4]);
  moments[5] = fma(gy, dy, moments[5]);
  moments[6] = fma(weight, red, moments[6]);
  moments[7] = fma(weight, green, moments[7]);
  moments[8] = fma(weight, blue, moments[8]);
  moments[9] = fma(weight, depth, moments[9]);
  return any(after > all(kMinTransmittance));
}

}  // namespace

void blend_backward(const BlendBackward& b, int tile) {
  const int left = tile % b.tiles.columns * kTile, top = tile / b.tiles.columns * kTile;
  Incoming in;
  load_incoming(b, left, top, in);
  uint32_t alive = blocks_on_image(left, top, b.view);
  const uint32_t end = b.tiles.begin[tile + 1];
  for (uint32_t k = b.tiles.begin[tile]; k < end; ++k) {
    float* out = b.moments + 16 * static_cast<size_t>(b.tiles.slots[k]);
    uint32_t touched = alive ? b.block_masks[k] & alive : 0;
    if (!touched) {
      store(out, zeros());
      continue;
    }
    if (k + 8 < end) __builtin_prefetch(&b.splats[b.tiles.splats[k + 8]]);
    const Parameters p = spread(b.splats[b.tiles.splats[k]], static_cast<float>(left), static_cast<float>(top));
    F moments[kMoments];
    for (int m = 0; m < kMoments; ++m) moments[m] = zeros();
    for (; touched; touched &= touched - 1) {
      const int block = __builtin_ctz(touched);
      if (!add_block(p, in, block, moments)) alive &= ~(1u << block);
    }
    store(out, lane_sums(moments));
  }
}

}  // namespace aomgen::AOMGEN_ISA
