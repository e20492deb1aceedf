#include "session.h"

#include <algorithm>
#include <cstring>
#include <limits>
#include <stdexcept>

#include "sort.h"
#include "thread_pool.h"
#include "tile_cover.h"

namespace aomgen {

namespace {

constexpr uint32_t kNever = ~0u;
constexpr uint64_t kMaxFrameEntries = 1 << 27;
constexpr uint32_t kReport = 1 << 16;  // tiles after which a task looks at the sum of all

uint32_t key_of(float depth) {
  uint32_t key;
  std::memcpy(&key, &depth, sizeof(key));
  return key;
}

// Whether the shade changes anything in a tile.
bool is_shaded(const AomgenFrame& frame, const AomgenView& view, int left, int top) {
  if (!frame.shade) return false;
  const int right = std::min(left + kTile, view.width), bottom = std::min(top + kTile, view.height);
  for (int y = top; y < bottom; ++y)
    for (int x = left; x < right; ++x)
      if (frame.shade[static_cast<size_t>(y) * view.width + x] != 1.0f) return true;
  return false;
}

}  // namespace

Session::Session(Context& context, const AomgenScene& scene, const AomgenView& view)
    : kernels_(*context.kernels()), view_(view), gaussian_count_(static_cast<int32_t>(scene.count)) {
  view_.cam_from_part = nullptr;  // the caller's; not kept
  view_.part_count = 0;
  const size_t pixels = static_cast<size_t>(view.width) * view.height;
  float* planes = planes_.reserve(6 * pixels);
  AomgenScene plain = scene;
  plain.feature_count = 0;
  plain.features = nullptr;
  context.forward(plain, view, {planes, 0, 1, planes + 3 * pixels, planes + 4 * pixels, planes + 5 * pixels, max_id_.reserve(pixels), nullptr});
  context.forget_forward();
  keep_lists(context);
  round_colors();
}

StillImages Session::images() const {
  const size_t pixels = static_cast<size_t>(view_.width) * view_.height;
  const float* planes = planes_.data();
  return {planes, planes + 3 * pixels, planes + 4 * pixels, planes + 5 * pixels, max_id_.data(), rgb8_.data()};
}

// Keeps the splats that draw anything, in the order of their first tile.
void Session::keep_lists(const Context& context) {
  const Projection& p = context.projection();
  const TileLists& tiles = context.tiles();
  const int count = tiles.columns * tiles.rows;
  std::vector<uint32_t> row_of_slot(static_cast<size_t>(block_count(p.scene.count)) * kProjectionBlock, kNever), slots;
  begin_.assign(1, 0);
  stop_depths_.assign(16 * static_cast<size_t>(count), std::numeric_limits<float>::infinity());
  for (int tile = 0; tile < count; ++tile) {
    for (uint32_t entry = tiles.begin[tile]; entry < tiles.begin[tile + 1]; ++entry) {
      const uint16_t blocks = context.block_masks()[entry];
      if (!blocks) continue;
      const uint32_t slot = tiles.slots[entry];
      uint32_t& row = row_of_slot[slot];
      if (row == kNever) {
        row = static_cast<uint32_t>(slots.size());
        slots.push_back(slot);
      }
      splat_rows_.push_back(row);
      keys_.push_back(key_of(p.splats[slot].depth));
      blocks_.push_back(blocks);
    }
    begin_.push_back(static_cast<uint32_t>(splat_rows_.size()));
    find_stops(context, tile);
  }
  Splat* splats = splats_.reserve(slots.size());
  gaussians_.resize(slots.size());
  for (size_t row = 0; row < slots.size(); ++row) {
    splats[row] = p.splats[slots[row]];
    gaussians_[row] = p.gaussians[slots[row]];
  }
}

// Where no light is left in a block, nothing can be seen behind the last splat drawn there; nothing
// at all where no pixel is on the image.
void Session::find_stops(const Context& context, int tile) {
  const int width = view_.width - tile % columns() * kTile, height = view_.height - tile / columns() * kTile;
  const TileSums& sums = context.tile_sums()[tile];
  for (int block = 0; block < 16; ++block) {
    bool on_image = false, finished = true;
    for (int pixel = 0; pixel < 16; ++pixel) {
      if (4 * (block % 4) + pixel % 4 >= width || 4 * (block / 4) + pixel / 4 >= height) continue;
      on_image = true;
      finished &= sums.transmittance[block][pixel] <= kMinTransmittance;
    }
    float& stop = stop_depths_[16 * static_cast<size_t>(tile) + block];
    if (!on_image) stop = 0;
    for (uint32_t entry = begin_[tile + 1]; on_image && finished && entry-- > begin_[tile];)
      if (blocks_[entry] >> block & 1) {
        std::memcpy(&stop, &keys_[entry], sizeof(stop));
        break;
      }
  }
}

void Session::round_colors() {
  SessionBlend b{};
  b.view = view_;
  b.columns = columns();
  b.still_images = images();
  b.still_images.rgb8 = nullptr;
  b.frame.rgb8 = rgb8_.reserve(3 * static_cast<size_t>(view_.width) * view_.height);
  for (int tile = 0; tile < columns() * rows(); ++tile) kernels_.show_still(b, tile);
}

void FrameScratch::project(const MovingScene& moving, const AomgenFrame& frame, int threads) {
  const Session& session = frame.session->session;
  const int blocks = block_count(moving.scene.count);
  const size_t capacity = static_cast<size_t>(blocks) * kProjectionBlock;
  PartPose* poses = poses_.reserve(moving.part_count);
  fill_part_poses(frame.cam_from_part, moving.part_count, poses);
  Projection& p = projection_;
  p = {moving.scene, session.view(), poses, frame.colors, moving.colored_count, splats_.reserve(capacity), gaussians_.reserve(capacity),
       depth_keys_.reserve(capacity), visible_.reserve(blocks)};
  p.view.part_count = moving.part_count;
  covers_.reserve(capacity);
  found_ = 0;
  if (found_tiles_.size() < static_cast<size_t>(blocks)) found_tiles_.resize(blocks);
  parallel(threads, blocks, 1, [&](int64_t block, int) {
    session.kernels().project(p, static_cast<int>(block));
    find_tiles(session, static_cast<int>(block));
  });
  if (found_ <= kMaxFrameEntries) return;
  found_tiles_.clear();  // a failed frame keeps no memory
  throw std::length_error("too many (Gaussian, tile) pairs; the Gaussians are too large on the image");
}

// Tiles of the block's splats in which they are in front of everything that hides them.
void FrameScratch::find_tiles(const Session& session, int block) {
  const uint32_t first = static_cast<uint32_t>(block) * kProjectionBlock, last = first + projection_.visible[block];
  Found& to = found_tiles_[block];
  uint32_t found = 0, reported = 0;
  for (uint32_t slot = first; slot < last;) {
    const size_t size = 2 * (found + tiles_of_box(projection_.splats[slot])) + kProjectionBlock;
    if (to.tiles.size() < size) {
      to.blocks.resize(size);  // first: when memory runs out here, the tiles still tell that both are short
      to.tiles.resize(size);
    }
    const TileSearch search{session.columns(), session.tiles().stop_depths, projection_.splats, touches, covers_.data(), to.tiles.data(), to.blocks.data(), to.tiles.size()};
    slot = session.kernels().find_tiles(search, slot, last, found);
    if ((found_ += found - reported) > kMaxFrameEntries) return;  // project will refuse
    reported = found;
  }
}

// Lists of the splats by tile, near to far, equal depths in the order of the scene.
void FrameScratch::fill_lists(const Session& session) {
  const int tiles = session.columns() * session.rows(), blocks = block_count(projection_.scene.count);
  const size_t capacity = static_cast<size_t>(blocks) * kProjectionBlock;
  const TileCover* covers = covers_.data();
  uint32_t* cursors = cursors_.reserve(tiles + 1);
  std::fill_n(cursors, tiles + 1, 0u);
  const SortArrays arrays = {keys_.reserve(capacity), ordered_.reserve(capacity), spare_keys_.reserve(capacity), spare_ordered_.reserve(capacity)};
  uint32_t count = 0;
  uint64_t total = 0;
  for (int block = 0; block < blocks; ++block) {
    const uint32_t first = static_cast<uint32_t>(block) * kProjectionBlock, last = first + projection_.visible[block];
    for (uint32_t slot = first; slot < last; ++slot) {
      arrays.keys[count] = covers[slot].key;
      arrays.values[count] = slot;
      count += covers[slot].count > 0;
    }
    const uint32_t size = first < last ? covers[last - 1].begin + covers[last - 1].count : 0;
    for (uint32_t i = 0; i < size; ++i) ++cursors[found_tiles_[block].tiles[i]];
    total += size;
  }
  uint32_t* begin = begin_.reserve(tiles + 1);
  uint32_t sum = 0;
  for (int tile = 0; tile <= tiles; ++tile) {
    begin[tile] = sum;
    sum += cursors[tile];
    cursors[tile] = begin[tile];
  }
  const uint32_t* order = sort_by_key(arrays, count);
  MovingEntry* entries = entries_.reserve(total);
  for (uint32_t rank = 0; rank < count; ++rank) {
    const uint32_t slot = order[rank];
    const TileCover& cover = covers[slot];
    const Found& from = found_tiles_[slot / kProjectionBlock];
    for (uint32_t i = cover.begin; i < cover.begin + cover.count; ++i) entries[cursors[from.tiles[i]]++] = {slot, cover.key, from.blocks[i]};
  }
}

void FrameScratch::draw(const MovingScene& moving, const AomgenFrame& frame, int threads) {
  const Session& session = frame.session->session;
  project(moving, frame, threads);
  fill_lists(session);
  const int columns = session.columns();
  const SessionBlend b{session.view(), session.images(), session.tiles(), columns, begin_.data(), entries_.data(),
                       projection_.splats, projection_.gaussians, session.gaussian_count(), frame};
  parallel(threads, static_cast<int64_t>(columns) * session.rows(), 4, [&](int64_t item, int) {
    const int tile = static_cast<int>(item);
    const bool touched = begin_.data()[tile] < begin_.data()[tile + 1];
    const bool shaded = is_shaded(frame, session.view(), tile % columns * kTile, tile / columns * kTile);
    if (touched) session.kernels().blend_session(b, tile);
    else if (shaded || frame.tiles[tile]) session.kernels().show_still(b, tile);
    frame.tiles[tile] = touched || shaded;
  });
}

void SessionDrawer::draw(const MovingScene& moving, const AomgenFrame* frames, int frame_count, int threads) {
  const int workers = std::max(1, std::min(threads, frame_count));
  if (scratches_.size() < static_cast<size_t>(workers)) scratches_ = std::vector<FrameScratch>(workers);
  if (frame_count == 1) return scratches_[0].draw(moving, frames[0], threads);
  parallel(threads, frame_count, 1, [&](int64_t i, int worker) { scratches_[worker].draw(moving, frames[i], 1); });
}

}  // namespace aomgen
