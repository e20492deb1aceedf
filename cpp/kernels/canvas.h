// The pixels of one tile while splats are blended into them, and what all passes that blend share.
#pragma once

#include "tile.h"

namespace aomgen::AOMGEN_ISA {

constexpr int kBatch = 32;  // splats tested against the blocks before any is blended

struct alignas(64) Canvas : TileSums {
  float median[16][16], best_weight[16][16], best_id[16][16];
};

struct alignas(64) Batch {
  Splat splats[kBatch];  // centres relative to the tile's corner
  uint32_t ids[kBatch];     // what becomes of them in max_id
  uint32_t drawn[kBatch];   // by splat: blocks in which it was drawn, kept with masks
  uint32_t touching[16];    // by block: bit i for splat i of the batch
};

AOMGEN_INLINE void clear(Canvas& canvas, bool with_ids) {
  for (int pixel = 0; pixel < 256; pixel += kLanes) {
    const int block = pixel / 16, i = pixel % 16;
    store(canvas.transmittance[block] + i, all(1.0f));
    store(canvas.red[block] + i, zeros());
    store(canvas.green[block] + i, zeros());
    store(canvas.blue[block] + i, zeros());
    store(canvas.depth[block] + i, zeros());
    if (!with_ids) continue;
    store(canvas.median[block] + i, zeros());
    store(canvas.best_weight[block] + i, zeros());
    store(canvas.best_id[block] + i, all(-1.0f));
  }
}

// Bit c of byte r <-> bit r of byte c, by swapping ever larger squares along the diagonal.
AOMGEN_INLINE uint64_t transposed_bits(uint64_t x) {
  uint64_t t = (x ^ (x >> 7)) & 0x00aa00aa00aa00aaull;
  x ^= t ^ (t << 7);
  t = (x ^ (x >> 14)) & 0x0000cccc0000ccccull;
  x ^= t ^ (t << 14);
  t = (x ^ (x >> 28)) & 0x00000000f0f0f0f0ull;
  return x ^ t ^ (t << 28);
}

// From the blocks of each splat to the splats of each block.
AOMGEN_INLINE void transpose_masks(const uint8_t masks[2][kBatch], uint32_t touching[16]) {
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

// Pixels of one register.
struct Pixels {
  F transmittance, red, green, blue, depth;
  F median, best_weight, best_id;
};

template <bool WithIds>
AOMGEN_INLINE Pixels load_pixels(const Canvas& c, int block, int at) {
  Pixels p = {load(c.transmittance[block] + at), load(c.red[block] + at), load(c.green[block] + at), load(c.blue[block] + at), load(c.depth[block] + at), F{}, F{}, F{}};
  if (WithIds) {
    p.median = load(c.median[block] + at);
    p.best_weight = load(c.best_weight[block] + at);
    p.best_id = load(c.best_id[block] + at);
  }
  return p;
}

template <bool WithIds>
AOMGEN_INLINE void store_pixels(Canvas& c, int block, int at, const Pixels& p) {
  store(c.transmittance[block] + at, p.transmittance);
  store(c.red[block] + at, p.red);
  store(c.green[block] + at, p.green);
  store(c.blue[block] + at, p.blue);
  store(c.depth[block] + at, p.depth);
  if (!WithIds) return;
  store(c.median[block] + at, p.median);
  store(c.best_weight[block] + at, p.best_weight);
  store(c.best_id[block] + at, p.best_id);
}

// Median depth: of the splat at which less than half of the light is left. Identity: of the largest weight.
AOMGEN_INLINE void update_ids(Pixels& p, M drawn, F after, F weight, const Splat& s, uint32_t id) {
  M crosses = drawn & above(all(0.5f), after) & above(p.transmittance, all(0.49999997f));
  p.median = where(crosses, all(s.depth), p.median);
  M better = above(weight, p.best_weight);
  p.best_weight = where(better, weight, p.best_weight);
  p.best_id = where(better, all(static_cast<float>(id)), p.best_id);
}

// Paints every splat in its own color; painters with more or less to do replace this one.
struct Plain {
  static constexpr bool kDepth = true;  // whether depths are summed

  // The weight of the color of the batch's splat i on one register of a block, pixels `at` and following.
  __attribute__((always_inline)) F color_weight(int, int, int, F weight) const { return weight; }
};

// Blends the batch's splats into one register of a block, pixels `at` and following; returns whether light is left.
template <bool WithIds, bool WithMasks, class Painter>
AOMGEN_INLINE bool draw(Batch& batch, Canvas& canvas, int block, int at, const Painter& painter) {
  const F x = load(kTileGeometry.x[block] + at), y = load(kTileGeometry.y[block] + at);
  Pixels p = load_pixels<WithIds>(canvas, block, at);
  for (uint32_t rest = batch.touching[block]; rest; rest &= rest - 1) {
    const int i = __builtin_ctz(rest);
    const Splat& s = batch.splats[i];
    const Touch t = touch(s, x, y, p.transmittance);
    const F weight = t.alpha * p.transmittance, after = fnma(t.alpha, p.transmittance, p.transmittance);
    const F color_weight = painter.color_weight(i, block, at, weight);
    p.red = fma(color_weight, all(s.red), p.red);
    p.green = fma(color_weight, all(s.green), p.green);
    p.blue = fma(color_weight, all(s.blue), p.blue);
    if (Painter::kDepth) p.depth = fma(weight, all(s.depth), p.depth);
    if (WithMasks) batch.drawn[i] |= static_cast<uint32_t>(any(t.drawn)) << block;
    if (WithIds) update_ids(p, t.drawn, after, weight, s, batch.ids[i]);
    p.transmittance = after;
  }
  store_pixels<WithIds>(canvas, block, at, p);
  return any(above(p.transmittance, all(kMinTransmittance)));
}

// Blends the batch into the blocks in which light is left before; returns those in which light is left after.
template <bool WithIds, bool WithMasks, class Painter>
AOMGEN_INLINE uint32_t draw_batch(Batch& batch, Canvas& canvas, uint32_t alive, const Painter& painter) {
  uint32_t left = 0;
  for (uint32_t rest = alive; rest; rest &= rest - 1) {
    const int block = __builtin_ctz(rest);
    bool light = false;
    for (int at = 0; at < 16; at += kLanes) light |= draw<WithIds, WithMasks>(batch, canvas, block, at, painter);
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

// Lets the background shine through, darkened by `shade` unless it is null; gives alpha.
AOMGEN_INLINE void add_background(const float background[3], const float shade[16][16], Canvas& canvas, float alpha[16][16]) {
  for (int pixel = 0; pixel < 256; pixel += kLanes) {
    const int block = pixel / 16, i = pixel % 16;
    const F rest = load(canvas.transmittance[block] + i);
    const F lit = shade ? rest * load(shade[block] + i) : rest;
    store(canvas.red[block] + i, fma(lit, all(background[0]), load(canvas.red[block] + i)));
    store(canvas.green[block] + i, fma(lit, all(background[1]), load(canvas.green[block] + i)));
    store(canvas.blue[block] + i, fma(lit, all(background[2]), load(canvas.blue[block] + i)));
    store(alpha[block] + i, 1.0f - rest);
  }
}

// Copies the tile's colors into its part of an image (H, W, 3).
AOMGEN_INLINE void store_interleaved(float* rgb, int left, int top, const AomgenView& view, const Canvas& canvas) {
  for_each_pixel(view, left, top, [&](size_t at, int block, int pixel) {
    rgb[3 * at] = canvas.red[block][pixel];
    rgb[3 * at + 1] = canvas.green[block][pixel];
    rgb[3 * at + 2] = canvas.blue[block][pixel];
  });
}

}  // namespace aomgen::AOMGEN_ISA
