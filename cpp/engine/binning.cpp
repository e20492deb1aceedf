#include "binning.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "thread_pool.h"

namespace aomgen {

namespace {

constexpr uint32_t kChunk = 4096;         // splats of one task, more on gigantic images
constexpr uint64_t kMaxCursors = 1 << 27;  // (chunk, tile) pairs
constexpr size_t kReport = 1 << 16;        // entries after which a task looks at the sum of all

// Smallest exponent of the splat over the tile's rectangle of pixel centres, against the faintest drawn.
bool touches(const Splat& s, float left, float top) {
  const float x0 = left + 0.5f - s.x, x1 = x0 + (kTile - 1), y0 = top + 0.5f - s.y, y1 = y0 + (kTile - 1);
  const float near_x = std::min(std::max(0.0f, x0), x1), near_y = std::min(std::max(0.0f, y0), y1);
  const float on_x = std::min(std::max(near_x * s.best_dy_per_dx, y0), y1);
  const float on_y = std::min(std::max(near_y * s.best_dx_per_dy, x0), x1);
  const float vertical = near_x * (s.qxx * near_x + s.qxy * on_x) + s.qyy * on_x * on_x;
  const float horizontal = on_y * (s.qxx * on_y + s.qxy * near_y) + s.qyy * near_y * near_y;
  return std::min(vertical, horizontal) < s.log2_opacity - kMinLog2Alpha;
}

int tile_at(float position, int tiles) {  // clamped before the conversion, which must not overflow
  return static_cast<int>(std::min(std::max(std::floor(position * (1.0f / kTile)), 0.0f), static_cast<float>(tiles - 1)));
}

}  // namespace

TileLists TileBinner::bin(const DepthOrder& order, int width, int height, int threads) {
  columns_ = (width + kTile - 1) / kTile;
  rows_ = (height + kTile - 1) / kTile;
  splat_count_ = order.block_begin.back();
  chunk_size_ = kChunk;
  while ((splat_count_ / chunk_size_ + 1) * static_cast<uint64_t>(columns_) * rows_ > kMaxCursors) chunk_size_ *= 2;
  chunks_ = static_cast<int>((splat_count_ + chunk_size_ - 1) / chunk_size_);
  found_ = 0;
  if (touched_.size() < static_cast<size_t>(chunks_)) touched_.resize(chunks_);
  cursors_.reserve(static_cast<size_t>(chunks_) * columns_ * rows_);
  const size_t slots = (order.block_begin.size() - 1) * kProjectionBlock;
  entry_begin_.reserve(slots);
  entry_counts_.reserve(slots);
  parallel(threads, chunks_, 1, [&](int64_t chunk, int) { find_tiles(order, static_cast<int>(chunk)); });
  place_chunks(order);
  slots_.reserve(total_);
  entries_.reserve(total_);
  parallel(threads, chunks_, 1, [&](int64_t chunk, int) { fill_lists(order, static_cast<int>(chunk)); });
  return {columns_, rows_, begin_.data(), slots_.data()};
}

void TileBinner::find_tiles(const DepthOrder& order, int chunk) {
  uint32_t* counts = cursors_.data() + static_cast<size_t>(chunk) * columns_ * rows_;
  std::fill(counts, counts + static_cast<size_t>(columns_) * rows_, 0u);
  std::vector<uint32_t>& touched = touched_[chunk];
  const uint32_t first = chunk * chunk_size_, last = std::min(splat_count_, first + chunk_size_);
  size_t found = 0, reported = 0;
  for (uint32_t rank = first; rank < last; ++rank) {
    if (rank + 8 < last) __builtin_prefetch(&order.splats[order.slots[rank + 8]]);
    const Splat& s = order.splats[order.slots[rank]];
    const int x0 = tile_at(s.x - s.half_width, columns_), x1 = tile_at(s.x + s.half_width, columns_);
    const int y0 = tile_at(s.y - s.half_height, rows_), y1 = tile_at(s.y + s.half_height, rows_);
    const bool single = x0 == x1 && y0 == y1;
    const size_t before = found, most = static_cast<size_t>(x1 - x0 + 1) * (y1 - y0 + 1);
    if (touched.size() < found + most) touched.resize(2 * (found + most) + kChunk);
    for (int y = y0; y <= y1; ++y)
      for (int x = x0; x <= x1; ++x) {
        // Always written, counted only when touched: one branch less that the machine cannot foresee.
        const bool is_touched = single || touches(s, static_cast<float>(x * kTile), static_cast<float>(y * kTile));
        const uint32_t tile = static_cast<uint32_t>(y * columns_ + x);
        touched[found] = tile;
        found += is_touched;
        counts[tile] += is_touched;
      }
    entry_counts_.data()[order.slots[rank]] = static_cast<uint32_t>(found - before);
    if (found - reported < kReport) continue;
    if ((found_ += found - reported) > kMaxEntries) return;  // place_chunks will refuse
    reported = found;
  }
  found_ += found - reported;
  touched.resize(found);
}

void TileBinner::place_chunks(const DepthOrder& order) {
  total_ = 0;
  if (found_ > kMaxEntries) {
    touched_.clear();  // a failed pass keeps no memory
    throw std::length_error("too many (Gaussian, tile) pairs; the Gaussians are too large on the image");
  }
  total_ = static_cast<uint32_t>(found_);
  const int tiles = columns_ * rows_;
  uint32_t* begin = begin_.reserve(tiles + 1);
  uint32_t sum = 0;
  for (int tile = 0; tile < tiles; ++tile) {
    begin[tile] = sum;
    for (int chunk = 0; chunk < chunks_; ++chunk) {
      uint32_t& cursor = cursors_.data()[static_cast<size_t>(chunk) * tiles + tile];
      const uint32_t size = cursor;
      cursor = sum;
      sum += size;
    }
  }
  begin[tiles] = sum;
  uint32_t before = 0;
  for (size_t block = 0; block + 1 < order.block_begin.size(); ++block) {
    const uint32_t first = static_cast<uint32_t>(block) * kProjectionBlock;
    const uint32_t last = first + order.block_begin[block + 1] - order.block_begin[block];
    for (uint32_t slot = first; slot < last; ++slot) {
      entry_begin_.data()[slot] = before;
      before += entry_counts_.data()[slot];
    }
  }
}

void TileBinner::fill_lists(const DepthOrder& order, int chunk) {
  uint32_t* cursors = cursors_.data() + static_cast<size_t>(chunk) * columns_ * rows_;
  const uint32_t* tile = touched_[chunk].data();
  const uint32_t first = chunk * chunk_size_, last = std::min(splat_count_, first + chunk_size_);
  for (uint32_t rank = first; rank < last; ++rank) {
    const uint32_t slot = order.slots[rank], begin = entry_begin_.data()[slot], count = entry_counts_.data()[slot];
    for (uint32_t place = begin; place < begin + count; ++place) {
      const uint32_t entry = cursors[*tile++]++;
      slots_.data()[entry] = slot;
      entries_.data()[place] = entry;
    }
  }
}

}  // namespace aomgen
