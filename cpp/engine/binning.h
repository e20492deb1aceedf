// Which splats touch which tile, near to far.
#pragma once

#include <atomic>
#include <vector>

#include "../kernels/kernels.h"
#include "buffer.h"

namespace aomgen {

// Splats of a projection and their order.
struct DepthOrder {
  const Splat* splats;                       // by slot
  const uint32_t* slots;                     // near to far
  const std::vector<uint32_t>& block_begin;  // visible splats before each block of slots, and all of them
};

class TileBinner {
 public:
  // Throws std::length_error above kMaxEntries.
  TileLists bin(const DepthOrder& order, int width, int height, int threads);
  SplatEntries by_splat() const { return {entry_begin_.data(), entry_counts_.data(), entries_.data()}; }
  uint32_t entry_count() const { return total_; }

  static constexpr uint64_t kMaxEntries = 1 << 27;  // about 2 GB of lists, 9 GB in the backward pass

 private:
  void find_tiles(const DepthOrder& order, int chunk);
  void place_chunks(const DepthOrder& order);
  void fill_lists(const DepthOrder& order, int chunk);

  int columns_ = 0, rows_ = 0, chunks_ = 0;
  uint32_t splat_count_ = 0, chunk_size_ = 0, total_ = 0;
  std::atomic<uint64_t> found_{0};              // entries of all chunks so far
  std::vector<std::vector<uint32_t>> touched_;  // by chunk of the order: tiles of its splats, one splat after the other
  Buffer<uint32_t> cursors_;                    // (chunks, tiles): counts, then places in the lists
  Buffer<uint32_t> begin_, slots_, entries_, entry_begin_, entry_counts_;
};

}  // namespace aomgen
