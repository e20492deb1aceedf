#include "binning.h"

#include <algorithm>
#include <stdexcept>

#include "thread_pool.h"
#include "tile_cover.h"

namespace aomgen {

namespace {

constexpr uint32_t kChunk = 4096;         // splats of one task, more on gigantic images
constexpr uint64_t kMaxCursors = 1 << 27;  // (chunk, tile) pairs
constexpr size_t kReport = 1 << 16;        // entries after which a task looks at the sum of all

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
    const size_t before = found, most = tiles_of_box(s);
    if (touched.size() < found + most) touched.resize(2 * (found + most) + kChunk);
    const bool surely = touches_its_box(s);
    for (int y = s.first_row; y <= s.last_row; ++y)
      for (int x = s.first_column; x <= s.last_column; ++x) {
        // Always written, counted only when touched: one branch less that the machine cannot foresee.
        const bool is_touched = surely || touches(s, static_cast<float>(x * kTile), static_cast<float>(y * kTile));
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
