// One caller's scratch memory, and the passes that run on it.
#pragma once

#include <array>
#include <chrono>
#include <vector>

#include "../kernels/kernels.h"
#include "binning.h"
#include "buffer.h"

namespace aomgen {

// Tasks of a projection.
inline int block_count(int64_t gaussians) { return static_cast<int>((gaussians + kProjectionBlock - 1) / kProjectionBlock); }

// From transforms (P, 12) to what the projection needs of each part.
void fill_part_poses(const float* cam_from_part, int part_count, PartPose* poses);

class Context {
 public:
  void configure(int threads, const Kernels* kernels);
  void forward(const AomgenScene& scene, const AomgenView& view, const AomgenImages& images);
  bool can_go_back() const { return differentiable_; }
  void backward(const AomgenImageGradients& images, const AomgenSceneGradients& gradients);
  void contribution_weights(const AomgenScene& scene, const AomgenView& view, int mask_count, const float* masks, float* weights);
  double image_loss(ImageLoss loss, float* grad_gains);
  void adam_step(AdamStep step, const float* rates, int columns);
  void count_pairs(int64_t& evaluated, int64_t& blended);
  double vector_throughput() const;

  int threads() const { return threads_; }
  const Kernels* kernels() const { return kernels_; }
  // Of the last forward pass; masks and sums if it was differentiable.
  const Projection& projection() const { return projection_; }
  const TileLists& tiles() const { return tiles_; }
  const uint16_t* block_masks() const { return block_masks_.data(); }
  const TileSums* tile_sums() const { return tile_sums_.data(); }
  void forget_forward() { differentiable_ = false; }

  const std::array<double, 6>& stage_times() const { return times_; }
  uint32_t visible() const { return visible_count_; }
  uint32_t intersections() const { return binner_.entry_count(); }
  int part_count() const { return projection_.view.part_count; }
  bool is_empty() const { return projection_.scene.count == 0; }
  int feature_count() const { return projection_.scene.feature_count; }

 private:
  enum Stage { kProject, kSort, kBin, kBlend, kBlendBackward, kProjectBackward };
  void project(const AomgenScene& scene, const AomgenView& view);
  void order_and_bin();
  void draw(const AomgenImages& images);
  void sum_pose_gradients(float* cam_from_part) const;
  int tile_count() const { return tiles_.columns * tiles_.rows; }

  int threads_ = 1;
  const Kernels* kernels_ = nullptr;
  bool differentiable_ = false;
  uint32_t visible_count_ = 0;
  std::array<double, 6> times_{};

  Projection projection_{};
  TileLists tiles_{};
  TileBinner binner_;
  std::vector<uint32_t> block_begin_;
  Buffer<PartPose> poses_;
  Buffer<Splat> splats_;                                          // by slot
  Buffer<int32_t> gaussians_;                                     // by slot
  Buffer<uint32_t> depth_keys_, visible_;                         // by slot, by block
  Buffer<uint32_t> keys_, ordered_, spare_keys_, spare_ordered_;  // of the sort
  Buffer<TileSums> tile_sums_;
  Buffer<float> moments_, feature_moments_, pose_sums_, scratch_, maps_;
  Buffer<uint16_t> block_masks_;
  Buffer<double> row_sums_;
};

}  // namespace aomgen
