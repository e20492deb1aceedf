// Memory that runs out at any allocation of a call: a status and no crash, and the next call is good.
#include <atomic>
#include <cstddef>
#include <cstdlib>
#include <functional>
#include <new>

#include "check.h"
#include "world.h"

namespace {

constexpr int64_t kUnlimited = int64_t{1} << 60;
std::atomic<int64_t> allocations_left{kUnlimited};

void* allocate(size_t size, size_t alignment) {
  if (allocations_left.fetch_sub(1) <= 0) return nullptr;
  void* memory = nullptr;
  return posix_memalign(&memory, alignment, size) == 0 ? memory : nullptr;
}

}  // namespace

// The library takes its memory from these as well. Not inlined: the compiler would find free() after new.
extern "C" void* aligned_alloc(size_t alignment, size_t size) noexcept { return allocate(size, alignment); }
__attribute__((noinline)) void* operator new(size_t size) {
  if (void* memory = allocate(size ? size : 1, alignof(std::max_align_t))) return memory;
  throw std::bad_alloc();
}
__attribute__((noinline)) void* operator new(size_t size, const std::nothrow_t&) noexcept { return allocate(size ? size : 1, alignof(std::max_align_t)); }
__attribute__((noinline)) void operator delete(void* memory) noexcept { std::free(memory); }
__attribute__((noinline)) void operator delete(void* memory, size_t) noexcept { std::free(memory); }

namespace aomgen::tests {

namespace {

void nothing(Engine&) {}

// Lets the 1st, 2nd, 3rd ... allocation of a call fail, in a new context each time; returns how many it has.
int check_every_failure(const std::function<void(Engine&)>& prepare, const std::function<int32_t(Engine&)>& call, const std::function<void(Engine&)>& check_failed = nothing) {
  for (int allowed = 0;; ++allowed) {
    progress().subject = std::to_string(allowed) + " allocations";
    Engine engine(nullptr, 2);
    prepare(engine);
    allocations_left = allowed;
    const int32_t status = call(engine);
    allocations_left = kUnlimited;
    if (status == AOMGEN_OK) return allowed;
    CHECK(status == AOMGEN_OUT_OF_MEMORY);
    CHECK(std::string(aomgen_last_error()) == "not enough memory");
    check_failed(engine);
    CHECK(call(engine) == AOMGEN_OK);
    if (allowed > 500) return -1;
  }
}

}  // namespace

TEST(passes_survive_that_memory_runs_out) {
  const World world = random_world(60, {3000, 1, 2, 70, 50, 2});
  Canvas canvas(world), want(world);
  Gradients gradients(world), want_gradients(world);
  const Pull pull(world, 3);
  Engine calm(nullptr, 2);
  CHECK(calm.draw(world, want) == AOMGEN_OK && calm.go_back(world, want, pull, want_gradients) == AOMGEN_OK);
  CHECK(check_every_failure(nothing, [&](Engine& e) { return e.draw(world, canvas); }) > 10);
  CHECK(canvas == want);
  CHECK(check_every_failure([&](Engine& e) { CHECK(e.draw(world, canvas) == AOMGEN_OK); }, [&](Engine& e) { return e.go_back(world, canvas, pull, gradients); }) > 1);
  CHECK(gradients == want_gradients);
  const AomgenScene scene = world.scene();
  const AomgenView view = world.view();
  Array<float> weights(static_cast<size_t>(world.count));
  CHECK(check_every_failure(nothing, [&](Engine& e) { return aomgen_contribution_weights(e.context(), &scene, &view, 1, want.alpha.data(), weights.data()); }) > 10);
}

TEST(sessions_survive_that_memory_runs_out) {
  const World world = random_world(61, {3000, 1, 0, 70, 50, 1});
  const AomgenScene scene = world.scene();
  const AomgenView view = world.view();
  AomgenSession* session = nullptr;
  const auto open = [&](Engine& e) {
    aomgen_session_free(session);
    session = nullptr;
    const int32_t status = aomgen_session_open(e.context(), &scene, &view, &session);
    CHECK((status == AOMGEN_OK) == (session != nullptr));
    return status;
  };
  const auto has_no_forward = [](Engine& e) {
    int64_t pairs[2];
    CHECK(aomgen_count_pairs(e.context(), &pairs[0], &pairs[1]) == AOMGEN_NO_FORWARD);
  };
  CHECK(check_every_failure(nothing, open, has_no_forward) > 20);
  Array<uint8_t> tiles(5 * 4);
  Array<float> depth(70 * 50);
  AomgenFrame frame{};
  frame.session = session;
  frame.cam_from_part = world.cam_from_part.data();
  frame.tiles = tiles.data();
  frame.depth = depth.data();
  CHECK(check_every_failure(nothing, [&](Engine& e) { return aomgen_session_draw(e.context(), &scene, 1, 0, 1, &frame); }) > 10);
  aomgen_session_free(session);
}

TEST(training_steps_survive_that_memory_runs_out) {
  std::vector<float> x(3 * 40 * 30, 0.5f), gradient(x.size()), rates(3, 0.1f);
  double loss = 0;
  CHECK(check_every_failure(nothing, [&](Engine& e) { return aomgen_image_loss(e.context(), 3, 30, 40, x.data(), x.data(), nullptr, 0.2f, &loss, gradient.data(), nullptr); }) > 1);
  CHECK(check_every_failure(nothing, [&](Engine& e) { return aomgen_adam_step(e.context(), 100, 3, x.data(), x.data(), gradient.data(), gradient.data(), rates.data(), 1); }) > 0);
}

}  // namespace aomgen::tests
