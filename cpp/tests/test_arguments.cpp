// Arguments as a careless caller would pass them: always a status and a reason, never a crash.
#include <cstring>
#include <functional>
#include <limits>

#include "check.h"
#include "world.h"

namespace aomgen::tests {

namespace {

constexpr int32_t kMost = std::numeric_limits<int32_t>::max(), kLeast = std::numeric_limits<int32_t>::min();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN(), kInf = std::numeric_limits<float>::infinity();

// Everything one call of each function needs; damaged in place, never longer than its arrays.
struct Call {
  explicit Call(const World& world) : world(world), canvas(world), pull(world, 1), gradients(world) {
    scene = this->world.scene();
    view = this->world.view();
    images = canvas.images();
    image_gradients.rgb = pull.rgb.data();
    image_gradients.depth = pull.depth.data();
    image_gradients.alpha = pull.alpha.data();
    scene_gradients = gradients.pointers();
    image_gradients.features = pull.features.data();
    image_gradients.drawn_features = canvas.features.data();
  }
  World world;
  Canvas canvas;
  Pull pull;
  Gradients gradients;
  AomgenScene scene{};
  AomgenView view{};
  AomgenImages images{};
  AomgenImageGradients image_gradients{};
  AomgenSceneGradients scene_gradients{};
};

template <class T>
T pick(Random& random, std::initializer_list<T> values) {
  return values.begin()[random.below(static_cast<int>(values.size()))];
}

// One way to damage a call; all of them must be refused.
using Damage = std::function<void(Call&, Random&)>;

const std::vector<Damage>& forward_damages() {
  static const std::vector<Damage> all = {
      [](Call& c, Random& r) { c.scene.count = pick<int64_t>(r, {-1, (1 << 24) + 1, std::numeric_limits<int64_t>::max(), std::numeric_limits<int64_t>::min()}); },
      [](Call& c, Random& r) { c.scene.sh_coefficients = pick<int32_t>(r, {kLeast, -1, 0, 2, 3, 5, 8, 15, 17, kMost}); },
      [](Call& c, Random& r) { c.scene.sh_degree = pick<int32_t>(r, {kLeast, -1, 3, 4, 46340, 65535, kMost}); },
      [](Call& c, Random&) { c.scene.means = nullptr; },
      [](Call& c, Random&) { c.scene.quats = nullptr; },
      [](Call& c, Random&) { c.scene.scales = nullptr; },
      [](Call& c, Random&) { c.scene.opacities = nullptr; },
      [](Call& c, Random&) { c.scene.sh = nullptr; },
      [](Call& c, Random& r) { c.view.width = pick<int32_t>(r, {kLeast, -1, 0, 16385, kMost}); },
      [](Call& c, Random& r) { c.view.height = pick<int32_t>(r, {kLeast, -1, 0, 16385, kMost}); },
      [](Call& c, Random& r) { c.view.fx = pick(r, {0.0f, -1.0f, kNan, kInf}); },
      [](Call& c, Random& r) { c.view.fy = pick(r, {0.0f, -1.0f, kNan, -kInf}); },
      [](Call& c, Random& r) { c.view.cx = pick(r, {kNan, kInf}); },
      [](Call& c, Random& r) { c.view.cy = pick(r, {kNan, -kInf}); },
      [](Call& c, Random& r) { c.view.near_depth = pick(r, {0.0f, -1.0f, kNan, kInf}); },
      [](Call& c, Random& r) { c.view.background[r.below(3)] = pick(r, {kNan, kInf}); },
      [](Call& c, Random&) { c.images.rgb = nullptr; },
      [](Call& c, Random&) { c.images.depth = nullptr; },
      [](Call& c, Random&) { c.images.alpha = nullptr; },
      [](Call& c, Random&) { c.images.max_id = nullptr; },
      [](Call& c, Random&) { c.images.median_depth = nullptr; },
      [](Call& c, Random& r) { c.scene.feature_count = pick<int32_t>(r, {kLeast, -1, 4097, kMost}); },
      [](Call& c, Random&) { c.scene.features = nullptr; },
      [](Call& c, Random& r) { c.scene.encoded = pick<int32_t>(r, {kLeast, -1, 2, kMost}); },
      [](Call& c, Random& r) { c.view.antialiased = pick<int32_t>(r, {kLeast, -1, 2, kMost}); },
      [](Call& c, Random& r) { c.images.interleaved = pick<int32_t>(r, {kLeast, -1, 2, kMost}); },
      [](Call& c, Random& r) { c.view.part_count = pick<int32_t>(r, {kLeast, -1, 0, 1, 4097, kMost}); },
      [](Call& c, Random&) { c.view.cam_from_part = nullptr; },
      [](Call& c, Random& r) { c.world.cam_from_part[static_cast<size_t>(r.below(24))] = pick(r, {kNan, kInf}); },
      [](Call& c, Random& r) { c.world.parts[static_cast<size_t>(r.below(40))] = pick<int32_t>(r, {kLeast, -1, 2, 1 << 30, kMost}); },
  };
  return all;
}

const std::vector<Damage>& backward_damages() {
  static const std::vector<Damage> all = {
      [](Call& c, Random&) { c.image_gradients.rgb = nullptr; },
      [](Call& c, Random&) { c.scene_gradients.means = nullptr; },
      [](Call& c, Random&) { c.scene_gradients.quats = nullptr; },
      [](Call& c, Random&) { c.scene_gradients.scales = nullptr; },
      [](Call& c, Random&) { c.scene_gradients.opacities = nullptr; },
      [](Call& c, Random&) { c.scene_gradients.sh = nullptr; },
      [](Call& c, Random&) { c.image_gradients.drawn_features = nullptr; },
      [](Call& c, Random&) { c.scene_gradients.features = nullptr; },
  };
  return all;
}

void check_refused(int32_t status, size_t which) {
  progress().subject = "damage " + std::to_string(which);
  CHECK(status == AOMGEN_INVALID_ARGUMENT);
  CHECK(std::strlen(aomgen_last_error()) > 5);
}

World small_world() { return random_world(30, {40, 1, 2, 24, 18, 2}); }

int32_t forward(const Engine& engine, Call& c) { return aomgen_forward(engine.context(), &c.scene, &c.view, &c.images); }
int32_t backward(const Engine& engine, Call& c) { return aomgen_backward(engine.context(), &c.image_gradients, &c.scene_gradients); }

}  // namespace

TEST(every_damaged_argument_of_the_scene_is_refused) {
  const World world = small_world();
  Random random(1);
  Engine engine(nullptr, 2);
  Canvas want(world);
  CHECK(engine.draw(world, want) == AOMGEN_OK);
  for (int round = 0; round < 12; ++round)
    for (size_t which = 0; which < forward_damages().size(); ++which) {
      Call call(world);
      const int more = random.below(3);
      forward_damages()[which](call, random);
      for (int i = 0; i < more; ++i) forward_damages()[static_cast<size_t>(random.below(static_cast<int>(forward_damages().size())))](call, random);
      check_refused(forward(engine, call), which);
      CHECK(call.canvas.guards_are_whole());
    }
  Canvas have(world);
  CHECK(engine.draw(world, have) == AOMGEN_OK);
  CHECK(have == want);
}

TEST(every_damaged_argument_of_the_backward_pass_is_refused) {
  const World world = small_world();
  Random random(2);
  Engine engine;
  Call good(world);
  CHECK(forward(engine, good) == AOMGEN_OK);
  for (size_t which = 0; which < backward_damages().size(); ++which) {
    Call call(world);
    backward_damages()[which](call, random);
    check_refused(backward(engine, call), which);
  }
  CHECK(aomgen_backward(engine.context(), nullptr, &good.scene_gradients) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_backward(engine.context(), &good.image_gradients, nullptr) == AOMGEN_INVALID_ARGUMENT);
  CHECK(backward(engine, good) == AOMGEN_OK);
}

TEST(a_backward_pass_needs_its_forward_pass) {
  const World world = small_world();
  Engine engine;
  Call call(world);
  CHECK(backward(engine, call) == AOMGEN_NO_FORWARD);
  Canvas interleaved(world, true);
  CHECK(engine.draw(world, interleaved) == AOMGEN_OK);
  CHECK(backward(engine, call) == AOMGEN_NO_FORWARD);
  CHECK(forward(engine, call) == AOMGEN_OK);
  CHECK(backward(engine, call) == AOMGEN_OK);
  const Array<float> first = call.gradients.means;
  CHECK(backward(engine, call) == AOMGEN_OK);  // twice is allowed
  CHECK(call.gradients.means == first);
  Call without_features(world);
  without_features.image_gradients.features = without_features.image_gradients.drawn_features = nullptr;
  without_features.scene_gradients.features = without_features.scene_gradients.cam_from_part = nullptr;
  without_features.image_gradients.depth = without_features.image_gradients.alpha = nullptr;
  CHECK(backward(engine, without_features) == AOMGEN_OK);
  CHECK(without_features.gradients.guards_are_whole());
  Array<float> weights(40);
  CHECK(aomgen_contribution_weights(engine.context(), &call.scene, &call.view, 1, call.canvas.alpha.data(), weights.data()) == AOMGEN_OK);
  CHECK(backward(engine, call) == AOMGEN_NO_FORWARD);
}

TEST(gradients_by_features_that_draw_nothing_are_zero) {
  const World world = small_world();
  Engine engine;
  for (bool packed : {false, true}) {
    Call call(world);
    Array<int32_t> rows(40);
    call.scene_gradients.rows = packed ? rows.data() : nullptr;
    call.image_gradients.features = nullptr;
    CHECK(forward(engine, call) == AOMGEN_OK);
    CHECK(backward(engine, call) == AOMGEN_OK);
    int64_t visible = 0, intersections = 0;
    CHECK(aomgen_counts(engine.context(), &visible, &intersections) == AOMGEN_OK && visible > 0 && visible < 40);
    bool is_zero = true;
    for (size_t i = 0; i < 2 * static_cast<size_t>(packed ? visible : 40); ++i) is_zero &= call.gradients.features[i] == 0;
    CHECK(is_zero && call.gradients.guards_are_whole());
  }
}

TEST(arrays_of_no_gaussians_may_be_null) {
  Engine engine;
  Call call(random_world(32, {0, 1, 2, 24, 18, 2}));
  call.scene.means = call.scene.quats = call.scene.scales = call.scene.opacities = call.scene.sh = call.scene.features = nullptr;
  call.scene.parts = nullptr;
  CHECK(forward(engine, call) == AOMGEN_OK);
  AomgenSceneGradients nothing{};
  nothing.cam_from_part = call.gradients.cam_from_part.data();
  CHECK(aomgen_backward(engine.context(), &call.image_gradients, &nothing) == AOMGEN_OK);
  bool is_zero = true;
  for (size_t i = 0; i < call.gradients.cam_from_part.size(); ++i) is_zero &= call.gradients.cam_from_part[i] == 0;
  CHECK(is_zero);
  CHECK(aomgen_contribution_weights(engine.context(), &call.scene, &call.view, 1, call.canvas.alpha.data(), nullptr) == AOMGEN_OK);
}

TEST(changing_the_settings_between_the_passes_is_safe) {
  const World world = random_world(31, {500, 1, 0, 60, 44, 1});
  for (const std::string& drawn_by : instruction_sets())
    for (const std::string& pulled_by : instruction_sets()) {
      progress().subject = drawn_by + ", then " + pulled_by;
      Engine engine(drawn_by.c_str());
      Call call(world);
      CHECK(forward(engine, call) == AOMGEN_OK);
      CHECK(aomgen_context_configure(engine.context(), 3, pulled_by.c_str()) == AOMGEN_OK);
      const int32_t status = backward(engine, call);
      CHECK(status == AOMGEN_OK || status == AOMGEN_NO_FORWARD);
      if (status == AOMGEN_OK) CHECK(call.gradients.are_finite());
    }
}

TEST(settings_out_of_range_are_refused) {
  Engine engine;
  for (int32_t threads : {kLeast, -1, 257, kMost}) CHECK(aomgen_context_configure(engine.context(), threads, nullptr) == AOMGEN_INVALID_ARGUMENT);
  for (const char* name : {"", "avx", "AVX2", "baseline ", "avx512,avx2"}) CHECK(aomgen_context_configure(engine.context(), 1, name) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_context_configure(nullptr, 1, nullptr) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_context_configure(engine.context(), 0, nullptr) == AOMGEN_OK);
  aomgen_context_free(nullptr);
}

TEST(null_contexts_and_results_are_refused) {
  Call c(small_world());
  Engine engine;
  CHECK(forward(engine, c) == AOMGEN_OK);
  CHECK(aomgen_forward(nullptr, &c.scene, &c.view, &c.images) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_forward(engine.context(), nullptr, &c.view, &c.images) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_forward(engine.context(), &c.scene, nullptr, &c.images) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_forward(engine.context(), &c.scene, &c.view, nullptr) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_backward(nullptr, &c.image_gradients, &c.scene_gradients) != AOMGEN_OK);
  double times[6];
  int64_t a, b;
  CHECK(aomgen_stage_times(nullptr, times) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_stage_times(engine.context(), nullptr) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_counts(nullptr, &a, &b) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_counts(engine.context(), nullptr, &b) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_counts(engine.context(), &a, nullptr) == AOMGEN_INVALID_ARGUMENT);
  Engine fresh;
  CHECK(aomgen_counts(fresh.context(), &a, &b) == AOMGEN_OK && a == 0 && b == 0);
  CHECK(aomgen_stage_times(fresh.context(), times) == AOMGEN_OK);
  CHECK(aomgen_count_pairs(nullptr, &a, &b) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_count_pairs(engine.context(), nullptr, &b) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_count_pairs(engine.context(), &a, nullptr) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_count_pairs(engine.context(), &a, &b) == AOMGEN_OK && b > 0 && a >= b);
  aomgen_count_pairs(fresh.context(), &a, &b);
  CHECK(aomgen_vector_throughput(nullptr, times) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_vector_throughput(engine.context(), nullptr) == AOMGEN_INVALID_ARGUMENT);
}

TEST(damaged_arguments_of_the_weights_are_refused) {
  Call c(small_world());
  Engine engine;
  const std::vector<float> masks(2 * 24 * 18, 1.0f);
  Array<float> weights(80);
  const auto sum = [&](AomgenContext* context, const AomgenScene* scene, const AomgenView* view, int32_t count, const float* from, float* to) {
    return aomgen_contribution_weights(context, scene, view, count, from, to);
  };
  CHECK(sum(engine.context(), &c.scene, &c.view, 2, masks.data(), weights.data()) == AOMGEN_OK);
  for (int32_t count : {kLeast, -1, 0, 4097, kMost}) CHECK(sum(engine.context(), &c.scene, &c.view, count, masks.data(), weights.data()) == AOMGEN_INVALID_ARGUMENT);
  CHECK(sum(nullptr, &c.scene, &c.view, 2, masks.data(), weights.data()) == AOMGEN_INVALID_ARGUMENT);
  CHECK(sum(engine.context(), nullptr, &c.view, 2, masks.data(), weights.data()) == AOMGEN_INVALID_ARGUMENT);
  CHECK(sum(engine.context(), &c.scene, nullptr, 2, masks.data(), weights.data()) == AOMGEN_INVALID_ARGUMENT);
  CHECK(sum(engine.context(), &c.scene, &c.view, 2, nullptr, weights.data()) == AOMGEN_INVALID_ARGUMENT);
  CHECK(sum(engine.context(), &c.scene, &c.view, 2, masks.data(), nullptr) == AOMGEN_INVALID_ARGUMENT);
}

TEST(damaged_arguments_of_the_loss_are_refused) {
  Engine engine;
  std::vector<float> x(3 * 8 * 9, 0.5f), gradient(x.size());
  double loss;
  const auto call = [&](AomgenContext* context, int32_t channels, int32_t height, int32_t width, float share, int missing) {
    return aomgen_image_loss(context, channels, height, width, missing == 1 ? nullptr : x.data(), missing == 2 ? nullptr : x.data(), nullptr, share,
                             missing == 3 ? nullptr : &loss, missing == 4 ? nullptr : gradient.data(), nullptr);
  };
  CHECK(call(engine.context(), 3, 8, 9, 0.2f, 0) == AOMGEN_OK);
  CHECK(call(nullptr, 3, 8, 9, 0.2f, 0) == AOMGEN_INVALID_ARGUMENT);
  for (int missing = 1; missing <= 4; ++missing) CHECK(call(engine.context(), 3, 8, 9, 0.2f, missing) == AOMGEN_INVALID_ARGUMENT);
  for (int32_t bad : {kLeast, -1, 0, 16385, kMost}) {
    CHECK(call(engine.context(), bad, 8, 9, 0.2f, 0) == AOMGEN_INVALID_ARGUMENT);
    CHECK(call(engine.context(), 3, bad, 9, 0.2f, 0) == AOMGEN_INVALID_ARGUMENT);
    CHECK(call(engine.context(), 3, 8, bad, 0.2f, 0) == AOMGEN_INVALID_ARGUMENT);
  }
  for (float share : {-0.1f, 1.1f, kNan, kInf}) CHECK(call(engine.context(), 3, 8, 9, share, 0) == AOMGEN_INVALID_ARGUMENT);
}

TEST(damaged_arguments_of_adam_are_refused) {
  Engine engine;
  std::vector<float> numbers(12, 0.5f);
  const auto call = [&](AomgenContext* context, int64_t rows, int32_t columns, int64_t step, int missing) {
    float* a[5];
    for (int i = 0; i < 5; ++i) a[i] = missing == i + 1 ? nullptr : numbers.data();
    return aomgen_adam_step(context, rows, columns, a[0], a[1], a[2], a[3], a[4], step);
  };
  CHECK(call(nullptr, 4, 3, 1, 0) == AOMGEN_INVALID_ARGUMENT);
  for (int missing = 1; missing <= 5; ++missing) CHECK(call(engine.context(), 4, 3, 1, missing) == AOMGEN_INVALID_ARGUMENT);
  for (int64_t rows : {int64_t{-1}, int64_t{1} << 40, std::numeric_limits<int64_t>::max(), std::numeric_limits<int64_t>::min()})
    CHECK(call(engine.context(), rows, 3, 1, 0) == AOMGEN_INVALID_ARGUMENT);
  for (int32_t columns : {kLeast, -1, 0, 1025, kMost}) CHECK(call(engine.context(), 4, columns, 1, 0) == AOMGEN_INVALID_ARGUMENT);
  for (int64_t step : {int64_t{0}, int64_t{-5}}) CHECK(call(engine.context(), 4, 3, step, 0) == AOMGEN_INVALID_ARGUMENT);
  for (int missing = 1; missing <= 5; ++missing) CHECK(call(engine.context(), 0, 3, 1, missing) == AOMGEN_OK);
}

}  // namespace aomgen::tests
