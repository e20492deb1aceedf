// The C interface: checks every argument, then runs the context; no exception leaves this file.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "checks.h"
#include "dispatch.h"
#include "thread_pool.h"

using namespace aomgen;

namespace {

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

const char* aomgen_last_error(void) { return aomgen::last_error(); }

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
    check_parts(*scene, view->part_count);
    check(images, *scene);
    context->context.forward(*scene, *view, *images);
  });
}

int32_t aomgen_backward(AomgenContext* context, const AomgenImageGradients* images, const AomgenSceneGradients* gradients) {
  if (context && !context->context.can_go_back()) {
    set_last_error("the context's last pass was not a differentiable forward pass");
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
    check_parts(*scene, view->part_count);
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
    set_last_error("the context's last pass was not a differentiable forward pass");
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
