// Plain C interface of the plane sweep: dense inverse depth of one view from its neighbours.
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  int32_t width, height;       // 2..16384
  int32_t source_count;        // S, 1..16
  int32_t plane_count;         // D, 2..256
  const float* reference;      // (H, W) gray, 0..1
  const float* sources;        // (S, H, W) gray, 0..1
  const float* rotations;      // (S, 9): K_source R_source_ref K_ref^-1, row-major
  const float* translations;   // (S, 3): K_source t_source_ref
  float first_inverse_depth;   // of plane 0; 0 is infinity
  float inverse_depth_step;    // > 0
  int32_t window_radius;       // of the correlation window, 1..8 [px]
  int32_t best_sources;        // sources averaged at a pixel and plane, 1..S
  float noise;                 // standard deviation of image noise, 0..1: keeps plain areas undecided
  float small_jump_penalty;    // of a change by one plane between neighbours, in matching cost 0..255
  float large_jump_penalty;    // of a larger change
} AomgenSweep;

// Writes `inverse_depth` (H, W) and `score` (H, W), the correlation -1..1 at the chosen plane.
// Uses no thread of its own; callers may run several at once. Returns 0, or 1 for bad arguments,
// or 2 when memory is short.
__attribute__((visibility("default")))
int32_t aomgen_plane_sweep(const AomgenSweep* sweep, float* inverse_depth, float* score);

#ifdef __cplusplus
}
#endif
