// Frames of moving Gaussians in a scene that never moves, from a camera that never moves.
//
// Exact: what is left out of the lists cannot be drawn. A splat that draws nothing while only the scene
// that never moves is there draws nothing behind more splats either, because transmittance only falls
// (in float arithmetic too: it is multiplied by factors of at most one).
#pragma once

#include <atomic>
#include <vector>

#include "../kernels/kernels.h"
#include "buffer.h"
#include "context.h"

namespace aomgen {

// What never moves, as one camera sees it. Never changes after construction, so any number of threads
// may draw with it.
class Session {
 public:
  // Draws the scene with the context, whose last forward pass is lost.
  Session(Context& context, const AomgenScene& scene, const AomgenView& view);

  const Kernels& kernels() const { return kernels_; }
  const AomgenView& view() const { return view_; }
  int columns() const { return (view_.width + kTile - 1) / kTile; }
  int rows() const { return (view_.height + kTile - 1) / kTile; }
  int32_t gaussian_count() const { return gaussian_count_; }
  StillTiles tiles() const { return {begin_.data(), splat_rows_.data(), keys_.data(), blocks_.data(), splats_.data(), gaussians_.data(), stop_depths_.data()}; }
  StillImages images() const;

 private:
  void keep_lists(const Context& context);
  void find_stops(const Context& context, int tile);
  void round_colors();

  const Kernels& kernels_;
  AomgenView view_;
  int32_t gaussian_count_;
  Buffer<float> planes_;  // rgb, depth, alpha, median depth
  Buffer<int32_t> max_id_;
  Buffer<uint8_t> rgb8_;
  std::vector<uint32_t> begin_, splat_rows_, keys_;
  std::vector<uint16_t> blocks_;
  std::vector<float> stop_depths_;  // (tiles, 16)
  Buffer<Splat> splats_;
  std::vector<int32_t> gaussians_;
};

}  // namespace aomgen

struct AomgenSession {
  aomgen::Session session;
  AomgenSession(aomgen::Context& context, const AomgenScene& scene, const AomgenView& view) : session(context, scene, view) {}
};

namespace aomgen {

// Moving Gaussians of several frames.
struct MovingScene {
  AomgenScene scene;
  int part_count;
  int64_t colored_count;
};

// Lists by tile of one frame's moving splats, and the memory for them.
class FrameScratch {
 public:
  void draw(const MovingScene& moving, const AomgenFrame& frame, int threads);

 private:
  void project(const MovingScene& moving, const AomgenFrame& frame, int threads);
  void find_tiles(const Session& session, int block);
  void fill_lists(const Session& session);

  Projection projection_{};
  Buffer<PartPose> poses_;
  Buffer<Splat> splats_;
  Buffer<int32_t> gaussians_;
  Buffer<uint32_t> depth_keys_, visible_;
  struct Found {
    std::vector<uint32_t> tiles;
    std::vector<uint16_t> blocks;
  };
  Buffer<TileCover> covers_;   // by slot
  std::vector<Found> found_tiles_;  // by block of slots
  std::atomic<uint64_t> found_{0};              // tiles of all splats so far
  Buffer<uint32_t> keys_, ordered_, spare_keys_, spare_ordered_;  // of the sort
  Buffer<uint32_t> begin_, cursors_;
  Buffer<MovingEntry> entries_;
};

class SessionDrawer {
 public:
  void draw(const MovingScene& moving, const AomgenFrame* frames, int frame_count, int threads);

 private:
  std::vector<FrameScratch> scratches_;  // by worker
};

}  // namespace aomgen
