// Which tiles a splat reaches: decided alike for every list of splats by tile.
#pragma once

#include <algorithm>

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

}  // namespace aomgen
