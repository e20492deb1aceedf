// Tiles of a session's frame: blended anew from what never moves and what does, or shown as they were.
#include "canvas.h"

namespace aomgen::AOMGEN_ISA {

namespace {

// Where a tile's two lists have been read to.
struct Cursors {
  uint32_t still, still_end, moving, moving_end;
};

AOMGEN_INLINE uint32_t depth_key(const Splat& s) {
  uint32_t key;
  memcpy(&key, &s.depth, sizeof(key));
  return key;
}

AOMGEN_INLINE void put(Batch& batch, uint8_t masks[2][kBatch], int i, const Splat& s, float left, float top, uint32_t blocks) {
  batch.splats[i] = s;
  batch.splats[i].x = s.x - left;
  batch.splats[i].y = s.y - top;
  batch.drawn[i] = 0;
  masks[0][i] = static_cast<uint8_t>(blocks);
  masks[1][i] = static_cast<uint8_t>(blocks >> 8);
}

// The next splats of both lists that reach a living block, near to far, what never moves first at equal
// depth. Returns how many; `still` gets their bits.
int fill_batch(const SessionBlend& b, Cursors& c, float left, float top, uint32_t alive, Batch& batch, uint32_t& still) {
  uint8_t masks[2][kBatch] = {};
  int count = 0;
  still = 0;
  for (uint32_t k = c.moving + kBatch; k < c.moving + 2 * kBatch && k < c.moving_end; ++k) __builtin_prefetch(&b.splats[b.tiles.slots[k]]);
  while (count < kBatch && (c.still < c.still_end || c.moving < c.moving_end)) {
    const uint32_t slot = c.moving < c.moving_end ? b.tiles.slots[c.moving] : 0;
    const uint32_t key = c.moving < c.moving_end ? depth_key(b.splats[slot]) : ~0u;
    for (; c.still < c.still_end && count < kBatch && b.still.keys[c.still] <= key; ++c.still) {
      const uint32_t blocks = b.still.blocks[c.still] & alive;
      if (!blocks) continue;
      const Splat& s = b.still.splats[b.still.rows[c.still]];
      batch.ids[count] = static_cast<uint32_t>(s.id);
      still |= 1u << count;
      put(batch, masks, count++, s, left, top, blocks);
    }
    if (count == kBatch || c.moving == c.moving_end) continue;
    ++c.moving;
    const Splat& s = b.splats[slot];
    const uint32_t blocks = touched_blocks(s, s.x - left, s.y - top) & alive;
    if (!blocks) continue;
    batch.ids[count] = static_cast<uint32_t>(b.first_moving + b.gaussians[slot]);
    put(batch, masks, count++, s, left, top, blocks);
  }
  transpose_masks(masks, batch.touching);
  return count;
}

// Darkens what never moves.
struct ShadePainter {
  const float (*shade)[16];
  uint32_t still;  // the batch's splats that never move

  __attribute__((always_inline)) F color_weight(int i, int block, int at, F weight) const {
    return still >> i & 1u ? weight * load(shade[block] + at) : weight;
  }
};

void store_rgb8(const SessionBlend& b, int left, int top, const Canvas& canvas) {
  alignas(64) int32_t values[3][16][16];
  const float(*planes[3])[16] = {canvas.red, canvas.green, canvas.blue};
  for (int channel = 0; channel < 3; ++channel)
    for (int pixel = 0; pixel < 256; pixel += kLanes) {
      const int block = pixel / 16, i = pixel % 16;
      const F value = clamp(load(planes[channel][block] + i), zeros(), all(1.0f));
      const I rounded = __builtin_convertvector(fma(value, all(255.0f), all(0.5f)), I);
      memcpy(values[channel][block] + i, &rounded, sizeof(rounded));
    }
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) {
    for (int channel = 0; channel < 3; ++channel) b.frame.rgb8[3 * at + channel] = static_cast<uint8_t>(values[channel][block][pixel]);
  });
}

void store_colors(const SessionBlend& b, int left, int top, const Canvas& canvas) {
  if (b.frame.rgb8) store_rgb8(b, left, top, canvas);
  if (!b.frame.rgb) return;
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) {
    b.frame.rgb[3 * at] = canvas.red[block][pixel];
    b.frame.rgb[3 * at + 1] = canvas.green[block][pixel];
    b.frame.rgb[3 * at + 2] = canvas.blue[block][pixel];
  });
}

void finish(const SessionBlend& b, int left, int top, const float shade[16][16], Canvas& canvas) {
  alignas(64) float alpha[16][16];
  const float* background = b.view.background;
  for (int pixel = 0; pixel < 256; pixel += kLanes) {
    const int block = pixel / 16, i = pixel % 16;
    const F rest = load(canvas.transmittance[block] + i);
    const F lit = shade ? rest * load(shade[block] + i) : rest;
    store(canvas.red[block] + i, fma(lit, all(background[0]), load(canvas.red[block] + i)));
    store(canvas.green[block] + i, fma(lit, all(background[1]), load(canvas.green[block] + i)));
    store(canvas.blue[block] + i, fma(lit, all(background[2]), load(canvas.blue[block] + i)));
    store(alpha[block] + i, 1.0f - rest);
  }
  store_colors(b, left, top, canvas);
  if (b.frame.depth) store_tile(b.frame.depth, left, top, b.view, canvas.depth);
  if (b.frame.alpha) store_tile(b.frame.alpha, left, top, b.view, alpha);
  if (!b.frame.max_id) return;
  store_tile(b.frame.median_depth, left, top, b.view, canvas.median);
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) { b.frame.max_id[at] = static_cast<int32_t>(canvas.best_id[block][pixel]); });
}

template <bool WithIds, bool WithShade>
void blend_tile(const SessionBlend& b, int tile) {
  const int left = tile % b.tiles.columns * kTile, top = tile / b.tiles.columns * kTile;
  alignas(64) float shade[16][16];
  Canvas canvas;
  Batch batch;
  clear(canvas, WithIds);
  if (WithShade) load_tile(b.frame.shade, left, top, b.view, shade);
  Cursors c = {b.still.begin[tile], b.still.begin[tile + 1], b.tiles.begin[tile], b.tiles.begin[tile + 1]};
  uint32_t alive = blocks_on_image(left, top, b.view), still = 0;
  while (alive && fill_batch(b, c, static_cast<float>(left), static_cast<float>(top), alive, batch, still)) {
    uint32_t touched = 0;
    for (int block = 0; block < 16; ++block) touched |= static_cast<uint32_t>(batch.touching[block] != 0) << block;
    uint32_t light;
    if constexpr (WithShade) light = draw_batch<WithIds>(batch, canvas, touched, ShadePainter{shade, still});
    else light = draw_batch<WithIds>(batch, canvas, touched, Plain{});
    alive = (alive & ~touched) | light;
  }
  finish(b, left, top, WithShade ? shade : nullptr, canvas);
}

// Copies the tile's part of an image (H, W, channels).
template <class T>
void copy_tile(const SessionBlend& b, int left, int top, int channels, const T* from, T* to) {
  const int right = left + kTile < b.view.width ? left + kTile : b.view.width;
  for (int y = top; y < top + kTile && y < b.view.height; ++y) {
    const size_t at = (static_cast<size_t>(y) * b.view.width + left) * channels;
    memcpy(to + at, from + at, sizeof(T) * static_cast<size_t>(right - left) * channels);
  }
}

}  // namespace

void blend_session(const SessionBlend& b, int tile) {
  const bool ids = b.frame.max_id, shade = b.frame.shade;
  if (ids && shade) return blend_tile<true, true>(b, tile);
  if (ids) return blend_tile<true, false>(b, tile);
  if (shade) return blend_tile<false, true>(b, tile);
  blend_tile<false, false>(b, tile);
}

void show_still(const SessionBlend& b, int tile) {
  const int left = tile % b.tiles.columns * kTile, top = tile / b.tiles.columns * kTile;
  const StillImages& still = b.still_images;
  if (b.frame.depth) copy_tile(b, left, top, 1, still.depth, b.frame.depth);
  if (b.frame.alpha) copy_tile(b, left, top, 1, still.alpha, b.frame.alpha);
  if (b.frame.max_id) {
    copy_tile(b, left, top, 1, still.median_depth, b.frame.median_depth);
    copy_tile(b, left, top, 1, still.max_id, b.frame.max_id);
  }
  if (!b.frame.shade && !b.frame.rgb && still.rgb8) return copy_tile(b, left, top, 3, still.rgb8, b.frame.rgb8);
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  Canvas canvas;
  float(*planes[3])[16] = {canvas.red, canvas.green, canvas.blue};
  alignas(64) float shade[16][16];
  if (b.frame.shade) load_tile(b.frame.shade, left, top, b.view, shade);
  for (int channel = 0; channel < 3; ++channel) {
    load_tile(still.rgb + channel * plane, left, top, b.view, planes[channel]);
    if (!b.frame.shade) continue;
    for (int pixel = 0; pixel < 256; pixel += kLanes) {
      float* at = planes[channel][pixel / 16] + pixel % 16;
      store(at, load(at) * load(shade[pixel / 16] + pixel % 16));
    }
  }
  store_colors(b, left, top, canvas);
}

}  // namespace aomgen::AOMGEN_ISA
