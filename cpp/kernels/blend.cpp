// Front-to-back blending of one tile.
#include "tile.h"

namespace aomgen::AOMGEN_ISA {

namespace {

constexpr int kBatch = 32;  // splats tested against the blocks before any is blended

struct alignas(64) Canvas {
  float transmittance[16][16], red[16][16], green[16][16], blue[16][16], depth[16][16];
  float median[16][16], best_weight[16][16], best_slot[16][16];
};

struct alignas(64) Batch {
  Splat splats[kBatch];  // centres relative to the tile's corner
  uint32_t slots[kBatch];
  uint32_t drawn[kBatch];   // by splat: blocks in which it was drawn
  uint32_t touching[16];    // by block: bit i for splat i of the batch
};

void clear(Canvas& canvas, bool with_ids) {
  for (int i = 0; i < 256; i += kLanes) {
    store(&canvas.transmittance[0][i], all(1.0f));
    store(&canvas.red[0][i], zeros());
    store(&canvas.green[0][i], zeros());
    store(&canvas.blue[0][i], zeros());
    store(&canvas.depth[0][i], zeros());
    if (!with_ids) continue;
    store(&canvas.median[0][i], zeros());
    store(&canvas.best_weight[0][i], zeros());
    store(&canvas.best_slot[0][i], all(-1.0f));
  }
}

// Bit c of byte r <-> bit r of byte c, by swapping ever larger squares along the diagonal.
uint64_t transposed_bits(uint64_t x) {
  uint64_t t = (x ^ (x >> 7)) & 0x00aa00aa00aa00aaull;
  x ^= t ^ (t << 7);
  t = (x ^ (x >> 14)) & 0x0000cccc0000ccccull;
  x ^= t ^ (t << 14);
  t = (x ^ (x >> 28)) & 0x00000000f0f0f0f0ull;
  return x ^ t ^ (t << 28);
}

// From the blocks of each splat to the splats of each block.
void transpose_masks(const uint8_t masks[2][kBatch], uint32_t touching[16]) {
  uint8_t bytes[kBatch / 8][16];
  for (int group = 0; group < kBatch / 8; ++group)
    for (int half = 0; half < 2; ++half) {
      uint64_t word = 0;
      for (int i = 0; i < 8; ++i) word |= static_cast<uint64_t>(masks[half][8 * group + i]) << (8 * i);
      word = transposed_bits(word);
      for (int i = 0; i < 8; ++i) bytes[group][8 * half + i] = static_cast<uint8_t>(word >> (8 * i));
    }
  static_assert(kBatch == 32, "four bytes make one mask");
  for (int block = 0; block < 16; ++block)
    touching[block] = bytes[0][block] | bytes[1][block] << 8 | bytes[2][block] << 16 | static_cast<uint32_t>(bytes[3][block]) << 24;
}

void fill_batch(const Blend& b, uint32_t begin, int count, uint32_t end, float left, float top, uint32_t alive, Batch& batch) {
  for (uint32_t k = begin + kBatch; k < begin + 2 * kBatch && k < end; ++k) __builtin_prefetch(&b.splats[b.tiles.slots[k]]);
  uint8_t masks[2][kBatch] = {};
  for (int i = 0; i < count; ++i) {
    const uint32_t slot = b.tiles.slots[begin + i];
    const Splat& s = b.splats[slot];
    batch.slots[i] = slot;
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

// Pixels of one register.
struct Pixels {
  F transmittance, red, green, blue, depth;
  F median, best_weight, best_slot;
};

template <bool WithIds>
AOMGEN_INLINE Pixels load_pixels(const Canvas& c, int at) {
  Pixels p = {load(&c.transmittance[0][at]), load(&c.red[0][at]), load(&c.green[0][at]), load(&c.blue[0][at]), load(&c.depth[0][at]), F{}, F{}, F{}};
  if (WithIds) {
    p.median = load(&c.median[0][at]);
    p.best_weight = load(&c.best_weight[0][at]);
    p.best_slot = load(&c.best_slot[0][at]);
  }
  return p;
}

template <bool WithIds>
AOMGEN_INLINE void store_pixels(Canvas& c, int at, const Pixels& p) {
  store(&c.transmittance[0][at], p.transmittance);
  store(&c.red[0][at], p.red);
  store(&c.green[0][at], p.green);
  store(&c.blue[0][at], p.blue);
  store(&c.depth[0][at], p.depth);
  if (!WithIds) return;
  store(&c.median[0][at], p.median);
  store(&c.best_weight[0][at], p.best_weight);
  store(&c.best_slot[0][at], p.best_slot);
}

// Median depth: of the splat at which less than half of the light is left. Identity: of the largest weight.
AOMGEN_INLINE void update_ids(Pixels& p, M drawn, F after, F weight, const Splat& s, uint32_t slot) {
  M crosses = drawn & above(all(0.5f), after) & above(p.transmittance, all(0.49999997f));
  p.median = where(crosses, all(s.depth), p.median);
  M better = above(weight, p.best_weight);
  p.best_weight = where(better, weight, p.best_weight);
  p.best_slot = where(better, all(static_cast<float>(slot)), p.best_slot);
}

AOMGEN_INLINE void add_features(const Blend& b, uint32_t slot, F weight, float* sums) {
  const float* features = b.features + static_cast<size_t>(b.feature_count) * b.gaussians[slot];
  for (int d = 0; d < b.feature_count; ++d) store(sums + 16 * d, fma(weight, all(features[d]), load(sums + 16 * d)));
}

// Blends the batch's splats into one register of a block; returns whether light is left.
template <bool WithIds, bool WithFeatures>
AOMGEN_INLINE bool draw(const Blend& b, Batch& batch, Canvas& canvas, int block, int part, float* feature_sums) {
  const int at = 16 * block + part * kLanes;
  const F x = load(&kTileGeometry.x[0][at]), y = load(&kTileGeometry.y[0][at]);
  Pixels p = load_pixels<WithIds>(canvas, at);
  for (uint32_t rest = batch.touching[block]; rest; rest &= rest - 1) {
    const int i = __builtin_ctz(rest);
    const Splat& s = batch.splats[i];
    const Touch t = touch(s, x, y, p.transmittance);
    const F weight = t.alpha * p.transmittance, after = fnma(t.alpha, p.transmittance, p.transmittance);
    p.red = fma(weight, all(s.red), p.red);
    p.green = fma(weight, all(s.green), p.green);
    p.blue = fma(weight, all(s.blue), p.blue);
    p.depth = fma(weight, all(s.depth), p.depth);
    batch.drawn[i] |= static_cast<uint32_t>(any(t.drawn)) << block;
    if (WithIds) update_ids(p, t.drawn, after, weight, s, batch.slots[i]);
    if (WithFeatures) add_features(b, batch.slots[i], weight, feature_sums + static_cast<size_t>(block) * 16 * b.feature_count + part * kLanes);
    p.transmittance = after;
  }
  store_pixels<WithIds>(canvas, at, p);
  return any(above(p.transmittance, all(kMinTransmittance)));
}

// Returns the blocks in which light is left.
template <bool WithIds, bool WithFeatures>
uint32_t draw_batch(const Blend& b, Batch& batch, Canvas& canvas, uint32_t alive, float* feature_sums) {
  uint32_t left = 0;
  for (uint32_t rest = alive; rest; rest &= rest - 1) {
    const int block = __builtin_ctz(rest);
    bool light = false;
    for (int part = 0; part < kParts; ++part) light |= draw<WithIds, WithFeatures>(b, batch, canvas, block, part, feature_sums);
    left |= static_cast<uint32_t>(light) << block;
  }
  return left;
}

// Calls visit(index of the pixel in the image, block, pixel in the block) for the tile's pixels on the image.
template <class Visit>
AOMGEN_INLINE void for_each_pixel(const AomgenView& view, int left, int top, Visit visit) {
  for (int block = 0; block < 16; ++block)
    for (int pixel = 0; pixel < 16; ++pixel) {
      const int x = left + 4 * (block % 4) + pixel % 4, y = top + 4 * (block / 4) + pixel / 4;
      if (x < view.width && y < view.height) visit(static_cast<size_t>(y) * view.width + x, block, pixel);
    }
}

void store_colors(const Blend& b, int left, int top, const Canvas& canvas) {
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  if (!b.images.interleaved) {
    store_tile(b.images.rgb, left, top, b.view, canvas.red);
    store_tile(b.images.rgb + plane, left, top, b.view, canvas.green);
    store_tile(b.images.rgb + 2 * plane, left, top, b.view, canvas.blue);
    return;
  }
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) {
    b.images.rgb[3 * at] = canvas.red[block][pixel];
    b.images.rgb[3 * at + 1] = canvas.green[block][pixel];
    b.images.rgb[3 * at + 2] = canvas.blue[block][pixel];
  });
}

void store_ids(const Blend& b, int left, int top, const Canvas& canvas) {
  store_tile(b.images.median_depth, left, top, b.view, canvas.median);
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) {
    const float slot = canvas.best_slot[block][pixel];
    b.images.max_id[at] = slot < 0 ? -1 : b.gaussians[static_cast<int>(slot)];
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
  const float* background = b.view.background;
  for (int i = 0; i < 256; i += kLanes) {
    F rest = load(&canvas.transmittance[0][i]);
    store(&canvas.red[0][i], fma(rest, all(background[0]), load(&canvas.red[0][i])));
    store(&canvas.green[0][i], fma(rest, all(background[1]), load(&canvas.green[0][i])));
    store(&canvas.blue[0][i], fma(rest, all(background[2]), load(&canvas.blue[0][i])));
    store(&alpha[0][i], 1.0f - rest);
  }
  store_colors(b, left, top, canvas);
  store_tile(b.images.depth, left, top, b.view, canvas.depth);
  store_tile(b.images.alpha, left, top, b.view, alpha);
  store_tile(b.transmittance, left, top, b.view, canvas.transmittance);
}

template <bool WithIds, bool WithFeatures>
void blend_tile(const Blend& b, int tile, float* feature_sums) {
  const int left = tile % b.tiles.columns * kTile, top = tile / b.tiles.columns * kTile;
  Canvas canvas;
  Batch batch;
  clear(canvas, WithIds);
  if (WithFeatures) memset(feature_sums, 0, sizeof(float) * blend_scratch(b.feature_count));
  uint32_t alive = blocks_on_image(left, top, b.view);
  const uint32_t end = b.tiles.begin[tile + 1];
  uint32_t k = b.tiles.begin[tile];
  for (; k < end && alive; k += kBatch) {
    const int count = end - k < kBatch ? static_cast<int>(end - k) : kBatch;
    fill_batch(b, k, count, end, static_cast<float>(left), static_cast<float>(top), alive, batch);
    alive = draw_batch<WithIds, WithFeatures>(b, batch, canvas, alive, feature_sums);
    for (int i = 0; i < count; ++i) b.block_masks[k + i] = static_cast<uint16_t>(batch.drawn[i]);
  }
  for (; k < end; ++k) b.block_masks[k] = 0;
  finish(b, left, top, canvas);
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
