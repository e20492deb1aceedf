// Front-to-back blending of one tile.
#include "tile.h"

namespace aomgen::AOMGEN_ISA {

namespace {

constexpr int kBatch = 32;  // splats tested against the blocks before any is blended

struct alignas(64) Canvas {
  float transmittance[16][16], red[16][16], green[16][16], blue[16][16], depth[16][16];
  float median[16][16], best_weight[16][16], best_rank[16][16];
};

// (splat in batch) * 16 + block, for all blocks still alive that the batch's splats touch.
struct alignas(64) Batch {
  Splat splats[kBatch];  // centres relative to the tile's corner
  uint32_t ranks[kBatch];
  int32_t work[kBatch * 16 + 16];
  int work_count;
};

void clear(Canvas& canvas) {
  for (int block = 0; block < 16; ++block) {
    store(canvas.transmittance[block], all(1.0f));
    store(canvas.red[block], zeros());
    store(canvas.green[block], zeros());
    store(canvas.blue[block], zeros());
    store(canvas.depth[block], zeros());
    store(canvas.median[block], zeros());
    store(canvas.best_weight[block], zeros());
    store(canvas.best_rank[block], all(-1.0f));
  }
}

void fill_batch(const Blend& b, uint32_t begin, int count, uint32_t end, float left, float top, uint32_t alive, Batch& batch) {
  for (uint32_t k = begin + kBatch; k < begin + 2 * kBatch && k < end; ++k) __builtin_prefetch(&b.splats[b.tiles.splats[k]]);
  batch.work_count = 0;
  for (int i = 0; i < count; ++i) {
    const uint32_t rank = b.tiles.splats[begin + i];
    const Splat& s = b.splats[rank];
    const float x = s.x - left, y = s.y - top;
    const uint32_t touched = touched_blocks(s, x, y);
    b.block_masks[begin + i] = static_cast<uint16_t>(touched);
    batch.ranks[i] = rank;
    store(&batch.splats[i].x, load(&s.x));
    batch.splats[i].x = x;
    batch.splats[i].y = y;
    batch.work_count += append_set_bits(batch.work + batch.work_count, touched & alive, i << 4);
  }
}

// Median depth: of the splat at which less than half of the light is left. Identity: of the largest weight.
AOMGEN_INLINE void update_ids(Canvas& canvas, int block, M drawn, F before, F after, F weight, const Splat& s, uint32_t rank) {
  M crosses = drawn & (all(0.5f) > after) & (before > all(0.49999997f));
  store(canvas.median[block], where(crosses, all(s.depth), load(canvas.median[block])));
  F best = load(canvas.best_weight[block]);
  M better = weight > best;
  store(canvas.best_weight[block], where(better, weight, best));
  store(canvas.best_rank[block], where(better, all(static_cast<float>(rank)), load(canvas.best_rank[block])));
}

AOMGEN_INLINE void accumulate(float* sum, F weight, float value) { store(sum, fma(weight, all(value), load(sum))); }

template <bool WithIds, bool WithFeatures>
void draw_batch(const Blend& b, const Batch& batch, Canvas& canvas, float* feature_sums) {
  for (int w = 0; w < batch.work_count; ++w) {
    const int i = batch.work[w] >> 4, block = batch.work[w] & 15;
    const Splat& s = batch.splats[i];
    F dx = load(kTileGeometry.x[block]) - all(s.x), dy = load(kTileGeometry.y[block]) - all(s.y);
    F e = log2_alpha(dx, dy, all(s.qxx), all(s.qxy), all(s.qyy), all(s.log2_opacity));
    F before = load(canvas.transmittance[block]);
    M drawn = (e > all(kMinLog2Alpha)) & (before > all(kMinTransmittance));
    F alpha = where(drawn, lesser(exp2(e), all(kMaxAlpha)));
    F weight = alpha * before, after = fnma(alpha, before, before);
    store(canvas.transmittance[block], after);
    accumulate(canvas.red[block], weight, s.red);
    accumulate(canvas.green[block], weight, s.green);
    accumulate(canvas.blue[block], weight, s.blue);
    accumulate(canvas.depth[block], weight, s.depth);
    if (WithIds) update_ids(canvas, block, drawn, before, after, weight, s, batch.ranks[i]);
    if (WithFeatures) {
      const int count = b.images.feature_count;
      const float* features = b.images.features + static_cast<size_t>(count) * b.gaussians[batch.ranks[i]];
      float* sums = feature_sums + static_cast<size_t>(block) * 16 * count;
      for (int d = 0; d < count; ++d) accumulate(sums + 16 * d, weight, features[d]);
    }
  }
}

uint32_t unfinished(uint32_t alive, const Canvas& canvas) {
  uint32_t result = 0;
  for (uint32_t rest = alive; rest; rest &= rest - 1) {
    const int block = __builtin_ctz(rest);
    if (any(load(canvas.transmittance[block]) > all(kMinTransmittance))) result |= 1u << block;
  }
  return result;
}

void store_interleaved(const Blend& b, int left, int top, const Canvas& canvas) {
  for (int block = 0; block < 16; ++block)
    for (int pixel = 0; pixel < 16; ++pixel) {
      const int x = left + 4 * (block % 4) + pixel % 4, y = top + 4 * (block / 4) + pixel / 4;
      if (x >= b.view.width || y >= b.view.height) continue;
      float* rgb = b.images.rgb + 3 * (static_cast<size_t>(y) * b.view.width + x);
      rgb[0] = canvas.red[block][pixel];
      rgb[1] = canvas.green[block][pixel];
      rgb[2] = canvas.blue[block][pixel];
    }
}

void store_ids(const Blend& b, int left, int top, const Canvas& canvas) {
  store_tile(b.images.median_depth, left, top, b.view, canvas.median);
  for (int block = 0; block < 16; ++block)
    for (int pixel = 0; pixel < 16; ++pixel) {
      const int x = left + 4 * (block % 4) + pixel % 4, y = top + 4 * (block / 4) + pixel / 4;
      if (x >= b.view.width || y >= b.view.height) continue;
      const float rank = canvas.best_rank[block][pixel];
      b.images.max_id[static_cast<size_t>(y) * b.view.width + x] = rank < 0 ? -1 : b.gaussians[static_cast<int>(rank)];
    }
}

void store_features(const Blend& b, int left, int top, const float* sums) {
  const int count = b.images.feature_count;
  for (int block = 0; block < 16; ++block)
    for (int pixel = 0; pixel < 16; ++pixel) {
      const int x = left + 4 * (block % 4) + pixel % 4, y = top + 4 * (block / 4) + pixel / 4;
      if (x >= b.view.width || y >= b.view.height) continue;
      float* out = b.images.feature_image + (static_cast<size_t>(y) * b.view.width + x) * count;
      for (int d = 0; d < count; ++d) out[d] = sums[(static_cast<size_t>(block) * count + d) * 16 + pixel];
    }
}

void finish(const Blend& b, int left, int top, Canvas& canvas) {
  alignas(64) float alpha[16][16];
  const float* background = b.view.background;
  for (int block = 0; block < 16; ++block) {
    F rest = load(canvas.transmittance[block]);
    accumulate(canvas.red[block], rest, background[0]);
    accumulate(canvas.green[block], rest, background[1]);
    accumulate(canvas.blue[block], rest, background[2]);
    store(alpha[block], all(1.0f) - rest);
  }
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  if (b.images.interleaved) {
    store_interleaved(b, left, top, canvas);
  } else {
    store_tile(b.images.rgb, left, top, b.view, canvas.red);
    store_tile(b.images.rgb + plane, left, top, b.view, canvas.green);
    store_tile(b.images.rgb + 2 * plane, left, top, b.view, canvas.blue);
  }
  store_tile(b.images.depth, left, top, b.view, canvas.depth);
  store_tile(b.images.alpha, left, top, b.view, alpha);
  store_tile(b.transmittance, left, top, b.view, canvas.transmittance);
}

template <bool WithIds, bool WithFeatures>
void blend_tile(const Blend& b, int tile, float* feature_sums) {
  const int left = tile % b.tiles.columns * kTile, top = tile / b.tiles.columns * kTile;
  Canvas canvas;
  Batch batch;
  clear(canvas);
  if (WithFeatures) memset(feature_sums, 0, sizeof(float) * blend_scratch(b.images.feature_count));
  uint32_t alive = blocks_on_image(left, top, b.view);
  const uint32_t end = b.tiles.begin[tile + 1];
  uint32_t k = b.tiles.begin[tile];
  for (; k < end && alive; k += kBatch) {
    const int count = end - k < kBatch ? static_cast<int>(end - k) : kBatch;
    fill_batch(b, k, count, end, static_cast<float>(left), static_cast<float>(top), alive, batch);
    draw_batch<WithIds, WithFeatures>(b, batch, canvas, feature_sums);
    alive = unfinished(alive, canvas);
  }
  for (; k < end; ++k) b.block_masks[k] = 0;
  finish(b, left, top, canvas);
  if (WithIds) store_ids(b, left, top, canvas);
  if (WithFeatures) store_features(b, left, top, feature_sums);
}

}  // namespace

void blend(const Blend& b, int tile, float* scratch) {
  const bool ids = b.images.max_id, features = b.images.feature_count > 0;
  if (ids && features) return blend_tile<true, true>(b, tile, scratch);
  if (ids) return blend_tile<true, false>(b, tile, scratch);
  if (features) return blend_tile<false, true>(b, tile, scratch);
  blend_tile<false, false>(b, tile, scratch);
}

}  // namespace aomgen::AOMGEN_ISA
