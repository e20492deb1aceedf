// Geometry of one 16x16 tile: sixteen blocks of 4x4 pixels, one F each.
#pragma once

#include "declarations.h"

namespace aomgen::AOMGEN_ISA {

// Pixel centres of every block, and the centre of its first pixel, relative to the tile's corner.
struct TileGeometry {
  float x[16][16], y[16][16];
  float block_x[16], block_y[16];
};

constexpr TileGeometry make_tile_geometry() {
  TileGeometry t{};
  for (int block = 0; block < 16; ++block) {
    t.block_x[block] = 4 * (block % 4) + 0.5f;
    t.block_y[block] = 4 * (block / 4) + 0.5f;
    for (int pixel = 0; pixel < 16; ++pixel) {
      t.x[block][pixel] = t.block_x[block] + pixel % 4;
      t.y[block][pixel] = t.block_y[block] + pixel / 4;
    }
  }
  return t;
}
alignas(64) constexpr TileGeometry kTileGeometry = make_tile_geometry();

// Blocks of the tile in which the splat's alpha can reach 1/255; exact for the blocks' rectangles
// of pixel centres. x, y: the splat's centre relative to the tile's corner.
AOMGEN_INLINE uint32_t touched_blocks(const Splat& s, float x, float y) {
  const F qxx = all(s.qxx), qxy = all(s.qxy), qyy = all(s.qyy), limit = all(s.log2_opacity - kMinLog2Alpha);
  uint32_t touched = 0;
  for (int part = 0; part < kParts; ++part) {
    F left = load(kTileGeometry.block_x + part * kLanes) - x, top = load(kTileGeometry.block_y + part * kLanes) - y;
    F right = left + 3.0f, bottom = top + 3.0f;
    // The exponent is largest on one of the two edges nearest to the centre (or at the centre).
    F near_x = minimum(maximum(zeros(), left), right), near_y = minimum(maximum(zeros(), top), bottom);
    F on_x = clamp(near_x * s.best_dy_per_dx, top, bottom);
    F on_y = clamp(near_y * s.best_dx_per_dy, left, right);
    F vertical = fma(near_x, fma(qxx, near_x, qxy * on_x), qyy * on_x * on_x);
    F horizontal = fma(on_y, fma(qxx, on_y, qxy * near_y), qyy * near_y * near_y);
    touched |= bits(above(limit, minimum(vertical, horizontal))) << (part * kLanes);
  }
  return touched;
}

// Blocks of a tile that lie at least partly on the image.
AOMGEN_INLINE uint32_t blocks_on_image(int left, int top, const AomgenView& view) {
  uint32_t mask = 0;
  for (int block = 0; block < 16; ++block)
    if (left + 4 * (block % 4) < view.width && top + 4 * (block / 4) < view.height) mask |= 1u << block;
  return mask;
}

// A splat at the pixels of one register: its offset, its alpha before the limit, and where it is drawn.
// One function with explicit fused operations, so that every pass decides alike which pixels it touches.
struct Touch {
  F dx, dy, unclamped, alpha;
  M drawn;
};

AOMGEN_INLINE Touch touch(const Splat& s, F x, F y, F transmittance) {
  Touch t;
  t.dx = x - s.x;
  t.dy = y - s.y;
  F e = fnma(t.dx, fma(all(s.qxx), t.dx, s.qxy * t.dy), all(s.log2_opacity));
  e = fnma(s.qyy * t.dy, t.dy, e);
  t.drawn = above(e, all(kMinLog2Alpha)) & above(transmittance, all(kMinTransmittance));
  t.unclamped = exp2_inside(e);
  t.alpha = where(t.drawn, minimum(t.unclamped, all(kMaxAlpha)));
  return t;
}

// Asks for the tile's part of an image plane (H, W) before it is needed: sixteen separate cache lines.
template <bool ForWriting>
AOMGEN_INLINE void prefetch_tile(const float* plane, int left, int top, const AomgenView& view) {
  for (int y = top; y < top + kTile && y < view.height; ++y)
    __builtin_prefetch(plane + static_cast<size_t>(y) * view.width + left, ForWriting);
}

// Copies the tile's part of an image plane (H, W) into blocks; zero outside the image.
AOMGEN_INLINE void load_tile(const float* plane, int left, int top, const AomgenView& view, float blocks[16][16]) {
  const bool whole = left + kTile <= view.width && top + kTile <= view.height;
  for (int block = 0; block < 16; ++block)
    for (int row = 0; row < 4; ++row) {
      const int x = left + 4 * (block % 4), y = top + 4 * (block / 4) + row;
      float* to = blocks[block] + 4 * row;
      const float* from = plane + static_cast<size_t>(y) * view.width + x;
      if (whole) {
        memcpy(to, from, 4 * sizeof(float));
        continue;
      }
      for (int i = 0; i < 4; ++i) to[i] = y < view.height && x + i < view.width ? from[i] : 0.0f;
    }
}

// Copies blocks into the tile's part of an image plane (H, W).
AOMGEN_INLINE void store_tile(float* plane, int left, int top, const AomgenView& view, const float blocks[16][16]) {
  const bool whole = left + kTile <= view.width && top + kTile <= view.height;
  for (int block = 0; block < 16; ++block)
    for (int row = 0; row < 4; ++row) {
      const int x = left + 4 * (block % 4), y = top + 4 * (block / 4) + row;
      const float* from = blocks[block] + 4 * row;
      float* to = plane + static_cast<size_t>(y) * view.width + x;
      if (whole) {
        memcpy(to, from, 4 * sizeof(float));
        continue;
      }
      for (int i = 0; i < 4; ++i)
        if (y < view.height && x + i < view.width) to[i] = from[i];
    }
}

}  // namespace aomgen::AOMGEN_ISA
