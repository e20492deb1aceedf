// Render sessions: frames equal the full render bit for bit, also of scenes that no one would choose,
// and arguments that are wrong are refused.
#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <thread>

#include "check.h"
#include "world.h"

namespace aomgen::tests {

namespace {

constexpr int32_t kMost = std::numeric_limits<int32_t>::max(), kLeast = std::numeric_limits<int32_t>::min();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

struct FreeSession {
  void operator()(AomgenSession* session) const { aomgen_session_free(session); }
};
using SessionPointer = std::unique_ptr<AomgenSession, FreeSession>;

// Gaussians [first, last) of a world.
World part_of(const World& w, size_t first, size_t last) {
  World some = w;
  const auto cut = [&](auto& values) {
    const auto width = values.empty() ? 0 : values.size() / static_cast<size_t>(w.count);
    values = {values.begin() + static_cast<long>(first * width), values.begin() + static_cast<long>(last * width)};
  };
  some.count = static_cast<int64_t>(last - first);
  for (std::vector<float>* values : {&some.means, &some.quats, &some.scales, &some.opacities, &some.sh, &some.feature_values}) cut(*values);
  cut(some.parts);
  return some;
}

// A world whose first Gaussians, all in part 0, never move.
struct Divided {
  explicit Divided(World world, double still_share = 0.6) : all(std::move(world)) {
    const size_t count = static_cast<size_t>(all.count), still_count = static_cast<size_t>(still_share * static_cast<double>(count));
    if (!all.parts.empty()) std::fill_n(all.parts.begin(), still_count, 0);
    still = part_of(all, 0, still_count);
    moving = part_of(all, still_count, count);
  }
  void move_parts(Random& random) {
    for (size_t i = 12; i < all.cam_from_part.size(); ++i)
      if (i % 4 == 3) all.cam_from_part[i] += random.uniform(-0.3f, 0.3f);
  }
  World all, still, moving;
};

SessionPointer open_session(const Engine& engine, const World& still) {
  AomgenSession* session = nullptr;
  const AomgenScene scene = still.scene();
  const AomgenView view = still.view();
  CHECK(aomgen_session_open(engine.context(), &scene, &view, &session) == AOMGEN_OK);
  CHECK(session);
  return SessionPointer(session);
}

// Arrays of one frame.
struct Film {
  explicit Film(const World& world)
      : canvas(world, true), rgb8(canvas.rgb.size()), tiles(static_cast<size_t>((world.width + 15) / 16) * static_cast<size_t>((world.height + 15) / 16)) {
    std::fill_n(tiles.data(), tiles.size(), uint8_t{1});
  }
  AomgenFrame frame(const AomgenSession* session, const World& all) {
    AomgenFrame f{};
    f.session = session;
    f.cam_from_part = all.cam_from_part.data();
    f.tiles = tiles.data();
    f.rgb8 = rgb8.data();
    f.rgb = canvas.rgb.data();
    f.depth = canvas.depth.data();
    f.alpha = canvas.alpha.data();
    f.median_depth = canvas.median_depth.data();
    f.max_id = canvas.max_id.data();
    return f;
  }
  bool guards_are_whole() const { return canvas.guards_are_whole() && rgb8.guards_are_whole() && tiles.guards_are_whole(); }

  Canvas canvas;
  Array<uint8_t> rgb8, tiles;
};

int32_t draw(const Engine& engine, const Divided& d, const std::vector<AomgenFrame>& frames) {
  const AomgenScene moving = d.moving.scene();
  return aomgen_session_draw(engine.context(), &moving, d.all.part_count, 0, static_cast<int32_t>(frames.size()), frames.data());
}

// Three frames with parts that move, drawn into the same arrays, against the full render.
void check_frames(Divided d, const std::string& isa, int threads) {
  Engine engine(isa.c_str(), threads), full(isa.c_str(), 1);
  const SessionPointer session = open_session(engine, d.still);
  Film film(d.all);
  Random random(3);
  for (int round = 0; round < 3; ++round) {
    CHECK(draw(engine, d, {film.frame(session.get(), d.all)}) == AOMGEN_OK);
    CHECK(film.guards_are_whole());
    Canvas want(d.all, true);
    CHECK(full.draw(d.all, want) == AOMGEN_OK);
    const bool same = film.canvas.rgb == want.rgb && film.canvas.depth == want.depth && film.canvas.alpha == want.alpha &&
                      film.canvas.median_depth == want.median_depth && film.canvas.max_id == want.max_id;
    CHECK(same);
    bool rounded = true;
    for (size_t i = 0; i < want.rgb.size(); ++i) rounded &= std::fabs(film.rgb8[i] - 255.0f * std::fmin(std::fmax(want.rgb[i], 0.0f), 1.0f)) <= 0.501f;
    CHECK(rounded);
    d.move_parts(random);
  }
}

}  // namespace

TEST(session_frames_equal_the_full_render) {
  for (const std::string& isa : instruction_sets())
    for (int threads : {1, 3}) {
      progress().subject = isa + ", " + std::to_string(threads) + " threads";
      check_frames(Divided(random_world(40, {1500, 2, 0, 99, 70, 4})), isa, threads);
    }
}

TEST(session_frames_of_few_gaussians_and_small_images) {
  for (const std::string& isa : instruction_sets())
    for (int count : {0, 1, 2, 17})
      for (double still_share : {0.0, 0.5, 1.0})
        for (const auto& size : {std::pair{1, 1}, {33, 2}, {16, 16}}) {
          progress().subject = isa + ", " + std::to_string(count) + " Gaussians, " + std::to_string(size.first) + " x " + std::to_string(size.second);
          check_frames(Divided(random_world(41, {count, 1, 0, size.first, size.second, 2}), still_share), isa, 2);
        }
}

TEST(session_frames_of_random_magnitudes) {
  Random random(78);
  const auto any_number = [&random] { return std::ldexp(random.uniform(-1.0f, 1.0f), random.below(2) ? random.below(276) - 148 : random.below(30) - 20); };
  for (int round = 0; round < 100; ++round) {
    World world = random_world(2000 + static_cast<uint64_t>(round), {1 + random.below(60), random.below(4), 0, 1 + random.below(40), 1 + random.below(40), 1 + random.below(3)});
    for (std::vector<float>* field : {&world.means, &world.quats, &world.scales, &world.opacities, &world.sh})
      if (random.below(2))
        for (float& number : *field)
          if (random.below(4) == 0) number = random.below(8) ? any_number() : kNan;
    for (const std::string& isa : instruction_sets()) {
      progress().subject = "round " + std::to_string(round) + ", " + isa;
      check_frames(Divided(world), isa, 2);
    }
  }
}

TEST(each_image_of_a_session_may_be_wanted_alone) {
  const Divided d(random_world(46, {60, 1, 0, 60, 50, 2}), 0.95);
  const std::vector<float> shade = Random(4).numbers(60 * 50, 0.2f, 1.0f);
  for (const std::string& isa : instruction_sets())
    for (const float* factor : {static_cast<const float*>(nullptr), shade.data()}) {
      Engine engine(isa.c_str());
      const SessionPointer session = open_session(engine, d.still);
      Film all(d.all);
      AomgenFrame frame = all.frame(session.get(), d.all);
      frame.shade = factor;
      CHECK(draw(engine, d, {frame}) == AOMGEN_OK);
      for (int wanted = 0; wanted < 5; ++wanted) {
        progress().subject = isa + ", image " + std::to_string(wanted) + (factor ? ", shaded" : "");
        Film one(d.all);
        frame = one.frame(session.get(), d.all);
        frame.shade = factor;
        if (wanted != 0) frame.rgb8 = nullptr;
        if (wanted != 1) frame.rgb = nullptr;
        if (wanted != 2) frame.depth = nullptr;
        if (wanted != 3) frame.alpha = nullptr;
        if (wanted != 4) frame.median_depth = nullptr, frame.max_id = nullptr;
        CHECK(draw(engine, d, {frame}) == AOMGEN_OK);
        if (wanted == 0) CHECK(one.rgb8 == all.rgb8);
        if (wanted == 1) CHECK(one.canvas.rgb == all.canvas.rgb);
        if (wanted == 2) CHECK(one.canvas.depth == all.canvas.depth);
        if (wanted == 3) CHECK(one.canvas.alpha == all.canvas.alpha);
        if (wanted == 4) CHECK(one.canvas.median_depth == all.canvas.median_depth && one.canvas.max_id == all.canvas.max_id);
        CHECK(one.guards_are_whole());
      }
    }
}

TEST(several_frames_at_once_equal_one_after_the_other) {
  Divided d(random_world(42, {900, 1, 0, 80, 60, 3}));
  Engine engine(nullptr, 4);
  const SessionPointer session = open_session(engine, d.still);
  Random random(9);
  std::vector<Divided> moments;
  std::vector<Film> alone, together;
  for (int i = 0; i < 7; ++i) {
    d.move_parts(random);
    moments.push_back(d);
    alone.emplace_back(d.all);
    together.emplace_back(d.all);
  }
  std::vector<AomgenFrame> frames;
  for (size_t i = 0; i < moments.size(); ++i) {
    CHECK(draw(engine, d, {alone[i].frame(session.get(), moments[i].all)}) == AOMGEN_OK);
    frames.push_back(together[i].frame(session.get(), moments[i].all));
  }
  CHECK(draw(engine, d, frames) == AOMGEN_OK);
  for (size_t i = 0; i < moments.size(); ++i) CHECK(alone[i].canvas == together[i].canvas && alone[i].rgb8 == together[i].rgb8 && together[i].guards_are_whole());
}

TEST(callers_share_a_session) {
  const Divided d(random_world(43, {900, 1, 0, 80, 60, 3}));
  Engine engine;
  const SessionPointer session = open_session(engine, d.still);
  std::vector<Film> films(3, Film(d.all));
  std::vector<std::thread> callers;
  for (Film& film : films)
    callers.emplace_back([&] {
      Engine own(nullptr, 2);
      for (int round = 0; round < 5; ++round) CHECK(draw(own, d, {film.frame(session.get(), d.all)}) == AOMGEN_OK);
    });
  for (std::thread& caller : callers) caller.join();
  CHECK(films[0].canvas == films[1].canvas && films[0].canvas == films[2].canvas);
}

TEST(colors_and_shade_of_any_number) {
  const Divided d(random_world(44, {300, 1, 0, 50, 40, 2}));
  for (const std::string& isa : instruction_sets())
    for (float value : {kNan, std::numeric_limits<float>::infinity(), -1.0f, 3e38f, 0.5f}) {
      Engine engine(isa.c_str(), 2);
      const SessionPointer session = open_session(engine, d.still);
      const AomgenScene moving = d.moving.scene();
      std::vector<float> colors = Random(1).numbers(3 * static_cast<size_t>(moving.count), 0.0f, 1.0f), shade(50 * 40, 1.0f);
      for (size_t i = 0; i < colors.size(); i += 7) colors[i] = value;
      for (size_t i = 0; i < shade.size(); i += 5) shade[i] = value;
      Film film(d.all);
      AomgenFrame frame = film.frame(session.get(), d.all);
      frame.colors = colors.data();
      frame.shade = shade.data();
      CHECK(aomgen_session_draw(engine.context(), &moving, d.all.part_count, moving.count, 1, &frame) == AOMGEN_OK);
      CHECK(film.guards_are_whole());
      CHECK(all_finite(film.canvas.depth.data(), film.canvas.depth.size()) && all_finite(film.canvas.alpha.data(), film.canvas.alpha.size()));
    }
}

TEST(damaged_arguments_of_sessions_are_refused) {
  const Divided d(random_world(45, {80, 1, 0, 40, 30, 2}));
  Engine engine;
  const SessionPointer session = open_session(engine, d.still);
  const AomgenScene still = d.still.scene();
  const AomgenView view = d.still.view();
  AomgenSession* opened = nullptr;
  CHECK(aomgen_session_open(nullptr, &still, &view, &opened) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_session_open(engine.context(), nullptr, &view, &opened) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_session_open(engine.context(), &still, nullptr, &opened) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_session_open(engine.context(), &still, &view, nullptr) == AOMGEN_INVALID_ARGUMENT);
  CHECK(!opened);
  aomgen_session_free(nullptr);

  struct Request {
    AomgenScene moving;
    int32_t parts, frames;
    int64_t colored;
    AomgenFrame frame;
    std::vector<float> poses;
    std::vector<int32_t> indices;
  };
  const std::function<void(Request&)> damages[] = {
      [](Request& r) { r.frame.session = nullptr; },
      [](Request& r) { r.frame.cam_from_part = nullptr; },
      [](Request& r) { r.frame.tiles = nullptr; },
      [](Request& r) { r.frame.rgb8 = nullptr; r.frame.rgb = r.frame.depth = r.frame.alpha = r.frame.median_depth = nullptr; r.frame.max_id = nullptr; },
      [](Request& r) { r.frame.median_depth = nullptr; },
      [](Request& r) { r.frame.max_id = nullptr; },
      [](Request& r) { r.poses[13] = kNan; },
      [](Request& r) { r.indices[3] = 2; },
      [](Request& r) { r.indices[3] = -1; },
      [](Request& r) { r.parts = 0; },
      [](Request& r) { r.parts = 4097; },
      [](Request& r) { r.parts = kMost; },
      [](Request& r) { r.frames = -1; },
      [](Request& r) { r.frames = kLeast; },
      [](Request& r) { r.colored = 1; },
      [](Request& r) { r.colored = -1; },
      [](Request& r) { r.colored = r.moving.count + 1; },
      [](Request& r) { r.moving.count = -1; },
      [](Request& r) { r.moving.count = 1 << 24; },
      [](Request& r) { r.moving.sh_degree = 2; },
      [](Request& r) { r.moving.means = nullptr; },
  };
  Film film(d.all);
  size_t which = 0;
  for (const auto& damage : damages) {
    progress().subject = "damage " + std::to_string(which++);
    Request r{d.moving.scene(), 2, 1, 0, film.frame(session.get(), d.all), d.all.cam_from_part, d.moving.parts};
    r.frame.cam_from_part = r.poses.data();
    r.moving.parts = r.indices.data();
    if (which == 19) r.moving.parts = nullptr;  // as many parts are not there to be looked at
    damage(r);
    CHECK(aomgen_session_draw(engine.context(), &r.moving, r.parts, r.colored, r.frames, &r.frame) == AOMGEN_INVALID_ARGUMENT);
  }
  const AomgenScene moving = d.moving.scene();
  const AomgenFrame frame = film.frame(session.get(), d.all);
  CHECK(aomgen_session_draw(nullptr, &moving, 2, 0, 1, &frame) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_session_draw(engine.context(), nullptr, 2, 0, 1, &frame) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_session_draw(engine.context(), &moving, 2, 0, 1, nullptr) == AOMGEN_INVALID_ARGUMENT);
  CHECK(aomgen_session_draw(engine.context(), &moving, 2, 0, 0, nullptr) == AOMGEN_OK);
  CHECK(film.guards_are_whole());
}

}  // namespace aomgen::tests
