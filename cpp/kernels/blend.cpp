// Front-to-back blending of one tile.
#include "canvas.h"

namespace aomgen::AOMGEN_ISA {

namespace {

void fill_batch(const Blend& b, uint32_t begin, int count, uint32_t end, float left, float top, uint32_t alive, Batch& batch) {
  for (uint32_t k = begin + kBatch; k < begin + 2 * kBatch && k < end; ++k) __builtin_prefetch(&b.splats[b.tiles.slots[k]]);
  uint8_t masks[2][kBatch] = {};
  for (int i = 0; i < count; ++i) {
    const uint32_t slot = b.tiles.slots[begin + i];
    const Splat& s = b.splats[slot];
    batch.ids[i] = slot;
    batch.drawn[i] = 0;
    batch.splats[i] = s;
    batch.splats[i].x = s.x - left;
    batch.splats[i].y = s.y - top;
    const uint32_t touched = touched_blocks(s, s.x - left, s.y - top) & alive;
    masks[0][i] = static_cast<uint8_t>(touched);
    masks[1][i] = static_cast<uint8_t>(touched >> 8);
  }
  transpose_masks(masks, batch.touching);
}

// Blends the splats' features besides their colors.
struct FeaturePainter {
  static constexpr bool kDepth = true;
  const Blend& b;
  const Batch& batch;
  float* sums;  // (16 blocks, D, 16 pixels)

  __attribute__((always_inline)) F color_weight(int i, int block, int at, F weight) const {
    const float* features = b.features + static_cast<size_t>(b.feature_count) * b.gaussians[batch.ids[i]];
    float* to = sums + static_cast<size_t>(block) * 16 * b.feature_count + at;
    for (int d = 0; d < b.feature_count; ++d) store(to + 16 * d, fma(weight, all(features[d]), load(to + 16 * d)));
    return weight;
  }
};

void store_colors(const Blend& b, int left, int top, const Canvas& canvas) {
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  if (b.images.interleaved) return store_interleaved(b.images.rgb, left, top, b.view, canvas);
  store_tile(b.images.rgb, left, top, b.view, canvas.red);
  store_tile(b.images.rgb + plane, left, top, b.view, canvas.green);
  store_tile(b.images.rgb + 2 * plane, left, top, b.view, canvas.blue);
}

void store_ids(const Blend& b, int left, int top, const Canvas& canvas) {
  store_tile(b.images.median_depth, left, top, b.view, canvas.median);
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) {
    const float id = canvas.best_id[block][pixel];
    b.images.max_id[at] = id < 0 ? -1 : b.gaussians[static_cast<int>(id)];
  });
}

void store_features(const Blend& b, int left, int top, const float* sums) {
  const int count = b.feature_count;
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) {
    for (int d = 0; d < count; ++d) b.images.features[at * count + d] = sums[(static_cast<size_t>(block) * count + d) * 16 + pixel];
  });
}

void finish(const Blend& b, int left, int top, Canvas& canvas) {
  alignas(64) float alpha[16][16];
  add_background(b.view.background, nullptr, canvas, alpha);
  store_colors(b, left, top, canvas);
  store_tile(b.images.depth, left, top, b.view, canvas.depth);
  store_tile(b.images.alpha, left, top, b.view, alpha);
}

void prefetch_images(const Blend& b, int left, int top) {
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  if (!b.images.interleaved)
    for (int channel = 0; channel < 3; ++channel) prefetch_tile<true>(b.images.rgb + channel * plane, left, top, b.view);
  prefetch_tile<true>(b.images.depth, left, top, b.view);
  prefetch_tile<true>(b.images.alpha, left, top, b.view);
}

template <bool WithIds, bool WithFeatures>
void blend_tile(const Blend& b, int tile, float* feature_sums) {
  const int left = tile % b.tiles.columns * kTile, top = tile / b.tiles.columns * kTile;
  Canvas canvas;
  Batch batch;
  clear(canvas, WithIds);
  prefetch_images(b, left, top);
  if (WithFeatures) memset(feature_sums, 0, sizeof(float) * blend_scratch(b.feature_count));
  uint32_t alive = blocks_on_image(left, top, b.view);
  const uint32_t end = b.tiles.begin[tile + 1];
  uint32_t k = b.tiles.begin[tile];
  for (; k < end && alive; k += kBatch) {
    const int count = end - k < kBatch ? static_cast<int>(end - k) : kBatch;
    fill_batch(b, k, count, end, static_cast<float>(left), static_cast<float>(top), alive, batch);
    if constexpr (WithFeatures) alive = draw_batch<WithIds, true>(batch, canvas, alive, FeaturePainter{b, batch, feature_sums});
    else alive = draw_batch<WithIds, true>(batch, canvas, alive, Plain{});
    for (int i = 0; b.block_masks && i < count; ++i) b.block_masks[k + i] = static_cast<uint16_t>(batch.drawn[i]);
  }
  if (b.block_masks && k < end) memset(b.block_masks + k, 0, (end - k) * sizeof(uint16_t));
  finish(b, left, top, canvas);
  if (b.sums) b.sums[tile] = canvas;
  if (WithIds) store_ids(b, left, top, canvas);
  if (WithFeatures) store_features(b, left, top, feature_sums);
}

}  // namespace

void blend(const Blend& b, int tile, float* scratch) {
  const bool ids = b.images.max_id, features = b.feature_count > 0;
  if (ids && features) return blend_tile<true, true>(b, tile, scratch);
  if (ids) return blend_tile<true, false>(b, tile, scratch);
  if (features) return blend_tile<false, true>(b, tile, scratch);
  blend_tile<false, false>(b, tile, scratch);
}

}  // namespace aomgen::AOMGEN_ISA
