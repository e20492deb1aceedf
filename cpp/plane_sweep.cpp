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
#include <vector>

// The thread sanitizer is not awake yet when the loader chooses a clone.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_THREAD__)
#define AOMGEN_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define AOMGEN_CLONES
#endif

namespace {

// Where the pixels of one row, seen through one plane, are in a source: the index of the upper left of four pixels and the
// shares of the right and lower ones; `inside` is 0, and the index valid, where the pixel leaves the source.
AOMGEN_CLONES
void locate_row(const float* rotation, const float* translation, float inverse_depth, int y, int width, int height,
                int32_t* index, float* right, float* lower, float* inside) {
  const float shift_x = translation[0] * inverse_depth, shift_y = translation[1] * inverse_depth,
              shift_z = translation[2] * inverse_depth;
  const float limit_x = static_cast<float>(width - 1), limit_y = static_cast<float>(height - 1);
  const float v = y + 0.5f;
  const float row_x = rotation[1] * v + rotation[2] + shift_x, row_y = rotation[4] * v + rotation[5] + shift_y,
              row_z = rotation[7] * v + rotation[8] + shift_z;
  for (int x = 0; x < width; ++x) {
    const float u = x + 0.5f;
    const float z = rotation[6] * u + row_z;
    const float scale = 1.0f / (z > 1e-6f ? z : 1e-6f);
    const float px = (rotation[0] * u + row_x) * scale - 0.5f, py = (rotation[3] * u + row_y) * scale - 0.5f;
    const bool hit = (z > 1e-6f) & (px >= 0.0f) & (py >= 0.0f) & (px < limit_x) & (py < limit_y);
    const float qx = hit ? px : 0.0f, qy = hit ? py : 0.0f;
    const int32_t ix = static_cast<int32_t>(qx), iy = static_cast<int32_t>(qy);
    index[x] = iy * width + ix;
    right[x] = qx - static_cast<float>(ix);
    lower[x] = qy - static_cast<float>(iy);
    inside[x] = hit ? 1.0f : 0.0f;
  }
}

// Reads a source bilinearly at the locations of a row; 0 where a pixel leaves it.
AOMGEN_CLONES
void read_row(const float* source, int width, const int32_t* __restrict index, const float* __restrict right,
              const float* __restrict lower, const float* __restrict inside, float* __restrict warped) {
  const float* below = source + width;
  for (int x = 0; x < width; ++x) {
    const int32_t at = index[x];
    const float top = source[at] + right[x] * (source[at + 1] - source[at]);
    const float bottom = below[at] + right[x] * (below[at + 1] - below[at]);
    warped[x] = inside[x] > 0.0f ? top + lower[x] * (bottom - top) : 0.0f;
  }
}

// The images whose window sums give the correlation: inside, r, r^2, w, w^2 and r w, where r is the reference inside the
// source and w the warped source.
constexpr int kSums = 6;

// Completes one row of these images from `inside` and `w`.
AOMGEN_CLONES
void multiply_row(const float* reference, int width, float* const* rows) {
  const float *__restrict inside = rows[0], *__restrict w = rows[3];
  float *__restrict r = rows[1], *__restrict rr = rows[2], *__restrict ww = rows[4], *__restrict rw = rows[5];
  for (int x = 0; x < width; ++x) {
    const float seen = reference[x] * inside[x];
    r[x] = seen;
    rr[x] = seen * reference[x];
    ww[x] = w[x] * w[x];
    rw[x] = seen * w[x];
  }
}

// Sums of 2 radius + 1 neighbors; `row` has `radius` zeros at both ends.
AOMGEN_CLONES
void sum_along_row(const float* row, int width, int radius, float* sums) {
  std::fill(sums, sums + width, 0.0f);
  for (int offset = 0; offset <= 2 * radius; ++offset)
    for (int x = 0; x < width; ++x) sums[x] += row[x + offset];
}

AOMGEN_CLONES
void add(const float* values, int size, float* sums) {
  for (int i = 0; i < size; ++i) sums[i] += values[i];
}

// Correlation of reference and warped windows from their sums; -1 where too little is inside.
AOMGEN_CLONES
void correlate(const float* sums, int size, float full, float noise2, float* correlation) {
  const float *count = sums, *r = sums + size, *rr = sums + 2 * size, *w = sums + 3 * size, *ww = sums + 4 * size,
              *rw = sums + 5 * size;
  for (int i = 0; i < size; ++i) {
    const float inverse = 1.0f / std::max(count[i], 1.0f);
    const float mean_r = r[i] * inverse, mean_w = w[i] * inverse;
    const float var_r = std::max(rr[i] * inverse - mean_r * mean_r, 0.0f) + noise2;
    const float var_w = std::max(ww[i] * inverse - mean_w * mean_w, 0.0f) + noise2;
    const float value = (rw[i] * inverse - mean_r * mean_w) / std::sqrt(var_r * var_w);
    correlation[i] = count[i] >= full ? value : -1.0f;
  }
}

// Exchanges values so that `larger` has the larger one of each pair.
AOMGEN_CLONES
void sort_pairs(float* larger, float* smaller, int size) {
  for (int i = 0; i < size; ++i) {
    const float high = std::max(larger[i], smaller[i]), low = std::min(larger[i], smaller[i]);
    larger[i] = high;
    smaller[i] = low;
  }
}

// Cost of the mean of `count` correlations, (count, size).
AOMGEN_CLONES
void mean_cost(const float* correlations, int count, int size, uint8_t* cost) {
  const float share = 127.5f / count;
  for (int i = 0; i < size; ++i) {
    float sum = 0.0f;
    for (int k = 0; k < count; ++k) sum += correlations[static_cast<size_t>(k) * size + i];
    cost[i] = static_cast<uint8_t>(std::min(255.0f, std::max(0.0f, 127.5f - sum * share)));
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
// Planes whose costs are written together, a pixel's in one cache line.
constexpr int kPlanesTogether = 64;

bool valid(const AomgenSweep& s) {
  return s.width > 1 && s.width <= kMaxSide && s.height > 1 && s.height <= kMaxSide && s.source_count >= 1 &&
         s.source_count <= 16 && s.plane_count >= 2 && s.plane_count <= 256 && s.reference && s.sources &&
         s.rotations && s.translations && std::isfinite(s.first_inverse_depth) && s.inverse_depth_step > 0 &&
         std::isfinite(s.inverse_depth_step) && s.window_radius >= 1 && s.window_radius <= 8 && s.best_sources >= 1 &&
         s.best_sources <= s.source_count && s.noise > 0 && s.noise <= 1 && s.small_jump_penalty >= 0 &&
         s.small_jump_penalty <= 1000 && s.large_jump_penalty >= 0 && s.large_jump_penalty <= 1000;
}

// Correlations of one source seen through one plane, row by row: the sums along the last rows are in a ring.
class Correlator {
 public:
  explicit Correlator(const AomgenSweep& sweep)
      : sweep_(sweep),
        stride_(sweep.width + 2 * sweep.window_radius),
        images_(static_cast<size_t>(kSums) * stride_, 0.0f),
        ring_(static_cast<size_t>(diameter()) * row_size()),
        sums_(row_size()),
        right_(sweep.width),
        lower_(sweep.width),
        index_(sweep.width) {}

  // Calls `use(y, correlation)` with each row of correlations, which the callee may change.
  template <typename Use>
  void run(int source, float inverse_depth, float* correlation, Use use) {
    const int radius = sweep_.window_radius, height = sweep_.height;
    const float full = 0.75f * diameter() * diameter();
    for (int y = 0; y < height + radius; ++y) {
      if (y < height) sum_row(source, inverse_depth, y);
      const int center = y - radius;
      if (center < 0) continue;
      std::fill(sums_.begin(), sums_.end(), 0.0f);
      for (int row = std::max(0, center - radius); row <= std::min(height - 1, center + radius); ++row)
        add(at(row), row_size(), sums_.data());
      correlate(sums_.data(), sweep_.width, full, sweep_.noise * sweep_.noise, correlation);
      use(center, correlation);
    }
  }

 private:
  int diameter() const { return 2 * sweep_.window_radius + 1; }
  int row_size() const { return kSums * sweep_.width; }
  float* at(int row) { return &ring_[static_cast<size_t>(row % diameter()) * row_size()]; }

  void sum_row(int source, float inverse_depth, int y) {
    const int width = sweep_.width, radius = sweep_.window_radius;
    float* rows[kSums];
    for (int n = 0; n < kSums; ++n) rows[n] = &images_[static_cast<size_t>(n) * stride_ + radius];
    locate_row(sweep_.rotations + 9 * source, sweep_.translations + 3 * source, inverse_depth, y, width,
               sweep_.height, index_.data(), right_.data(), lower_.data(), rows[0]);
    read_row(sweep_.sources + static_cast<size_t>(source) * width * sweep_.height, width, index_.data(),
             right_.data(), lower_.data(), rows[0], rows[3]);
    multiply_row(sweep_.reference + static_cast<size_t>(y) * width, width, rows);
    for (int n = 0; n < kSums; ++n) sum_along_row(rows[n] - radius, width, radius, at(y) + n * width);
  }

  const AomgenSweep& sweep_;
  const int stride_;
  std::vector<float> images_, ring_, sums_, right_, lower_;
  std::vector<int32_t> index_;
};

// Matching costs (H, W, D): 0 = all good sources agree, 255 = they contradict.
void matching_costs(const AomgenSweep& s, std::vector<uint8_t>& cost) {
  const int width = s.width, size = width * s.height, planes = s.plane_count;
  Correlator correlator(s);
  // Largest correlations of each pixel in descending order, (best_sources, H, W), and costs of some planes, (B, H, W).
  std::vector<float> best(static_cast<size_t>(s.best_sources) * size), correlation(width);
  std::vector<uint8_t> costs(static_cast<size_t>(kPlanesTogether) * size);
  for (int first = 0; first < planes; first += kPlanesTogether) {
    const int together = std::min(kPlanesTogether, planes - first);
    for (int n = 0; n < together; ++n) {
      std::fill(best.begin(), best.end(), -1.0f);
      for (int k = 0; k < s.source_count; ++k)
        correlator.run(k, s.first_inverse_depth + (first + n) * s.inverse_depth_step, correlation.data(),
                       [&](int y, float* found) {
                         for (int rank = 0; rank < s.best_sources; ++rank)
                           sort_pairs(&best[static_cast<size_t>(rank) * size + y * width], found, width);
                       });
      mean_cost(best.data(), s.best_sources, size, &costs[static_cast<size_t>(n) * size]);
    }
    for (int i = 0; i < size; ++i)
      for (int n = 0; n < together; ++n)
        cost[static_cast<size_t>(i) * planes + first + n] = costs[static_cast<size_t>(n) * size + i];
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
