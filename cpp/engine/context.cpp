#include "context.h"

#include <algorithm>

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

int block_count(int64_t gaussians) { return static_cast<int>((gaussians + kProjectionBlock - 1) / kProjectionBlock); }

}  // namespace

void Context::configure(int threads, const Kernels* kernels) {
  threads_ = threads > 0 ? threads : processor_count();
  kernels_ = kernels;
}

void Context::project(const AomgenScene& scene, const AomgenView& view) {
  StageClock clock(times_[kProject]);
  const int blocks = block_count(scene.count);
  const size_t capacity = static_cast<size_t>(blocks) * kProjectionBlock;
  Projection& p = projection_;
  p.scene = scene;
  p.view = view;
  const float* V = view.world_to_cam;
  for (int k = 0; k < 3; ++k) p.cam_center[k] = -(V[k] * V[3] + V[4 + k] * V[7] + V[8 + k] * V[11]);
  p.splats = block_splats_.reserve(capacity);
  p.gaussians = block_gaussians_.reserve(capacity);
  p.depth_keys = block_keys_.reserve(capacity);
  p.visible = visible_.reserve(blocks);
  parallel(threads_, blocks, 1, [&](int64_t block, int) { kernels_->project(p, static_cast<int>(block)); });
  block_begin_.assign(blocks + 1, 0);
  for (int block = 0; block < blocks; ++block) block_begin_[block + 1] = block_begin_[block] + p.visible[block];
  visible_count_ = block_begin_[blocks];
}

// Gives every visible Gaussian its rank from near to far. Its place is its position among the visible
// ones in the order of the scene.
void Context::order() {
  StageClock clock(times_[kSort]);
  const uint32_t count = visible_count_;
  uint32_t* keys = keys_.reserve(count);
  uint32_t* places = places_.reserve(count);
  int32_t* gaussians = place_gaussians_.reserve(count);
  for (size_t block = 0; block + 1 < block_begin_.size(); ++block) {
    const uint32_t begin = block_begin_[block], size = block_begin_[block + 1] - begin;
    std::copy_n(projection_.depth_keys + block * kProjectionBlock, size, keys + begin);
    std::copy_n(projection_.gaussians + block * kProjectionBlock, size, gaussians + begin);
    // Until the splats are in order, a place is remembered by its slot in the projection's result.
    for (uint32_t i = 0; i < size; ++i) places[begin + i] = static_cast<uint32_t>(block * kProjectionBlock + i);
  }
  sort_by_key(keys, places, keys_scratch_.reserve(count), places_scratch_.reserve(count), count);
  Splat* splats = splats_.reserve(count);
  int32_t* by_rank = gaussians_.reserve(count);
  uint32_t* ranks = ranks_.reserve(count);
  constexpr uint32_t kGroup = 2048;
  parallel(threads_, (count + kGroup - 1) / kGroup, 1, [&](int64_t group, int) {
    const uint32_t first = static_cast<uint32_t>(group) * kGroup, last = std::min(count, first + kGroup);
    for (uint32_t rank = first; rank < last; ++rank) {
      const uint32_t slot = places[rank];
      if (rank + 8 < last) __builtin_prefetch(&projection_.splats[places[rank + 8]]);
      splats[rank] = projection_.splats[slot];
      by_rank[rank] = projection_.gaussians[slot];
      ranks[block_begin_[slot / kProjectionBlock] + slot % kProjectionBlock] = rank;
    }
  });
}

void Context::bin() {
  StageClock clock(times_[kBin]);
  tiles_ = binner_.bin(splats_.data(), visible_count_, projection_.view.width, projection_.view.height, threads_);
}

void Context::forward(const AomgenScene& scene, const AomgenView& view, const AomgenImages& images) {
  planar_forward_ = false;
  project(scene, view);
  order();
  bin();
  StageClock clock(times_[kBlend]);
  Blend b{view, tiles_, splats_.data(), gaussians_.data(), images, nullptr, nullptr};
  b.transmittance = transmittance_.reserve(static_cast<size_t>(view.width) * view.height);
  b.block_masks = block_masks_.reserve(binner_.entry_count());
  const size_t scratch = blend_scratch(images.feature_count);
  float* scratches = scratch_.reserve(scratch * threads_);
  parallel(threads_, tile_count(), 4, [&](int64_t tile, int worker) {
    kernels_->blend(b, static_cast<int>(tile), scratches + scratch * worker);
  });
  planar_forward_ = !images.interleaved;
}

void Context::backward(const AomgenImageGradients& images, const AomgenSceneGradients& gradients) {
  float* moments = moments_.reserve(16 * static_cast<size_t>(binner_.entry_count()));
  {
    StageClock clock(times_[kBlendBackward]);
    const BlendBackward b{projection_.view, tiles_, splats_.data(), transmittance_.data(), block_masks_.data(), images, moments};
    parallel(threads_, tile_count(), 4, [&](int64_t tile, int) { kernels_->blend_backward(b, static_cast<int>(tile)); });
  }
  StageClock clock(times_[kProjectBackward]);
  const ProjectionBackward p{projection_, ranks_.data(), block_begin_.data(), place_gaussians_.data(),
                             splats_.data(), binner_.slot_begin(), moments, gradients};
  parallel(threads_, block_count(projection_.scene.count), 1,
           [&](int64_t block, int) { kernels_->project_backward(p, static_cast<int>(block)); });
}

void Context::contribution_weights(const AomgenScene& scene, const AomgenView& view, int mask_count, const float* masks, float* weights) {
  planar_forward_ = false;
  project(scene, view);
  order();
  bin();
  std::fill(weights, weights + static_cast<size_t>(scene.count) * mask_count, 0.0f);
  float* sums = moments_.reserve(16 * static_cast<size_t>(binner_.entry_count()));
  const uint32_t* slots = binner_.slot_begin();
  const size_t plane = static_cast<size_t>(view.width) * view.height;
  for (int first = 0; first < mask_count; first += 16) {
    const int part = std::min(16, mask_count - first);
    const Weights w{view, tiles_, splats_.data(), part, masks + plane * first, sums};
    parallel(threads_, tile_count(), 4, [&](int64_t tile, int) { kernels_->sum_weights(w, static_cast<int>(tile)); });
    for (uint32_t rank = 0; rank < visible_count_; ++rank) {
      float* out = weights + static_cast<size_t>(gaussians_.data()[rank]) * mask_count + first;
      for (uint32_t slot = slots[rank]; slot < slots[rank + 1]; ++slot)
        for (int m = 0; m < part; ++m) out[m] += sums[16 * static_cast<size_t>(slot) + m];
    }
  }
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
  a.period = 16 * columns;
  a.block_size = (16384 / a.period + 1) * static_cast<int64_t>(a.period);
  std::vector<float> repeated(a.period);
  for (int i = 0; i < a.period; ++i) repeated[i] = rates[i % columns];
  a.rates = repeated.data();
  parallel(threads_, (a.count + a.block_size - 1) / a.block_size, 1,
           [&](int64_t block, int) { kernels_->adam(a, static_cast<int>(block)); });
}

}  // namespace aomgen
