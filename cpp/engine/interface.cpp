// The C interface: checks every argument, then runs the context; no exception leaves this file.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <new>
#include <stdexcept>
#include <string>

#include "../aomgen_splatting.h"
#include "context.h"
#include "dispatch.h"
#include "thread_pool.h"

struct AomgenContext {
  aomgen::Context context;
};

namespace {

constexpr int64_t kMaxGaussians = 1 << 24;  // slots are kept as exact floats in one place
constexpr int kMaxSide = 16384, kMaxFeatures = 4096, kMaxThreads = 256, kMaxParts = 4096;

thread_local std::string last_error;

struct Refused : std::invalid_argument {
  using std::invalid_argument::invalid_argument;
};

void require(bool condition, const char* problem) {
  if (!condition) throw Refused(problem);
}

template <class Function>
int32_t guarded(Function&& function) {
  try {
    function();
    return AOMGEN_OK;
  } catch (const std::bad_alloc&) {
    last_error = "not enough memory";
    return AOMGEN_OUT_OF_MEMORY;
  } catch (const std::exception& error) {
    last_error = error.what();
    return AOMGEN_INVALID_ARGUMENT;
  }
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
  require(view->cam_from_part, "cam_from_part is null");
  for (int i = 0; i < 12 * view->part_count; ++i) require(std::isfinite(view->cam_from_part[i]), "a pose is not finite");
}

void check_parts(const AomgenScene& scene, const AomgenView& view) {
  if (!scene.parts) return;
  int32_t least = 0, most = 0;
  for (int64_t i = 0; i < scene.count; ++i) {
    least = std::min(least, scene.parts[i]);
    most = std::max(most, scene.parts[i]);
  }
  require(least >= 0 && most < view.part_count, "a Gaussian's part has no pose");
}

void check(const AomgenImages* images, const AomgenScene& scene) {
  require(images && images->rgb && images->depth && images->alpha, "rgb, depth and alpha are required");
  require(images->interleaved == 0 || images->interleaved == 1, "interleaved must be 0 or 1");
  require(images->differentiable == 0 || images->differentiable == 1, "differentiable must be 0 or 1");
  require(!images->median_depth == !images->max_id, "median_depth and max_id come together");
  require(!images->features || scene.feature_count > 0, "the scene has no features");
}

}  // namespace

extern "C" {

int32_t aomgen_abi_version(void) { return AOMGEN_ABI_VERSION; }

const char* aomgen_last_error(void) { return last_error.c_str(); }

const char* aomgen_instruction_sets(void) { return aomgen::usable_instruction_sets(); }

int32_t aomgen_processor_count(void) { return aomgen::processor_count(); }

AomgenContext* aomgen_context_new(void) {
  AomgenContext* context = new (std::nothrow) AomgenContext();
  if (context) context->context.configure(0, aomgen::find_kernels(nullptr));
  return context;
}

void aomgen_context_free(AomgenContext* context) { delete context; }

int32_t aomgen_context_configure(AomgenContext* context, int32_t threads, const char* instruction_set) {
  return guarded([&] {
    require(context, "context is null");
    require(threads >= 0 && threads <= kMaxThreads, "threads must be 0 to 256");
    const aomgen::Kernels* kernels = aomgen::find_kernels(instruction_set);
    require(kernels, "this machine does not have the instruction set");
    context->context.configure(threads, kernels);
  });
}

int32_t aomgen_forward(AomgenContext* context, const AomgenScene* scene, const AomgenView* view, const AomgenImages* images) {
  return guarded([&] {
    require(context, "context is null");
    check(scene);
    check(view);
    check_parts(*scene, *view);
    check(images, *scene);
    context->context.forward(*scene, *view, *images);
  });
}

int32_t aomgen_backward(AomgenContext* context, const AomgenImageGradients* images, const AomgenSceneGradients* gradients) {
  if (context && !context->context.can_go_back()) {
    last_error = "the context's last pass was not a differentiable forward pass";
    return AOMGEN_NO_FORWARD;
  }
  return guarded([&] {
    require(context, "context is null");
    require(images && images->rgb, "the gradient by rgb is required");
    require(gradients, "the gradients are required");
    require(context->context.is_empty() || (gradients->means && gradients->quats && gradients->scales && gradients->opacities && gradients->sh), "the gradients by means, quats, scales, opacities and sh are required");
    const int features = context->context.feature_count();
    require(!images->features || (images->drawn_features && (gradients->features || context->context.is_empty()) && features > 0 && features <= aomgen::kMaxGradientFeatures),
            "gradients of features need the drawn features, a place for the result, and at most 256 features");
    context->context.backward(*images, *gradients);
  });
}

int32_t aomgen_contribution_weights(AomgenContext* context, const AomgenScene* scene, const AomgenView* view,
                                    int32_t mask_count, const float* masks, float* weights) {
  return guarded([&] {
    require(context, "context is null");
    check(scene);
    check(view);
    check_parts(*scene, *view);
    require(mask_count >= 1 && mask_count <= kMaxFeatures && masks && (weights || scene->count == 0), "1 to 4096 masks and an array for the weights are required");
    context->context.contribution_weights(*scene, *view, mask_count, masks, weights);
  });
}

int32_t aomgen_image_loss(AomgenContext* context, int32_t channels, int32_t height, int32_t width, const float* rendered,
                          const float* target, const float* gains, float dssim_weight, double* loss, float* grad_rendered,
                          float* grad_gains) {
  return guarded([&] {
    require(context && rendered && target && loss && grad_rendered, "an argument is null");
    require(channels >= 1 && channels <= 16, "channels must be 1 to 16");
    require(width >= 1 && width <= kMaxSide && height >= 1 && height <= kMaxSide, "the image must be 1 to 16384 pixels wide and high");
    require(dssim_weight >= 0 && dssim_weight <= 1, "the weight of the structural part must be 0 to 1");
    aomgen::ImageLoss l{};
    l.channels = channels;
    l.height = height;
    l.width = width;
    l.rendered = rendered;
    l.target = target;
    l.gains = gains;
    l.dssim_weight = dssim_weight;
    l.grad_rendered = grad_rendered;
    *loss = context->context.image_loss(l, gains ? grad_gains : nullptr);
  });
}

int32_t aomgen_adam_step(AomgenContext* context, int64_t rows, int32_t columns, float* values, const float* gradients,
                         float* means, float* squares, const float* rates, int64_t step) {
  return guarded([&] {
    require(context, "context is null");
    require(rows >= 0 && rows <= kMaxGaussians && columns >= 1 && columns <= 1024, "rows must be 0 to 16777216, columns 1 to 1024");
    require(rows == 0 || (values && gradients && means && squares && rates), "an argument is null");
    require(step >= 1, "steps count from 1");
    constexpr double kMeanDecay = 0.9, kSquareDecay = 0.999;
    aomgen::AdamStep a{};
    a.count = rows * columns;
    a.values = values;
    a.gradients = gradients;
    a.means = means;
    a.squares = squares;
    a.mean_decay = static_cast<float>(kMeanDecay);
    a.square_decay = static_cast<float>(kSquareDecay);
    a.mean_share = static_cast<float>(1.0 - kMeanDecay);
    a.square_share = static_cast<float>(1.0 - kSquareDecay);
    a.epsilon = 1e-15f;
    a.mean_correction = static_cast<float>(1.0 / (1.0 - std::pow(kMeanDecay, static_cast<double>(step))));
    a.square_correction = static_cast<float>(1.0 / (1.0 - std::pow(kSquareDecay, static_cast<double>(step))));
    context->context.adam_step(a, rates, columns);
  });
}

int32_t aomgen_stage_times(const AomgenContext* context, double milliseconds[6]) {
  return guarded([&] {
    require(context && milliseconds, "an argument is null");
    std::memcpy(milliseconds, context->context.stage_times().data(), 6 * sizeof(double));
  });
}

int32_t aomgen_count_pairs(AomgenContext* context, int64_t* evaluated, int64_t* blended) {
  if (context && !context->context.can_go_back()) {
    last_error = "the context's last pass was not a differentiable forward pass";
    return AOMGEN_NO_FORWARD;
  }
  return guarded([&] {
    require(context && evaluated && blended, "an argument is null");
    context->context.count_pairs(*evaluated, *blended);
  });
}

int32_t aomgen_vector_throughput(AomgenContext* context, double* per_second) {
  return guarded([&] {
    require(context && per_second, "an argument is null");
    *per_second = context->context.vector_throughput();
  });
}

int32_t aomgen_counts(const AomgenContext* context, int64_t* visible, int64_t* intersections) {
  return guarded([&] {
    require(context && visible && intersections, "an argument is null");
    *visible = context->context.visible();
    *intersections = context->context.intersections();
  });
}

}  // extern "C"
