// Which splats touch which tile, near to far.
#pragma once

#include <vector>

#include "../kernels/kernels.h"
#include "buffer.h"

namespace aomgen {

class TileBinner {
 public:
  // Lists for splats that are sorted by depth. Throws std::length_error above kMaxEntries.
  TileLists bin(const Splat* splats, uint32_t count, int width, int height, int threads);
  // By rank: first slot of the splat's entries, (count + 1).
  const uint32_t* slot_begin() const { return slot_begin_.data(); }
  uint32_t entry_count() const { return entry_count_; }

  static constexpr uint64_t kMaxEntries = 400'000'000;

 private:
  void find_tiles(const Splat* splats, int chunk);
  void place_chunks();
  void fill_lists(int chunk);

  int columns_ = 0, rows_ = 0, chunks_ = 0;
  uint32_t splat_count_ = 0, entry_count_ = 0;
  std::vector<std::vector<uint32_t>> touched_;  // by chunk: tiles of its splats, one splat after the other
  Buffer<uint32_t> cursors_;                    // (chunks, tiles): counts, then places in the lists
  Buffer<uint32_t> begin_, splats_, slots_, slot_begin_;
};

}  // namespace aomgen
