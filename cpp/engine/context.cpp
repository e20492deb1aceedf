#include "context.h"

#include <algorithm>
#include <numeric>

#include "sort.h"
#include "thread_pool.h"

namespace aomgen {

namespace {

class StageClock {
 public:
  explicit StageClock(double& result) : result_(result), start_(std::chrono::steady_clock::now()) {}
  ~StageClock() { result_ = std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start_).count(); }

 private:
  double& result_;
  std::chrono::steady_clock::time_point start_;
};

}  // namespace

void fill_part_poses(const float* cam_from_part, int part_count, PartPose* poses) {
  for (int part = 0; part < part_count; ++part) {
    const float* V = cam_from_part + 12 * part;
    std::copy_n(V, 12, poses[part].cam_from_part);
    for (int k = 0; k < 3; ++k) poses[part].center[k] = -(V[k] * V[3] + V[4 + k] * V[7] + V[8 + k] * V[11]);
    poses[part].unused = 0;
  }
}

void Context::configure(int threads, const Kernels* kernels) {
  threads_ = threads > 0 ? threads : processor_count();
  kernels_ = kernels;
}

void Context::project(const AomgenScene& scene, const AomgenView& view) {
  StageClock clock(times_[kProject]);
  const int blocks = block_count(scene.count);
  const size_t capacity = static_cast<size_t>(blocks) * kProjectionBlock;
  PartPose* poses = poses_.reserve(view.part_count);
  fill_part_poses(view.cam_from_part, view.part_count, poses);
  Projection& p = projection_;
  p = {scene, view, poses, nullptr, 0, splats_.reserve(capacity), gaussians_.reserve(capacity), depth_keys_.reserve(capacity), visible_.reserve(blocks)};
  p.view.cam_from_part = nullptr;  // the caller's; not kept
  parallel(threads_, blocks, 1, [&](int64_t block, int) { kernels_->project(p, static_cast<int>(block)); });
  block_begin_.assign(blocks + 1, 0);
  for (int block = 0; block < blocks; ++block) block_begin_[block + 1] = block_begin_[block] + p.visible[block];
  visible_count_ = block_begin_[blocks];
}

// Sorts the visible splats from near to far, equal depths in the order of the scene, into lists by tile.
void Context::order_and_bin() {
  const uint32_t count = visible_count_;
  const SortArrays arrays = {keys_.reserve(count), ordered_.reserve(count), spare_keys_.reserve(count), spare_ordered_.reserve(count)};
  uint32_t* slots = nullptr;
  {
    StageClock clock(times_[kSort]);
    for (size_t block = 0; block + 1 < block_begin_.size(); ++block) {
      const uint32_t begin = block_begin_[block], size = block_begin_[block + 1] - begin, first = static_cast<uint32_t>(block) * kProjectionBlock;
      std::copy_n(projection_.depth_keys + first, size, arrays.keys + begin);
      for (uint32_t i = 0; i < size; ++i) arrays.values[begin + i] = first + i;
    }
    slots = sort_by_key(arrays, count);
  }
  StageClock clock(times_[kBin]);
  tiles_ = binner_.bin({projection_.splats, slots, block_begin_}, projection_.view.width, projection_.view.height, threads_);
}

void Context::draw(const AomgenImages& images) {
  StageClock clock(times_[kBlend]);
  const AomgenView& view = projection_.view;
  const AomgenScene& scene = projection_.scene;
  const int features = images.features ? scene.feature_count : 0;
  Blend b{view, tiles_, projection_.splats, projection_.gaussians, features, scene.features, images, nullptr, nullptr};
  if (images.differentiable) {
    b.sums = tile_sums_.reserve(tile_count());
    b.block_masks = block_masks_.reserve(intersections());
  }
  const size_t scratch = blend_scratch(features);
  float* scratches = scratch_.reserve(scratch * threads_);
  parallel(threads_, tile_count(), 4, [&](int64_t tile, int worker) {
    kernels_->blend(b, static_cast<int>(tile), scratches + scratch * worker);
  });
}

void Context::forward(const AomgenScene& scene, const AomgenView& view, const AomgenImages& images) {
  differentiable_ = false;
  project(scene, view);
  order_and_bin();
  draw(images);
  differentiable_ = images.differentiable;
}

void Context::backward(const AomgenImageGradients& images, const AomgenSceneGradients& gradients) {
  const AomgenScene& scene = projection_.scene;
  const int features = images.features ? scene.feature_count : 0;
  const size_t entries = intersections();
  float* moments = moments_.reserve(16 * entries);
  float* feature_moments = feature_moments_.reserve(features * entries);
  {
    StageClock clock(times_[kBlendBackward]);
    const BlendBackward b{projection_.view, tiles_, projection_.splats, projection_.gaussians, features, scene.features,
                          tile_sums_.data(), block_masks_.data(), images, moments, feature_moments};
    const size_t scratch = backward_scratch(features);
    float* scratches = scratch_.reserve(scratch * threads_);
    parallel(threads_, tile_count(), 4, [&](int64_t tile, int worker) {
      kernels_->blend_backward(b, static_cast<int>(tile), scratches + scratch * worker);
    });
  }
  StageClock clock(times_[kProjectBackward]);
  const int blocks = block_count(scene.count);
  ProjectionBackward p{projection_, block_begin_.data(), binner_.by_splat(), moments, feature_moments, gradients, nullptr};
  if (!features) p.gradients.features = nullptr;
  if (gradients.cam_from_part) p.pose_sums = pose_sums_.reserve(16 * static_cast<size_t>(blocks) * part_count());
  parallel(threads_, blocks, 1, [&](int64_t block, int) { kernels_->project_backward(p, static_cast<int>(block)); });
  if (gradients.cam_from_part) sum_pose_gradients(gradients.cam_from_part);
  const int64_t rows = gradients.rows ? visible_count_ : scene.count;
  if (gradients.features && !features) std::fill_n(gradients.features, rows * scene.feature_count, 0.0f);
}

// The blocks' sums in order, with the gradient by the camera's centre c = -R^T t carried to R and t.
void Context::sum_pose_gradients(float* cam_from_part) const {
  const int blocks = block_count(projection_.scene.count), parts = part_count();
  for (int part = 0; part < parts; ++part) {
    double sums[15] = {};
    for (int block = 0; block < blocks; ++block) {
      const float* row = pose_sums_.data() + 16 * (static_cast<size_t>(block) * parts + part);
      for (int k = 0; k < 15; ++k) sums[k] += row[k];
    }
    const float* V = projection_.poses[part].cam_from_part;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        sums[4 * i + j] -= V[4 * i + 3] * sums[12 + j];
        sums[4 * i + 3] -= V[4 * i + j] * sums[12 + j];
      }
    for (int k = 0; k < 12; ++k) cam_from_part[12 * part + k] = static_cast<float>(sums[k]);
  }
}

void Context::contribution_weights(const AomgenScene& scene, const AomgenView& view, int mask_count, const float* masks, float* weights) {
  differentiable_ = false;
  project(scene, view);
  order_and_bin();
  std::fill(weights, weights + static_cast<size_t>(scene.count) * mask_count, 0.0f);
  float* sums = moments_.reserve(16 * static_cast<size_t>(intersections()));
  const size_t plane = static_cast<size_t>(view.width) * view.height;
  for (int first = 0; first < mask_count; first += 16) {
    const int some = std::min(16, mask_count - first);
    const Weights w{view, tiles_, projection_.splats, some, masks + plane * first, sums};
    parallel(threads_, tile_count(), 4, [&](int64_t tile, int) { kernels_->sum_weights(w, static_cast<int>(tile)); });
    const SplatEntries of_splat = binner_.by_splat();
    parallel(threads_, block_count(scene.count), 1, [&](int64_t block, int) {
      const uint32_t begin = static_cast<uint32_t>(block) * kProjectionBlock;
      for (uint32_t slot = begin; slot < begin + projection_.visible[block]; ++slot) {
        float* out = weights + static_cast<size_t>(projection_.gaussians[slot]) * mask_count + first;
        const uint32_t* entry = of_splat.entries + of_splat.begin[slot];
        for (uint32_t left = of_splat.count[slot]; left; --left, ++entry)
          for (int m = 0; m < some; ++m) out[m] += sums[16 * static_cast<size_t>(*entry) + m];
      }
    });
  }
}

void Context::count_pairs(int64_t& evaluated, int64_t& blended) {
  std::vector<int64_t> counts(2 * static_cast<size_t>(tile_count()));
  const PairCount c{projection_.view, tiles_, projection_.splats, counts.data(), counts.data() + tile_count()};
  parallel(threads_, tile_count(), 4, [&](int64_t tile, int) { kernels_->count_pairs(c, static_cast<int>(tile)); });
  evaluated = std::accumulate(c.evaluated, c.evaluated + tile_count(), int64_t{0});
  blended = std::accumulate(c.blended, c.blended + tile_count(), int64_t{0});
}

double Context::vector_throughput() const {
  constexpr int64_t kRounds = 1'000'000;
  double best = 0;
  for (int repeat = 0; repeat < 5; ++repeat) {
    double milliseconds = 0, done = 0;
    {
      StageClock clock(milliseconds);
      done = kernels_->multiply_adds(kRounds);
    }
    best = std::max(best, 1e3 * done / milliseconds);
  }
  return best;
}

double Context::image_loss(ImageLoss l, float* grad_gains) {
  const size_t rows = static_cast<size_t>(l.channels) * l.height;
  l.maps = maps_.reserve(3 * rows * l.width);
  double* sums = row_sums_.reserve(3 * rows);
  l.row_l1 = sums;
  l.row_ssim = sums + rows;
  l.row_gain = sums + 2 * rows;
  const size_t scratch = loss_scratch(l.width);
  float* scratches = scratch_.reserve(scratch * threads_);
  parallel(threads_, static_cast<int64_t>(rows), 8, [&](int64_t row, int worker) {
    kernels_->ssim_row(l, static_cast<int>(row / l.height), static_cast<int>(row % l.height), scratches + scratch * worker);
  });
  parallel(threads_, static_cast<int64_t>(rows), 8, [&](int64_t row, int worker) {
    kernels_->loss_gradient_row(l, static_cast<int>(row / l.height), static_cast<int>(row % l.height), scratches + scratch * worker);
  });
  double l1 = 0, ssim = 0;
  for (size_t row = 0; row < rows; ++row) {
    l1 += l.row_l1[row];
    ssim += l.row_ssim[row];
  }
  for (int channel = 0; channel < l.channels && grad_gains; ++channel) {
    double sum = 0;
    for (int y = 0; y < l.height; ++y) sum += l.row_gain[static_cast<size_t>(channel) * l.height + y];
    grad_gains[channel] = static_cast<float>(sum);
  }
  const double pixels = static_cast<double>(rows) * l.width;
  return (1.0 - l.dssim_weight) * l1 / pixels + l.dssim_weight * (1.0 - ssim / pixels);
}

void Context::adam_step(AdamStep a, const float* rates, int columns) {
  if (a.count == 0) return;
  a.period = 16 * columns;
  a.block_size = (16384 / a.period + 1) * static_cast<int64_t>(a.period);
  std::vector<float> repeated(a.period);
  for (int i = 0; i < a.period; ++i) repeated[i] = rates[i % columns];
  a.rates = repeated.data();
  parallel(threads_, (a.count + a.block_size - 1) / a.block_size, 1,
           [&](int64_t block, int) { kernels_->adam(a, static_cast<int>(block)); });
}

}  // namespace aomgen
