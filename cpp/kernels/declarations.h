// The kernels of one instruction set, each in its own file.
#pragma once

#include "../simd/lanes.h"
#include "kernels.h"

namespace aomgen::AOMGEN_ISA {

void project(const Projection&, int block);
void blend(const Blend&, int tile, float* scratch);
void blend_backward(const BlendBackward&, int tile, float* scratch);
void project_backward(const ProjectionBackward&, int block);
void sum_weights(const Weights&, int tile);
void count_pairs(const PairCount&, int tile);
uint32_t find_tiles(const TileSearch&, uint32_t slot, uint32_t last, uint32_t& found);
void blend_session(const SessionBlend&, int tile);
void show_still(const SessionBlend&, int tile);
void ssim_row(const ImageLoss&, int channel, int y, float* scratch);
void loss_gradient_row(const ImageLoss&, int channel, int y, float* scratch);
void adam(const AdamStep&, int block);
double multiply_adds(int64_t rounds);

}  // namespace aomgen::AOMGEN_ISA
