// What the engine hands to the kernels, and the table of kernels of one instruction set.
#pragma once

#include <cstddef>
#include <cstdint>

#include "../aomgen_splatting.h"

namespace aomgen {

constexpr int kTile = 16;                // tile side [px]; a tile is 16 blocks of 4x4 pixels
constexpr int kProjectionBlock = 1024;   // Gaussians that one projection task handles, multiple of 16
constexpr int kMoments = 10;             // gradient sums of one (Gaussian, tile) pair, see blend_backward.cpp
constexpr float kMinLog2Alpha = -7.99435344f;  // log2(1/255): fainter contributions are not drawn
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;     // a pixel is finished once less than this shines through
constexpr float kDilation = 0.3f;              // [px^2] added to the image covariance, as in 3DGS

// A Gaussian on the image. Its alpha at an offset (dx, dy) from the centre is
// exp2(log2_opacity - (qxx dx^2 + qxy dx dy + qyy dy^2)).
struct alignas(64) Splat {
  float x, y;
  float qxx, qxy, qyy;
  float log2_opacity;
  float red, green, blue, depth;
  float best_dy_per_dx, best_dx_per_dy;  // where the exponent is largest on a vertical, horizontal line
  float half_width, half_height;         // of the box in which alpha can reach 1/255
  float opacity, unused;
};
static_assert(sizeof(Splat) == 64, "one cache line, sixteen floats");

struct Projection {
  AomgenScene scene;
  AomgenView view;
  float cam_center[3];
  // Results, kProjectionBlock entries a block, of which the first visible[block] are filled.
  Splat* splats;
  int32_t* gaussians;   // index into the scene
  uint32_t* depth_keys; // float bits of the depth
  uint32_t* visible;
};

struct TileLists {
  int columns, rows;
  const uint32_t* begin;   // (tiles + 1) into entries
  const uint32_t* splats;  // rank of the splat, near to far inside every tile
  const uint32_t* slots;   // place of the entry when sorted by splat
};

struct Blend {
  AomgenView view;
  TileLists tiles;
  const Splat* splats;       // by rank
  const int32_t* gaussians;  // by rank
  AomgenImages images;
  float* transmittance;      // (H, W) left after all splats
  uint16_t* block_masks;     // per entry: blocks of the tile the splat may touch
};

struct BlendBackward {
  AomgenView view;
  TileLists tiles;
  const Splat* splats;
  const float* transmittance;
  const uint16_t* block_masks;
  AomgenImageGradients images;
  float* moments;            // (entries by slot, 16)
};

struct ProjectionBackward {
  Projection forward;
  const uint32_t* ranks;     // by place in the projection's result: rank of the splat
  const uint32_t* block_begin;  // first place of every projection block
  const int32_t* gaussians;  // by place
  const Splat* splats;       // by rank
  const uint32_t* slot_begin;  // by rank: first slot, (visible + 1)
  const float* moments;
  AomgenSceneGradients gradients;
};

struct Weights {
  AomgenView view;
  TileLists tiles;
  const Splat* splats;
  int mask_count;            // <= 16 of them in one pass
  const float* masks;        // (mask_count, H, W)
  float* sums;               // (entries by slot, 16)
};

struct ImageLoss {
  int channels, height, width;
  const float *rendered, *target, *gains;
  float dssim_weight;
  float* maps;               // (3, channels, H, W): derivative of SSIM by mean, by square, by product
  double* row_l1;            // (channels * H)
  double* row_ssim;          // (channels * H)
  double* row_gain;          // (channels * H) derivative of the loss by the channel's gain
  float* grad_rendered;
};

struct AdamStep {
  int64_t count;             // floats
  int64_t block_size;        // of one task, a multiple of period
  float *values, *means, *squares;
  const float* gradients;
  const float* rates;        // period floats; value i moves at rates[i % period]
  int period;                // multiple of 16
  float mean_decay, square_decay, epsilon;
  float mean_share, square_share;                 // 1 - decay
  float mean_correction, square_correction;  // 1 / (1 - decay^step)
};

struct Kernels {
  const char* name;
  void (*project)(const Projection&, int block);
  void (*blend)(const Blend&, int tile, float* scratch);
  void (*blend_backward)(const BlendBackward&, int tile);
  void (*project_backward)(const ProjectionBackward&, int block);
  void (*sum_weights)(const Weights&, int tile);
  void (*ssim_row)(const ImageLoss&, int channel, int y, float* scratch);
  void (*loss_gradient_row)(const ImageLoss&, int channel, int y, float* scratch);
  void (*adam)(const AdamStep&, int block);
};

// Scratch floats that a task of the named kernel needs.
static inline size_t blend_scratch(int feature_count) { return static_cast<size_t>(256) * feature_count; }
static inline size_t loss_scratch(int width) { return 5 * static_cast<size_t>(width + 64); }

}  // namespace aomgen
