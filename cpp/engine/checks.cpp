#include "checks.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

namespace aomgen {

namespace {

thread_local char reason_of_failure[256];

}  // namespace

const char* last_error() { return reason_of_failure; }

void set_last_error(const char* reason) { std::snprintf(reason_of_failure, sizeof(reason_of_failure), "%s", reason); }

void require(bool condition, const char* problem) {
  if (!condition) throw std::invalid_argument(problem);
}

void check(const AomgenScene* scene) {
  require(scene, "scene is null");
  require(scene->count >= 0 && scene->count <= kMaxGaussians, "the number of Gaussians must be 0 to 16777216");
  const int k = scene->sh_coefficients, degree = scene->sh_degree;
  require(k == 1 || k == 4 || k == 9 || k == 16, "SH coefficients per Gaussian must be 1, 4, 9 or 16");
  require(degree >= 0 && degree <= 3 && (degree + 1) * (degree + 1) <= k, "the SH degree is beyond the stored coefficients");
  require(scene->encoded == 0 || scene->encoded == 1, "encoded must be 0 or 1");
  require(scene->feature_count >= 0 && scene->feature_count <= kMaxFeatures, "the number of features must be 0 to 4096");
  if (scene->count == 0) return;
  require(scene->means && scene->quats && scene->scales && scene->opacities && scene->sh, "an array of the scene is null");
  require(scene->feature_count == 0 || scene->features, "the features are null");
}

void check(const AomgenView* view) {
  require(view, "view is null");
  require(view->width >= 1 && view->width <= kMaxSide && view->height >= 1 && view->height <= kMaxSide, "the image must be 1 to 16384 pixels wide and high");
  const float numbers[] = {view->fx, view->fy, view->cx, view->cy, view->near_depth};
  for (float x : numbers) require(std::isfinite(x), "an intrinsic is not finite");
  for (float x : view->background) require(std::isfinite(x), "the background is not finite");
  require(view->fx > 0 && view->fy > 0, "focal lengths must be positive");
  require(view->near_depth > 0, "the near depth must be positive");
  require(view->antialiased == 0 || view->antialiased == 1, "antialiased must be 0 or 1");
  require(view->part_count >= 1 && view->part_count <= kMaxParts, "the number of parts must be 1 to 4096");
  check_poses(view->cam_from_part, view->part_count);
}

void check_poses(const float* cam_from_part, int part_count) {
  require(cam_from_part, "cam_from_part is null");
  for (int i = 0; i < 12 * part_count; ++i) require(std::isfinite(cam_from_part[i]), "a pose is not finite");
}

void check_parts(const AomgenScene& scene, int part_count) {
  if (!scene.parts) return;
  int32_t least = 0, most = 0;
  for (int64_t i = 0; i < scene.count; ++i) {
    least = std::min(least, scene.parts[i]);
    most = std::max(most, scene.parts[i]);
  }
  require(least >= 0 && most < part_count, "a Gaussian's part has no pose");
}

}  // namespace aomgen
