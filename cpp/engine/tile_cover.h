// Which tiles a splat reaches: decided alike for every list of splats by tile.
#pragma once

#include <algorithm>
#include <cmath>

#include "../kernels/kernels.h"

namespace aomgen {

// Smallest exponent of the splat over the tile's rectangle of pixel centres, against the faintest drawn.
inline bool touches(const Splat& s, float left, float top) {
  const float x0 = left + 0.5f - s.x, x1 = x0 + (kTile - 1), y0 = top + 0.5f - s.y, y1 = y0 + (kTile - 1);
  const float near_x = std::min(std::max(0.0f, x0), x1), near_y = std::min(std::max(0.0f, y0), y1);
  const float on_x = std::min(std::max(near_x * s.best_dy_per_dx, y0), y1);
  const float on_y = std::min(std::max(near_y * s.best_dx_per_dy, x0), x1);
  const float vertical = near_x * (s.qxx * near_x + s.qxy * on_x) + s.qyy * on_x * on_x;
  const float horizontal = on_y * (s.qxx * on_y + s.qxy * near_y) + s.qyy * near_y * near_y;
  return std::min(vertical, horizontal) < s.log2_opacity - kMinLog2Alpha;
}

inline int tile_at(float position, int tiles) {  // clamped before the conversion, which must not overflow
  return static_cast<int>(std::min(std::max(std::floor(position * (1.0f / kTile)), 0.0f), static_cast<float>(tiles - 1)));
}

// Tiles x0..x1, y0..y1 of the box around a splat. In the only tile of a box it counts as touching.
struct TileBox {
  int x0, x1, y0, y1;
  bool single() const { return x0 == x1 && y0 == y1; }
  size_t count() const { return static_cast<size_t>(x1 - x0 + 1) * (y1 - y0 + 1); }
};

inline TileBox tile_box(const Splat& s, int columns, int rows) {
  return {tile_at(s.x - s.half_width, columns), tile_at(s.x + s.half_width, columns),
          tile_at(s.y - s.half_height, rows), tile_at(s.y + s.half_height, rows)};
}

}  // namespace aomgen
