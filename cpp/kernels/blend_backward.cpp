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
// Features add one sum each, w dL/dfeature.
#include "tile.h"

namespace aomgen::AOMGEN_ISA {

namespace {

// One block of pixels. Its fields lie together, so that they never collide in the lowest address bits.
struct alignas(64) Block {
  float x[16], y[16];                             // pixel centres relative to the tile's corner
  float red[16], green[16], blue[16], depth[16];  // dL by the pixel's sums
  float behind[16];                               // dL-weighted sum of everything not drawn yet
  float transmittance[16];
};

void load_blocks(const BlendBackward& b, int tile, int left, int top, Block blocks[16]) {
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  const TileSums& drawn = b.sums[tile];
  alignas(64) float red[16][16], green[16][16], blue[16][16], depth[16][16] = {}, alpha[16][16] = {};
  load_tile(b.images.rgb, left, top, b.view, red);
  load_tile(b.images.rgb + plane, left, top, b.view, green);
  load_tile(b.images.rgb + 2 * plane, left, top, b.view, blue);
  if (b.images.depth) load_tile(b.images.depth, left, top, b.view, depth);
  if (b.images.alpha) load_tile(b.images.alpha, left, top, b.view, alpha);
  for (int block = 0; block < 16; ++block)
    for (int i = 0; i < 16; i += kLanes) {
      Block& to = blocks[block];
      F r = load(&red[block][i]), g = load(&green[block][i]), b = load(&blue[block][i]), d = load(&depth[block][i]);
      store(to.x + i, load(&kTileGeometry.x[block][i]));
      store(to.y + i, load(&kTileGeometry.y[block][i]));
      store(to.red + i, r);
      store(to.green + i, g);
      store(to.blue + i, b);
      store(to.depth + i, d);
      F behind = load(&drawn.red[block][i]) * r + load(&drawn.green[block][i]) * g + load(&drawn.blue[block][i]) * b + load(&drawn.depth[block][i]) * d;
      store(to.behind + i, behind - load(&drawn.transmittance[block][i]) * load(&alpha[block][i]));
      store(to.transmittance + i, all(1.0f));
    }
}

// Copies dL by the features into `gradients` (block, D, 16) and adds their part to `behind`.
void load_features(const BlendBackward& b, int left, int top, float* gradients, Block blocks[16]) {
  const size_t count = b.feature_count;
  memset(gradients, 0, sizeof(float) * 256 * count);
  for (int block = 0; block < 16; ++block)
    for (int pixel = 0; pixel < 16; ++pixel) {
      const int x = left + 4 * (block % 4) + pixel % 4, y = top + 4 * (block / 4) + pixel / 4;
      if (x >= b.view.width || y >= b.view.height) continue;
      const size_t at = (static_cast<size_t>(y) * b.view.width + x) * count;
      float sum = 0;
      for (size_t d = 0; d < count; ++d) {
        gradients[(block * count + d) * 16 + pixel] = b.images.features[at + d];
        sum += b.images.features[at + d] * b.images.drawn_features[at + d];
      }
      blocks[block].behind[pixel] += sum;
    }
}

// A splat's features, dL by the features of one register of pixels, and the splat's sums.
struct Features {
  int count;
  const float* values;
  const float* gradients;  // (D, 16)
  float* sums;             // (D, kLanes)
};

AOMGEN_INLINE F feature_share(const Features& f) {
  F own = zeros();
  for (int d = 0; d < f.count; ++d) own = fma(all(f.values[d]), load(f.gradients + 16 * d), own);
  return own;
}

AOMGEN_INLINE void add_feature_sums(const Features& f, F weight) {
  for (int d = 0; d < f.count; ++d)
    store(f.sums + kLanes * d, fma(weight, load(f.gradients + 16 * d), load(f.sums + kLanes * d)));
}

// Adds the part of one register of a block, pixels `at` and following, to the moments.
template <bool WithDepth, bool WithFeatures>
AOMGEN_INLINE void add_pixels(const Splat& s, Block& in, int at, F moments[kMoments], const Features& features) {
  const F before = load(in.transmittance + at);
  const Touch t = touch(s, load(in.x + at), load(in.y + at), before);
  const F weight = t.alpha * before;
  store(in.transmittance + at, fnma(t.alpha, before, before));
  const F red = load(in.red + at), green = load(in.green + at), blue = load(in.blue + at);
  F own = fma(all(s.red), red, fma(all(s.green), green, s.blue * blue));
  if (WithDepth) own = fma(all(s.depth), load(in.depth + at), own);
  if (WithFeatures) own = own + feature_share(features);
  const F behind = fnma(weight, own, load(in.behind + at));
  store(in.behind + at, behind);
  const F by_alpha = fnma(behind, reciprocal(1.0f - t.alpha), before * own);
  const F g = where(above(all(kMaxAlpha), t.unclamped), t.alpha) * by_alpha;
  const F gx = g * t.dx, gy = g * t.dy;
  moments[0] = moments[0] + g;
  moments[1] = moments[1] + gx;
  moments[2] = moments[2] + gy;
  moments[3] = fma(gx, t.dx, moments[3]);
  moments[4] = fma(gx, t.dy, moments[4]);
  moments[5] = fma(gy, t.dy, moments[5]);
  moments[6] = fma(weight, red, moments[6]);
  moments[7] = fma(weight, green, moments[7]);
  moments[8] = fma(weight, blue, moments[8]);
  if (WithDepth) moments[9] = fma(weight, load(in.depth + at), moments[9]);
  if (WithFeatures) add_feature_sums(features, weight);
}

void store_feature_moments(const Features& f, float* out) {
  for (int d = 0; d < f.count; ++d) {
    float total = 0;
    for (int lane = 0; lane < kLanes; ++lane) total += f.sums[kLanes * d + lane];
    out[d] = total;
  }
}

// The planes of the next tile, which is likely to be the next task of this thread.
void prefetch_next(const BlendBackward& b, int tile) {
  if (++tile >= b.tiles.columns * b.tiles.rows) return;
  const int left = tile % b.tiles.columns * kTile, top = tile / b.tiles.columns * kTile;
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  for (int channel = 0; channel < 3; ++channel) prefetch_tile<false>(b.images.rgb + channel * plane, left, top, b.view);
}

template <bool WithDepth, bool WithFeatures>
void backward_tile(const BlendBackward& b, int tile, float* scratch) {
  const int left = tile % b.tiles.columns * kTile, top = tile / b.tiles.columns * kTile;
  const size_t count = WithFeatures ? b.feature_count : 0;
  Block in[16];
  load_blocks(b, tile, left, top, in);
  prefetch_next(b, tile);
  if (WithFeatures) load_features(b, left, top, scratch, in);
  Features features = {static_cast<int>(count), nullptr, nullptr, scratch + 256 * count};
  const uint32_t end = b.tiles.begin[tile + 1];
  for (uint32_t k = b.tiles.begin[tile]; k < end; ++k) {
    uint32_t blocks = b.block_masks[k];
    if (!blocks) {
      memset(b.moments + 16 * static_cast<size_t>(k), 0, 16 * sizeof(float));
      if (WithFeatures) memset(b.feature_moments + count * k, 0, count * sizeof(float));
      continue;
    }
    if (k + 8 < end) __builtin_prefetch(&b.splats[b.tiles.slots[k + 8]]);
    Splat s = b.splats[b.tiles.slots[k]];
    s.x -= static_cast<float>(left);
    s.y -= static_cast<float>(top);
    F moments[kMoments];
    for (F& moment : moments) moment = zeros();
    if (WithFeatures) {
      features.values = b.features + count * b.gaussians[b.tiles.slots[k]];
      memset(features.sums, 0, sizeof(float) * kLanes * count);
    }
    for (; blocks; blocks &= blocks - 1) {
      const int block = __builtin_ctz(blocks);
      for (int at = 0; at < 16; at += kLanes) {
        features.gradients = scratch + 16 * block * count + at;
        add_pixels<WithDepth, WithFeatures>(s, in[block], at, moments, features);
      }
    }
    lane_sums(moments, b.moments + 16 * static_cast<size_t>(k));
    if (WithFeatures) store_feature_moments(features, b.feature_moments + count * k);
  }
}

}  // namespace

void blend_backward(const BlendBackward& b, int tile, float* scratch) {
  const bool depth = b.images.depth, features = b.feature_count > 0;
  if (depth && features) return backward_tile<true, true>(b, tile, scratch);
  if (depth) return backward_tile<true, false>(b, tile, scratch);
  if (features) return backward_tile<false, true>(b, tile, scratch);
  backward_tile<false, false>(b, tile, scratch);
}

}  // namespace aomgen::AOMGEN_ISA
