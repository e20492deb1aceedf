// The same bits for any number of threads, and nearly the same numbers on every instruction set.
#include <cmath>
#include <thread>

#include "check.h"
#include "world.h"

namespace aomgen::tests {

namespace {

struct Results {
  explicit Results(const World& world) : canvas(world), gradients(world), weights(5 * static_cast<size_t>(world.count)) {}
  Canvas canvas;
  Gradients gradients;
  Array<float> weights;

  bool operator==(const Results& o) const { return canvas == o.canvas && gradients == o.gradients && weights == o.weights; }
};

Results all_passes(Engine& engine, const World& world) {
  Results r(world);
  CHECK(engine.draw(world, r.canvas) == AOMGEN_OK);
  CHECK(engine.go_back(world, r.canvas, Pull(world, 7), r.gradients) == AOMGEN_OK);
  const std::vector<float> masks = Random(8).numbers(5 * r.canvas.alpha.size(), -1.0f, 1.0f);
  const AomgenScene scene = world.scene();
  const AomgenView view = world.view();
  CHECK(aomgen_contribution_weights(engine.context(), &scene, &view, 5, masks.data(), r.weights.data()) == AOMGEN_OK);
  return r;
}

double mean_difference(const Array<float>& a, const Array<float>& b) {
  double sum = 0;
  for (size_t i = 0; i < a.size(); ++i) sum += std::fabs(static_cast<double>(a[i]) - b[i]);
  return a.size() ? sum / static_cast<double>(a.size()) : 0.0;
}

}  // namespace

TEST(one_to_four_threads_give_the_same_bits) {
  const World worlds[] = {random_world(20, {9000, 1, 3, 97, 61, 2}), random_world(21, {700, 3, 0, 130, 75, 1})};
  for (const World& world : worlds)
    for (const std::string& isa : instruction_sets()) {
      Engine one(isa.c_str(), 1);
      const Results want = all_passes(one, world);
      for (int threads : {2, 3, 4}) {
        progress().subject = isa + ", " + std::to_string(threads) + " threads";
        Engine many(isa.c_str(), threads);
        CHECK(all_passes(many, world) == want);
      }
    }
}

TEST(a_used_context_gives_the_same_bits_as_a_new_one) {
  const World small = random_world(22, {33, 2, 2, 21, 17, 1}), large = random_world(23, {3000, 3, 5, 110, 64, 4});
  for (const std::string& isa : instruction_sets()) {
    progress().subject = isa;
    Engine fresh(isa.c_str()), used(isa.c_str());
    const Results want = all_passes(fresh, small);
    CHECK(all_passes(used, small) == want);
    all_passes(used, large);
    CHECK(all_passes(used, small) == want);
  }
}

TEST(instruction_sets_agree) {
  const World world = random_world(24, {2000, 3, 2, 120, 90, 3});
  Engine best;
  const Results want = all_passes(best, world);
  double covered = 0;
  for (size_t i = 0; i < want.canvas.alpha.size(); ++i) covered += want.canvas.alpha[i];
  CHECK(covered > 0.5 * static_cast<double>(want.canvas.alpha.size()));
  for (const std::string& isa : instruction_sets()) {
    progress().subject = isa;
    Engine engine(isa.c_str());
    const Results have = all_passes(engine, world);
    CHECK(mean_difference(have.canvas.rgb, want.canvas.rgb) < 2e-6);
    CHECK(mean_difference(have.canvas.depth, want.canvas.depth) < 1e-5);
    CHECK(mean_difference(have.canvas.features, want.canvas.features) < 2e-6);
    CHECK(mean_difference(have.gradients.means, want.gradients.means) < 0.02);
    CHECK(mean_difference(have.weights, want.weights) < 1e-3);
  }
}

TEST(two_callers_at_once_do_not_disturb_each_other) {
  const World worlds[] = {random_world(25, {900, 1, 1, 80, 60, 2}), random_world(26, {1200, 2, 0, 64, 64, 1})};
  std::vector<Results> want, have;
  for (const World& world : worlds) {
    Engine engine;
    want.push_back(all_passes(engine, world));
    have.push_back(want.back());
  }
  std::vector<std::thread> callers;
  for (size_t i = 0; i < 2; ++i)
    callers.emplace_back([&, i] {
      Engine engine(nullptr, 3);
      for (int round = 0; round < 5; ++round) have[i] = all_passes(engine, worlds[i]);
    });
  for (std::thread& caller : callers) caller.join();
  for (size_t i = 0; i < 2; ++i) CHECK(have[i] == want[i]);
}

}  // namespace aomgen::tests
