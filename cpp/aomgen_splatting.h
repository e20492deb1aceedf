// Plain C interface of the Gaussian splatting engine.
//
// Every function returns a status; `aomgen_last_error` gives the reason of the last failure on
// the calling thread. Pointers are borrowed for the length of a call, except that the arrays of
// a scene must stay unchanged between `aomgen_forward` and the `aomgen_backward` that follows.
// Arrays are C-contiguous float32 unless said otherwise; cameras look along +z with y down and
// pixel centres at +0.5; quaternions are wxyz and need not be normalised. Arrays of no Gaussians may be null.
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define AOMGEN_ABI_VERSION 2
#define AOMGEN_API __attribute__((visibility("default")))

enum AomgenStatus {
  AOMGEN_OK = 0,
  AOMGEN_INVALID_ARGUMENT = 1,
  AOMGEN_OUT_OF_MEMORY = 2,
  AOMGEN_NO_FORWARD = 3,  // backward without its forward, or the context was used again since
};

typedef struct AomgenContext AomgenContext;  // scratch memory and tile lists, one caller at a time
typedef struct AomgenSession AomgenSession;  // a camera's view of what never moves; for any number of callers

typedef struct {
  int64_t count;             // N
  int32_t sh_coefficients;   // K stored per Gaussian: 1, 4, 9 or 16
  int32_t sh_degree;         // degree that is evaluated, (degree + 1)^2 <= K
  int32_t encoded;           // 0: standard deviations and opacities 0..1; 1: logarithms and logits
  int32_t feature_count;     // D, 0 for none
  const float* means;        // (N, 3), in the frame of the Gaussian's part
  const float* quats;        // (N, 4) wxyz, in the frame of the Gaussian's part
  const float* scales;       // (N, 3)
  const float* opacities;    // (N,)
  const float* sh;           // (N, K, 3), color = 0.5 + SH, directions in the frame of the part
  const float* features;     // (N, D) or null
  const int32_t* parts;      // (N,) row of the view's cam_from_part, or null: all in row 0
} AomgenScene;

typedef struct {
  int32_t width, height;
  float fx, fy, cx, cy;      // [px]
  float near_depth;          // Gaussians at or before this depth are not drawn
  int32_t antialiased;       // 1: opacity is lowered by what the dilation adds to the area
  float background[3];
  int32_t part_count;        // P >= 1
  const float* cam_from_part;  // (P, 12): upper three rows of the rigid transforms, row-major
} AomgenView;

typedef struct {
  float* rgb;                // required; planar (3, H, W), or (H, W, 3) when interleaved
  int32_t interleaved;
  int32_t differentiable;    // 1: keep what `aomgen_backward` and `aomgen_count_pairs` need
  float* depth;              // required (H, W): sum of weight * depth, not divided by alpha
  float* alpha;              // required (H, W)
  float* median_depth;       // optional (H, W), needs max_id
  int32_t* max_id;           // optional (H, W) int32, Gaussian of the largest weight or -1, needs median_depth
  float* features;           // (H, W, D) where the scene has features, else null
} AomgenImages;

typedef struct {
  const float* rgb;          // (3, H, W), planar
  const float* depth;        // (H, W) or null
  const float* alpha;        // (H, W) or null
  const float* features;     // (H, W, D) or null; D <= 256
  const float* drawn_features;  // (H, W, D) as drawn, where `features` is given
} AomgenImageGradients;

// Gradients by the scene's arrays as they were given (logarithms and logits if encoded). Dense arrays
// are written completely, zeros where a Gaussian is not seen. With `rows`, they are packed: the
// Gaussians in view alone, in the order of the scene, as many as `aomgen_counts` tells.
typedef struct {
  int32_t* rows;             // null for dense; else (N,), receives the Gaussian of every packed row
  float* means;              // (N, 3)
  float* quats;              // (N, 4)
  float* scales;             // (N, 3)
  float* opacities;          // (N,)
  float* sh;                 // (N, K, 3)
  float* features;           // (N, D) or null
  float* cam_from_part;      // (P, 12) or null
} AomgenSceneGradients;

// One frame of a session. Arrays that are not wanted are null; the same arrays may be given again for a
// later frame together with their `tiles`, then only tiles that have changed are written.
typedef struct {
  const AomgenSession* session;
  const float* cam_from_part;  // (P, 12): poses of the moving Gaussians' parts, as in AomgenView
  const float* colors;       // (M, 3) sRGB of the last M moving Gaussians instead of their harmonics' constant term, or null
  const float* shade;        // (H, W) factor on the color of what never moves, background included, or null
  uint8_t* tiles;            // required; one for each 16x16 pixels, row by row: 0 where the arrays below show what
                             // never moves and nothing else, and 1 elsewhere or where they are not yet filled
  uint8_t* rgb8;             // (H, W, 3): 255 times the color, limited to 0..1, rounded
  float* rgb;                // (H, W, 3)
  float* depth;              // (H, W) as in AomgenImages
  float* alpha;              // (H, W)
  float* median_depth;       // (H, W), needs max_id
  int32_t* max_id;           // (H, W) int32; moving Gaussians follow those that never move; needs median_depth
} AomgenFrame;

AOMGEN_API int32_t aomgen_abi_version(void);
AOMGEN_API const char* aomgen_last_error(void);

// Names of the instruction sets this machine can run, comma separated, best first.
AOMGEN_API const char* aomgen_instruction_sets(void);
// Processors this process may use.
AOMGEN_API int32_t aomgen_processor_count(void);

AOMGEN_API AomgenContext* aomgen_context_new(void);
AOMGEN_API void aomgen_context_free(AomgenContext* context);

// threads: 0 = all processors. instruction_set: null = best.
AOMGEN_API int32_t aomgen_context_configure(AomgenContext* context, int32_t threads, const char* instruction_set);

AOMGEN_API int32_t aomgen_forward(AomgenContext* context, const AomgenScene* scene, const AomgenView* view,
                       const AomgenImages* images);

// Gradients of the last `aomgen_forward` of this context, which must have been differentiable.
AOMGEN_API int32_t aomgen_backward(AomgenContext* context, const AomgenImageGradients* image_gradients,
                        const AomgenSceneGradients* scene_gradients);

// weights (N, M): sum over pixels of blended weight * mask, for masks (M, H, W).
AOMGEN_API int32_t aomgen_contribution_weights(AomgenContext* context, const AomgenScene* scene, const AomgenView* view,
                                    int32_t mask_count, const float* masks, float* weights);

// Prepares drawing moving Gaussians into a scene that never moves, from a camera that never moves.
// The scene's arrays are not used later; its features are not drawn.
AOMGEN_API int32_t aomgen_session_open(AomgenContext* context, const AomgenScene* scene, const AomgenView* view,
                            AomgenSession** session);
AOMGEN_API void aomgen_session_free(AomgenSession* session);

// Draws frames of the same moving Gaussians (their features are not drawn), each as `aomgen_forward`
// draws all Gaussians together. One frame is drawn by all threads, several frames by one thread each.
AOMGEN_API int32_t aomgen_session_draw(AomgenContext* context, const AomgenScene* moving, int32_t part_count,
                            int64_t colored_count, int32_t frame_count, const AomgenFrame* frames);

// (1 - dssim_weight) * mean|g x - y| + dssim_weight * (1 - SSIM(g x, y)) of planar images
// (channels, H, W) with one gain g per channel, and its gradients. SSIM: 11x11 window of sigma
// 1.5, zeros outside the image. gains may be null (ones), then grad_gains is not written.
AOMGEN_API int32_t aomgen_image_loss(AomgenContext* context, int32_t channels, int32_t height, int32_t width,
                          const float* rendered, const float* target, const float* gains, float dssim_weight,
                          double* loss, float* grad_rendered, float* grad_gains);

// One step of Adam in place on values (rows, columns) with a learning rate per column; `means` and
// `squares` are the running averages (rows, columns), step counts from 1.
AOMGEN_API int32_t aomgen_adam_step(AomgenContext* context, int64_t rows, int32_t columns, float* values, const float* gradients,
                         float* means, float* squares, const float* rates, int64_t step);

// Milliseconds of wall time of the last passes: project, sort, bin, blend, blend backward, project backward.
AOMGEN_API int32_t aomgen_stage_times(const AomgenContext* context, double milliseconds[6]);
// (Gaussian, pixel) pairs of the last forward pass: computed, and drawn. Slow, for measurements.
AOMGEN_API int32_t aomgen_count_pairs(AomgenContext* context, int64_t* evaluated, int64_t* blended);
// Fused multiply-adds per second of one thread in the context's instruction set, measured for a few milliseconds.
AOMGEN_API int32_t aomgen_vector_throughput(AomgenContext* context, double* per_second);
// Gaussians in view and (Gaussian, tile) pairs of the last forward pass.
AOMGEN_API int32_t aomgen_counts(const AomgenContext* context, int64_t* visible, int64_t* intersections);

#ifdef __cplusplus
}
#endif
