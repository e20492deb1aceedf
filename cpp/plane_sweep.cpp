// Plane sweep stereo with semi-global aggregation.
//
// Source views are warped onto fronto-parallel planes spaced evenly in inverse depth and compared
// with the reference by zero-mean normalised cross-correlation (Collins, "A space-sweep approach to
// true multi-image matching", 1996). Costs are then aggregated along eight directions (Hirschmueller,
// "Stereo processing by semiglobal matching", 2008), which carries depth into plain areas.
#include "plane_sweep.h"

#include <algorithm>
#include <cmath>
#include <exception>
#include <functional>
#include <vector>

// The thread sanitizer is not awake yet when the loader chooses a clone.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_THREAD__)
#define AOMGEN_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define AOMGEN_CLONES
#endif

namespace {

using Plane = std::vector<float>;

// Window sums of a (height, width) image, windows cut at the border.
AOMGEN_CLONES
void box_sum(const float* image, int width, int height, int radius, float* scratch, float* sums) {
  for (int y = 0; y < height; ++y) {
    const float* row = image + y * width;
    float* out = scratch + y * width;
    std::fill(out, out + width, 0.0f);
    for (int offset = -radius; offset <= radius; ++offset) {
      const int begin = std::max(0, -offset), end = std::min(width, width - offset);
      for (int x = begin; x < end; ++x) out[x] += row[x + offset];
    }
  }
  for (int y = 0; y < height; ++y) {
    float* out = sums + y * width;
    std::fill(out, out + width, 0.0f);
    for (int row = std::max(0, y - radius); row <= std::min(height - 1, y + radius); ++row) {
      const float* in = scratch + row * width;
      for (int x = 0; x < width; ++x) out[x] += in[x];
    }
  }
}

// One source seen through one plane; `inside` is 0 where the pixel leaves the source.
AOMGEN_CLONES
void warp(const float* source, const float* rotation, const float* translation, float inverse_depth,
          int width, int height, float* warped, float* inside) {
  const float shift_x = translation[0] * inverse_depth, shift_y = translation[1] * inverse_depth,
              shift_z = translation[2] * inverse_depth;
  const float limit_x = static_cast<float>(width - 1), limit_y = static_cast<float>(height - 1);
  for (int y = 0; y < height; ++y) {
    const float v = y + 0.5f;
    const float row_x = rotation[1] * v + rotation[2] + shift_x, row_y = rotation[4] * v + rotation[5] + shift_y,
                row_z = rotation[7] * v + rotation[8] + shift_z;
    for (int x = 0; x < width; ++x) {
      const float u = x + 0.5f;
      const float z = rotation[6] * u + row_z;
      const float scale = 1.0f / (z > 1e-6f ? z : 1e-6f);
      const float px = (rotation[0] * u + row_x) * scale - 0.5f, py = (rotation[3] * u + row_y) * scale - 0.5f;
      const bool hit = z > 1e-6f && px >= 0.0f && py >= 0.0f && px < limit_x && py < limit_y;
      const float qx = hit ? px : 0.0f, qy = hit ? py : 0.0f;
      const int ix = static_cast<int>(qx), iy = static_cast<int>(qy);
      const float fx = qx - ix, fy = qy - iy;
      const float* at = source + iy * width + ix;
      const float top = at[0] + fx * (at[1] - at[0]);
      const float bottom = at[width] + fx * (at[width + 1] - at[width]);
      warped[y * width + x] = hit ? top + fy * (bottom - top) : 0.0f;
      inside[y * width + x] = hit ? 1.0f : 0.0f;
    }
  }
}

// Correlation of reference and warped windows from their sums; -1 where too little is inside.
AOMGEN_CLONES
void correlate(const float* count, const float* r, const float* rr, const float* w, const float* ww,
               const float* rw, int size, float full, float noise2, float* correlation) {
  for (int i = 0; i < size; ++i) {
    const float inverse = 1.0f / std::max(count[i], 1.0f);
    const float mean_r = r[i] * inverse, mean_w = w[i] * inverse;
    const float var_r = std::max(rr[i] * inverse - mean_r * mean_r, 0.0f) + noise2;
    const float var_w = std::max(ww[i] * inverse - mean_w * mean_w, 0.0f) + noise2;
    const float value = (rw[i] * inverse - mean_r * mean_w) / std::sqrt(var_r * var_w);
    correlation[i] = count[i] >= full ? value : -1.0f;
  }
}

// Adds one direction's path costs to `total`. `before` is the aggregated cost at the previous pixel.
AOMGEN_CLONES
void step(const uint8_t* cost, const uint16_t* before, uint16_t before_min, int planes, uint16_t small,
          uint16_t large, uint16_t* path, uint16_t* path_min, uint16_t* total) {
  // `before` has one guard cell on each side that never wins.
  const uint16_t jump = static_cast<uint16_t>(before_min + large);
  uint16_t least = 0xffff;
  for (int d = 0; d < planes; ++d) {
    const uint16_t side = std::min(before[d - 1], before[d + 1]);
    uint16_t best = std::min(before[d], static_cast<uint16_t>(side + small));
    best = std::min(best, jump);
    const uint16_t value = static_cast<uint16_t>(cost[d] + best - before_min);
    path[d] = value;
    total[d] = static_cast<uint16_t>(total[d] + value);
    least = std::min(least, value);
  }
  *path_min = least;
}

// All eight directions, as two passes of four over the image.
void aggregate(const AomgenSweep& sweep, const std::vector<uint8_t>& cost, std::vector<uint16_t>& total) {
  const int width = sweep.width, height = sweep.height, planes = sweep.plane_count;
  const int cell = planes + 2;  // with guard cells
  const uint16_t small = static_cast<uint16_t>(sweep.small_jump_penalty);
  const uint16_t guard = 0x7fff;
  const int back_x[4] = {-1, -1, 0, 1}, back_y[4] = {0, -1, -1, -1};
  for (int pass = 0; pass < 2; ++pass) {
    const int sign = pass == 0 ? 1 : -1;
    std::vector<uint16_t> rows[2], least[2];
    for (int k = 0; k < 2; ++k) {
      rows[k].assign(static_cast<size_t>(width) * 4 * cell, guard);
      least[k].assign(static_cast<size_t>(width) * 4, 0);
    }
    const std::vector<uint16_t> nothing(cell, 0);
    for (int j = 0; j < height; ++j) {
      const int y = pass == 0 ? j : height - 1 - j;
      const int now = j & 1;
      for (int i = 0; i < width; ++i) {
        const int x = pass == 0 ? i : width - 1 - i;
        const size_t pixel = static_cast<size_t>(y) * width + x;
        for (int k = 0; k < 4; ++k) {
          const int px = x + sign * back_x[k], row = back_y[k] == 0 ? now : 1 - now;
          const bool exists = px >= 0 && px < width && (back_y[k] == 0 || j > 0);
          const size_t from = static_cast<size_t>(px) * 4 + k;
          const uint16_t* before = exists ? &rows[row][from * cell + 1] : &nothing[1];
          const uint16_t before_min = exists ? least[row][from] : 0;
          // Depth may jump where the image does.
          const size_t other = exists ? (static_cast<size_t>(y + sign * back_y[k]) * width + px) : pixel;
          const float edge = std::fabs(sweep.reference[pixel] - sweep.reference[other]) * 255.0f;
          // In this order the maximum with NaN, of images that hold NaN, is the number.
          const float large = std::max(sweep.small_jump_penalty * 1.25f,
                                       sweep.large_jump_penalty / (1.0f + edge / 8.0f));
          const size_t to = static_cast<size_t>(x) * 4 + k;
          step(&cost[pixel * planes], before, before_min, planes, small, static_cast<uint16_t>(large),
               &rows[now][to * cell + 1], &least[now][to], &total[pixel * planes]);
        }
      }
    }
  }
}

constexpr int kMaxSide = 16384;

bool valid(const AomgenSweep& s) {
  return s.width > 1 && s.width <= kMaxSide && s.height > 1 && s.height <= kMaxSide && s.source_count >= 1 &&
         s.source_count <= 16 && s.plane_count >= 2 && s.plane_count <= 256 && s.reference && s.sources &&
         s.rotations && s.translations && std::isfinite(s.first_inverse_depth) && s.inverse_depth_step > 0 &&
         std::isfinite(s.inverse_depth_step) && s.window_radius >= 1 && s.window_radius <= 8 && s.best_sources >= 1 &&
         s.best_sources <= s.source_count && s.noise > 0 && s.noise <= 1 && s.small_jump_penalty >= 0 &&
         s.small_jump_penalty <= 1000 && s.large_jump_penalty >= 0 && s.large_jump_penalty <= 1000;
}

// Matching costs (H, W, D): 0 = all good sources agree, 255 = they contradict.
void matching_costs(const AomgenSweep& s, std::vector<uint8_t>& cost) {
  const int width = s.width, height = s.height, size = width * height, planes = s.plane_count;
  Plane warped(size), inside(size), masked(size), masked2(size), product(size), warped2(size), scratch(size);
  Plane count(size), r(size), rr(size), w(size), ww(size), rw(size);
  std::vector<Plane> correlation(s.source_count, Plane(size));
  const float diameter = 2.0f * s.window_radius + 1.0f, full = 0.75f * diameter * diameter;
  std::vector<float> ranked(s.source_count);
  for (int plane = 0; plane < planes; ++plane) {
    const float inverse_depth = s.first_inverse_depth + plane * s.inverse_depth_step;
    for (int k = 0; k < s.source_count; ++k) {
      warp(s.sources + static_cast<size_t>(k) * size, s.rotations + 9 * k, s.translations + 3 * k, inverse_depth,
           width, height, warped.data(), inside.data());
      for (int i = 0; i < size; ++i) {
        masked[i] = s.reference[i] * inside[i];
        masked2[i] = masked[i] * s.reference[i];
        product[i] = masked[i] * warped[i];
        warped2[i] = warped[i] * warped[i];
      }
      const float* images[6] = {inside.data(), masked.data(), masked2.data(), warped.data(), warped2.data(),
                                product.data()};
      float* sums[6] = {count.data(), r.data(), rr.data(), w.data(), ww.data(), rw.data()};
      for (int n = 0; n < 6; ++n) box_sum(images[n], width, height, s.window_radius, scratch.data(), sums[n]);
      correlate(count.data(), r.data(), rr.data(), w.data(), ww.data(), rw.data(), size, full,
                s.noise * s.noise, correlation[k].data());
    }
    for (int i = 0; i < size; ++i) {
      for (int k = 0; k < s.source_count; ++k) ranked[k] = correlation[k][i];
      std::partial_sort(ranked.begin(), ranked.begin() + s.best_sources, ranked.end(), std::greater<float>());
      float mean = 0.0f;
      for (int k = 0; k < s.best_sources; ++k) mean += ranked[k];
      mean /= s.best_sources;
      cost[static_cast<size_t>(i) * planes + plane] =
          static_cast<uint8_t>(std::min(255.0f, std::max(0.0f, (1.0f - mean) * 127.5f)));
    }
  }
}

}  // namespace

extern "C" int32_t aomgen_plane_sweep(const AomgenSweep* sweep, float* inverse_depth, float* score) {
  if (sweep == nullptr || inverse_depth == nullptr || score == nullptr || !valid(*sweep)) return 1;
  try {
    const int size = sweep->width * sweep->height, planes = sweep->plane_count;
    std::vector<uint8_t> cost(static_cast<size_t>(size) * planes);
    std::vector<uint16_t> total(static_cast<size_t>(size) * planes, 0);
    matching_costs(*sweep, cost);
    aggregate(*sweep, cost, total);
    for (int i = 0; i < size; ++i) {
      const uint16_t* row = &total[static_cast<size_t>(i) * planes];
      const int best = static_cast<int>(std::min_element(row, row + planes) - row);
      float offset = 0.0f;  // vertex of the parabola through the best plane and its neighbours
      if (best > 0 && best < planes - 1) {
        const float left = row[best - 1], middle = row[best], right = row[best + 1];
        const float bend = left - 2.0f * middle + right;
        if (bend > 0.0f) offset = 0.5f * (left - right) / bend;
      }
      inverse_depth[i] = sweep->first_inverse_depth + (best + offset) * sweep->inverse_depth_step;
      score[i] = 1.0f - cost[static_cast<size_t>(i) * planes + best] / 127.5f;
    }
  } catch (const std::exception&) {  // std::bad_alloc, or std::length_error where sizes have few bits
    return 2;
  }
  return 0;
}
