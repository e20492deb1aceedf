// Tiles of a session's frame: blended anew from what never moves and what does, or shown as they were.
#include "canvas.h"

namespace aomgen::AOMGEN_ISA {

namespace {

constexpr uint32_t kNever = ~0u;  // behind every depth key

// Entries of what never moves that reach a block of interest, sorted out before they are merged.
struct Ready {
  static constexpr uint32_t kCount = 64;
  uint32_t keys[kCount + 1], rows[kCount + 1], blocks[kCount + 1];
  uint32_t count = 0, next = 0;
};

// Where a tile's two lists have been read to.
struct Cursors {
  uint32_t still, still_end, moving, moving_end, prefetched;
  Ready ready;
};

void make_ready(const SessionBlend& b, Cursors& c, uint32_t alive) {
  Ready& r = c.ready;
  r.count = r.next = 0;
  while (r.count == 0 && c.still < c.still_end) {
    const uint32_t end = c.still_end - c.still < Ready::kCount ? c.still_end : c.still + Ready::kCount;
    for (; c.still < end; ++c.still) {
      r.keys[r.count] = b.still.keys[c.still];
      r.rows[r.count] = b.still.rows[c.still];
      r.blocks[r.count] = b.still.blocks[c.still] & alive;
      r.count += r.blocks[r.count] != 0;
    }
  }
  for (uint32_t i = 0; i < r.count; ++i) __builtin_prefetch(&b.still.splats[r.rows[i]]);
  r.keys[r.count] = kNever;
}

// The next splats of both lists that reach a living block, near to far, what never moves first at equal
// depth. Returns how many; `still` gets the bits of those that never move. Without branches on which
// list is next, which the machine could not foresee.
template <bool WithIds>
int fill_batch(const SessionBlend& b, Cursors& c, float left, float top, uint32_t alive, Batch& batch, uint32_t& still) {
  uint8_t masks[2][kBatch] = {};
  int count = 0;
  still = 0;
  for (; c.prefetched < c.moving + 2 * kBatch && c.prefetched < c.moving_end; ++c.prefetched) __builtin_prefetch(&b.splats[b.entries[c.prefetched].slot]);
  while (count < kBatch) {
    Ready& r = c.ready;
    if (r.next == r.count) make_ready(b, c, alive);
    const uint32_t moving_key = c.moving < c.moving_end ? b.entries[c.moving].key : kNever;
    const uint32_t still_key = r.keys[r.next];
    if ((moving_key & still_key) == kNever) break;
    const bool is_still = still_key <= moving_key;
    const Splat* s = is_still ? b.still.splats + r.rows[r.next] : b.splats + b.entries[c.moving].slot;
    const uint32_t blocks = (is_still ? r.blocks[r.next] : b.entries[c.moving].blocks) & alive;
    if (WithIds) batch.ids[count] = static_cast<uint32_t>(is_still ? b.still.gaussians[r.rows[r.next]] : b.first_moving + b.gaussians[b.entries[c.moving].slot]);
    r.next += is_still;
    c.moving += !is_still;
    batch.splats[count] = *s;
    batch.splats[count].x = s->x - left;
    batch.splats[count].y = s->y - top;
    masks[0][count] = static_cast<uint8_t>(blocks);
    masks[1][count] = static_cast<uint8_t>(blocks >> 8);
    const bool kept = blocks != 0;
    still |= static_cast<uint32_t>(is_still & kept) << count;
    count += kept;
  }
  transpose_masks(masks, batch.touching);
  return count;
}

struct ColorPainter : Plain {
  static constexpr bool kDepth = false;
};

// Darkens what never moves.
struct ShadePainter {
  static constexpr bool kDepth = true;
  const float (*shade)[16];
  uint32_t still;  // the batch's splats that never move

  __attribute__((always_inline)) F color_weight(int i, int block, int at, F weight) const {
    return still >> i & 1u ? weight * load(shade[block] + at) : weight;
  }
};

void store_rgb8(const SessionBlend& b, int left, int top, const Canvas& canvas) {
  alignas(64) uint8_t rows[16][3 * kTile];
  const float(*planes[3])[16] = {canvas.red, canvas.green, canvas.blue};
  for (int channel = 0; channel < 3; ++channel)
    for (int pixel = 0; pixel < 256; pixel += kLanes) {
      const int block = pixel / 16, i = pixel % 16;
      const F value = clamp(load(planes[channel][block] + i), zeros(), all(1.0f));
      const I rounded = __builtin_convertvector(fma(value, all(255.0f), all(0.5f)), I);
      for (int lane = 0; lane < kLanes; ++lane)
        rows[4 * (block / 4) + (i + lane) / 4][3 * (4 * (block % 4) + lane % 4) + channel] = static_cast<uint8_t>(rounded[lane]);
    }
  const int right = left + kTile < b.view.width ? left + kTile : b.view.width;
  for (int row = 0; row < kTile && top + row < b.view.height; ++row)
    memcpy(b.frame.rgb8 + 3 * (static_cast<size_t>(top + row) * b.view.width + left), rows[row], 3 * static_cast<size_t>(right - left));
}

void store_colors(const SessionBlend& b, int left, int top, const Canvas& canvas) {
  if (b.frame.rgb8) store_rgb8(b, left, top, canvas);
  if (b.frame.rgb) store_interleaved(b.frame.rgb, left, top, b.view, canvas);
}

// Puts what never moves into blocks outside `drawn`.
void fill_up(const SessionBlend& b, int left, int top, const float shade[16][16], uint32_t drawn, Canvas& canvas, float alpha[16][16]) {
  const size_t plane = static_cast<size_t>(b.view.width) * b.view.height;
  const float* from[] = {b.still_images.rgb, b.still_images.rgb + plane, b.still_images.rgb + 2 * plane, b.still_images.depth, b.still_images.alpha, b.still_images.median_depth};
  float(*to[])[16] = {canvas.red, canvas.green, canvas.blue, canvas.depth, alpha, canvas.median};
  const bool wanted[] = {true, true, true, b.frame.depth != nullptr, b.frame.alpha != nullptr, b.frame.max_id != nullptr};
  alignas(64) float pixels[16][16];
  for (int image = 0; image < 6; ++image) {
    if (!wanted[image]) continue;
    load_tile(from[image], left, top, b.view, pixels);
    for (uint32_t rest = ~drawn & 0xffffu; rest; rest &= rest - 1) {
      const int block = __builtin_ctz(rest);
      for (int i = 0; i < 16; i += kLanes) {
        const F value = load(pixels[block] + i);
        store(to[image][block] + i, shade && image < 3 ? value * load(shade[block] + i) : value);
      }
    }
  }
  if (!b.frame.max_id) return;
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) {
    if (!(drawn >> block & 1u)) canvas.best_id[block][pixel] = static_cast<float>(b.still_images.max_id[at]);
  });
}

void finish(const SessionBlend& b, int left, int top, const float shade[16][16], uint32_t drawn, Canvas& canvas) {
  alignas(64) float alpha[16][16];
  add_background(b.view.background, shade, canvas, alpha);
  if (drawn != 0xffffu) fill_up(b, left, top, shade, drawn, canvas, alpha);
  store_colors(b, left, top, canvas);
  if (b.frame.depth) store_tile(b.frame.depth, left, top, b.view, canvas.depth);
  if (b.frame.alpha) store_tile(b.frame.alpha, left, top, b.view, alpha);
  if (!b.frame.max_id) return;
  store_tile(b.frame.median_depth, left, top, b.view, canvas.median);
  for_each_pixel(b.view, left, top, [&](size_t at, int block, int pixel) { b.frame.max_id[at] = static_cast<int32_t>(canvas.best_id[block][pixel]); });
}

template <bool WithIds, bool WithShade>
void blend_tile(const SessionBlend& b, int tile) {
  const int left = tile % b.columns * kTile, top = tile / b.columns * kTile;
  const float x = static_cast<float>(left), y = static_cast<float>(top);
  Cursors c;
  c.still = b.still.begin[tile];
  c.still_end = b.still.begin[tile + 1];
  c.moving = c.prefetched = b.begin[tile];
  c.moving_end = b.begin[tile + 1];
  uint32_t drawn = 0;
  for (uint32_t k = c.moving; k < c.moving_end; ++k) drawn |= b.entries[k].blocks;
  alignas(64) float shade[16][16];
  Canvas canvas;
  Batch batch;
  clear(canvas, WithIds);
  if (WithShade) load_tile(b.frame.shade, left, top, b.view, shade);
  uint32_t alive = drawn, still = 0;
  while (alive && fill_batch<WithIds>(b, c, x, y, alive, batch, still)) {
    uint32_t touched = 0;
    for (int block = 0; block < 16; ++block) touched |= static_cast<uint32_t>(batch.touching[block] != 0) << block;
    uint32_t light;
    if constexpr (WithShade) light = draw_batch<WithIds, false>(batch, canvas, touched, ShadePainter{shade, still});
    else if (WithIds || b.frame.depth) light = draw_batch<WithIds, false>(batch, canvas, touched, Plain{});
    else light = draw_batch<false, false>(batch, canvas, touched, ColorPainter{});
    alive = (alive & ~touched) | light;
  }
  finish(b, left, top, WithShade ? shade : nullptr, drawn, canvas);
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

uint32_t find_tiles(const TileSearch& t, uint32_t slot, uint32_t last, uint32_t& found) {
  for (; slot < last; ++slot) {
    const Splat& s = t.splats[slot];
    const uint32_t begin = found;
    if (found + tiles_of_box(s) > t.capacity) return slot;
    const bool surely = touches_its_box(s);
    for (int row = s.first_row; row <= s.last_row; ++row)
      for (int column = s.first_column; column <= s.last_column; ++column) {
        const float left = static_cast<float>(column * kTile), top = static_cast<float>(row * kTile);
        const uint32_t tile = static_cast<uint32_t>(row * t.columns + column);
        const float* stops = t.stop_depths + 16 * static_cast<size_t>(tile);
        uint32_t in_front = 0;
        for (int part = 0; part < kParts; ++part) in_front |= bits(above(load(stops + part * kLanes), all(s.depth))) << (part * kLanes);
        const uint32_t blocks = touched_blocks(s, s.x - left, s.y - top) & in_front;
        t.tiles[found] = tile;
        t.blocks[found] = static_cast<uint16_t>(blocks);
        found += blocks != 0 && (surely || t.touches(s, left, top));
      }
    t.covers[slot].begin = begin;
    t.covers[slot].count = found - begin;
    memcpy(&t.covers[slot].key, &s.depth, sizeof(uint32_t));
  }
  return last;
}

void blend_session(const SessionBlend& b, int tile) {
  const bool ids = b.frame.max_id, shade = b.frame.shade;
  if (ids && shade) return blend_tile<true, true>(b, tile);
  if (ids) return blend_tile<true, false>(b, tile);
  if (shade) return blend_tile<false, true>(b, tile);
  blend_tile<false, false>(b, tile);
}

void show_still(const SessionBlend& b, int tile) {
  const int left = tile % b.columns * kTile, top = tile / b.columns * kTile;
  const StillImages& still = b.still_images;
  if (b.frame.depth) copy_tile(b, left, top, 1, still.depth, b.frame.depth);
  if (b.frame.alpha) copy_tile(b, left, top, 1, still.alpha, b.frame.alpha);
  if (b.frame.max_id) {
    copy_tile(b, left, top, 1, still.median_depth, b.frame.median_depth);
    copy_tile(b, left, top, 1, still.max_id, b.frame.max_id);
  }
  if (!b.frame.rgb && !b.frame.rgb8) return;
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
