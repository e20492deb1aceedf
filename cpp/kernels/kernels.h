// What the engine hands to the kernels, and the table of kernels of one instruction set.
#pragma once

#include <cstddef>
#include <cstdint>

#include "../aomgen_splatting.h"

namespace aomgen {

constexpr int kTile = 16;                // tile side [px]; a tile is 16 blocks of 4x4 pixels
constexpr int kProjectionBlock = 1024;   // Gaussians that one projection task handles, multiple of 16
constexpr int kMoments = 10;             // gradient sums of one (Gaussian, tile) pair, see blend_backward.cpp
constexpr int kMaxGradientFeatures = 256;
constexpr float kMinLog2Alpha = -7.99435344f;  // log2(1/255): fainter contributions are not drawn
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;     // a pixel is finished once less than this shines through
constexpr float kDilation = 0.1f;              // [px^2] added to the image covariance: about that of a pixel's square, 1/12

// A Gaussian on the image. Its alpha at an offset (dx, dy) from the centre is
// exp2(log2_opacity - (qxx dx^2 + qxy dx dy + qyy dy^2)).
struct alignas(64) Splat {
  float x, y;
  float qxx, qxy, qyy;
  float log2_opacity;
  float red, green, blue, depth;
  float best_dy_per_dx, best_dx_per_dy;  // where the exponent is largest on a vertical, horizontal line
  float unused[2];
  uint16_t first_column, last_column, first_row, last_row;  // tiles on the image where alpha can reach 1/255: a tight box
};
static_assert(sizeof(Splat) == 64, "one cache line, as large as sixteen floats");

// Whether the splat touches all tiles of its box: it does when they lie in a line, because the box is
// tight. (It may then still miss the pixel centres of a tile, and nothing is drawn.)
static inline bool touches_its_box(const Splat& s) { return s.first_column == s.last_column || s.first_row == s.last_row; }

static inline size_t tiles_of_box(const Splat& s) {
  return static_cast<size_t>(s.last_column - s.first_column + 1) * static_cast<size_t>(s.last_row - s.first_row + 1);
}

// A part's transform: upper three rows of cam_from_part, then the camera's centre in the part's frame.
struct alignas(64) PartPose {
  float cam_from_part[12];
  float center[3];
  float unused;
};

// A slot is a Gaussian's place in the projection's results: kProjectionBlock slots a block of the
// scene, of which the first visible[block] are filled, in the order of the scene.
struct Projection {
  AomgenScene scene;
  AomgenView view;
  const PartPose* poses;  // (P,)
  const float* colors;    // (colored, 3) sRGB of the last Gaussians instead of their harmonics' constant term, or null
  int64_t colored;
  Splat* splats;          // by slot
  int32_t* gaussians;     // by slot: index into the scene
  uint32_t* depth_keys;   // by slot: float bits of the depth
  uint32_t* visible;      // by block
};

struct TileLists {
  int columns, rows;
  const uint32_t* begin;   // (tiles + 1) into entries
  const uint32_t* slots;   // by entry: slot of the splat, near to far inside every tile
};

// The entries of each splat, in the order of tiles.
struct SplatEntries {
  const uint32_t* begin;     // by slot: where its entries begin in the list
  const uint32_t* count;     // by slot
  const uint32_t* entries;
};

// What a tile's splats add up to, by block and pixel; the background is in the colors.
struct alignas(64) TileSums {
  float red[16][16], green[16][16], blue[16][16], depth[16][16];
  float transmittance[16][16];  // left after all splats
};

struct Blend {
  AomgenView view;
  TileLists tiles;
  const Splat* splats;       // by slot
  const int32_t* gaussians;  // by slot
  int feature_count;
  const float* features;     // (N, D)
  AomgenImages images;
  TileSums* sums;            // by tile, or null
  uint16_t* block_masks;     // by entry: blocks of the tile in which the splat is drawn; or null
};

struct BlendBackward {
  AomgenView view;
  TileLists tiles;
  const Splat* splats;       // by slot
  const int32_t* gaussians;  // by slot
  int feature_count;         // 0 without gradient by features
  const float* features;     // (N, D)
  const TileSums* sums;
  const uint16_t* block_masks;
  AomgenImageGradients images;
  float* moments;            // (entries, 16)
  float* feature_moments;    // (entries, D)
};

struct ProjectionBackward {
  Projection forward;
  const uint32_t* block_begin;  // by block: number of visible Gaussians before it
  SplatEntries entries;
  const float* moments;
  const float* feature_moments;
  AomgenSceneGradients gradients;
  float* pose_sums;             // (blocks, P, 16) or null: by cam_from_part (12) and centre (3)
};

struct Weights {
  AomgenView view;
  TileLists tiles;
  const Splat* splats;
  int mask_count;            // <= 16 of them in one pass
  const float* masks;        // (mask_count, H, W)
  float* sums;               // (entries, 16)
};

// Images of a camera, planar rgb (3, H, W) and the rest (H, W).
struct StillImages {
  const float *rgb, *depth, *alpha, *median_depth;
  const int32_t* max_id;
  const uint8_t* rgb8;       // (H, W, 3)
};

// What never moves, as one camera sees it: per tile the splats that draw anything.
struct StillTiles {
  const uint32_t* begin;     // (tiles + 1) into entries
  const uint32_t* rows;      // by entry: row of the splat, near to far inside every tile
  const uint32_t* keys;      // by entry: depth key
  const uint16_t* blocks;    // by entry: blocks of the tile in which the splat is drawn
  const Splat* splats;       // by row
  const int32_t* gaussians;  // by row
  const float* stop_depths;  // (tiles, 16): by block: nothing at this depth or behind it can be seen
};

// A moving splat in a tile: the blocks in which it may be seen.
struct MovingEntry {
  uint32_t slot, key, blocks;
};

// Where a splat's tiles lie among those found.
struct TileCover {
  uint32_t begin, count;
  uint32_t key;              // of the splat's depth
};

// Search for the tiles in which moving splats may be seen.
struct TileSearch {
  int columns;
  const float* stop_depths;  // (tiles, 16) of what never moves
  const Splat* splats;       // by slot
  bool (*touches)(const Splat&, float left, float top);  // as for the lists of a full render
  TileCover* covers;         // by slot
  uint32_t* tiles;           // found
  uint16_t* blocks;          // blocks of each
  size_t capacity;           // of tiles and blocks
};

// A frame of a session: what never moves and what does, blended together.
struct SessionBlend {
  AomgenView view;
  StillImages still_images;
  StillTiles still;
  int columns;               // of tiles
  const uint32_t* begin;     // (tiles + 1) into entries
  const MovingEntry* entries;  // near to far inside every tile
  const Splat* splats;       // by slot
  const int32_t* gaussians;  // by slot
  int32_t first_moving;      // index of the first moving Gaussian in max_id
  AomgenFrame frame;
};

struct PairCount {
  AomgenView view;
  TileLists tiles;
  const Splat* splats;
  int64_t* evaluated;        // by tile
  int64_t* blended;          // by tile
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
  void (*blend_backward)(const BlendBackward&, int tile, float* scratch);
  void (*project_backward)(const ProjectionBackward&, int block);
  void (*sum_weights)(const Weights&, int tile);
  void (*count_pairs)(const PairCount&, int tile);
  uint32_t (*find_tiles)(const TileSearch&, uint32_t slot, uint32_t last, uint32_t& found);  // returns the first slot that there was no room for
  void (*blend_session)(const SessionBlend&, int tile);
  void (*show_still)(const SessionBlend&, int tile);
  void (*ssim_row)(const ImageLoss&, int channel, int y, float* scratch);
  void (*loss_gradient_row)(const ImageLoss&, int channel, int y, float* scratch);
  void (*adam)(const AdamStep&, int block);
  double (*multiply_adds)(int64_t rounds);  // how many were done, see throughput.cpp
};

// Scratch floats that a task of the named kernel needs.
static inline size_t blend_scratch(int feature_count) { return static_cast<size_t>(256) * feature_count; }
static inline size_t backward_scratch(int feature_count) { return static_cast<size_t>(256 + 16) * feature_count; }
static inline size_t loss_scratch(int width) { return 5 * static_cast<size_t>(width + 64); }

}  // namespace aomgen
