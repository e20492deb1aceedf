// Scenes and cameras that no one would choose: whatever comes in, pictures and gradients are sound.
#include <cmath>
#include <functional>
#include <limits>

#include "check.h"
#include "world.h"

namespace aomgen::tests {

namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN(), kInf = std::numeric_limits<float>::infinity();

// What every picture must be. Colors are judged by the caller's bound, as SH may be any number.
void check_picture(const World& world, const Canvas& canvas) {
  CHECK(canvas.guards_are_whole());
  CHECK(all_finite(canvas.rgb.data(), canvas.rgb.size()));
  CHECK(all_finite(canvas.depth.data(), canvas.depth.size()));
  CHECK(all_finite(canvas.median_depth.data(), canvas.median_depth.size()));
  bool alpha_good = true, ids_good = true, depth_good = true;
  for (size_t i = 0; i < canvas.alpha.size(); ++i) {
    alpha_good &= canvas.alpha[i] >= 0.0f && canvas.alpha[i] <= 1.0f;
    depth_good &= canvas.depth[i] >= 0.0f && canvas.median_depth[i] >= 0.0f;
    ids_good &= canvas.max_id[i] >= -1 && canvas.max_id[i] < world.count && (canvas.max_id[i] >= 0) == (canvas.alpha[i] > 0.0f);
  }
  CHECK(alpha_good);
  CHECK(depth_good);
  CHECK(ids_good);
}

// The same numbers again, for the Gaussians in view alone.
void check_packed_gradients(Engine& engine, const World& world, const Canvas& canvas, const Gradients& dense) {
  int64_t visible = 0, pairs = 0;
  CHECK(aomgen_counts(engine.context(), &visible, &pairs) == AOMGEN_OK);
  CHECK(visible >= 0 && visible <= world.count && pairs >= 0);
  Gradients packed(world);
  Array<int32_t> rows(static_cast<size_t>(world.count));
  packed.rows = rows.data();
  CHECK(engine.go_back(world, canvas, Pull(world, 5), packed) == AOMGEN_OK);
  CHECK(packed.guards_are_whole() && rows.guards_are_whole());
  const struct {
    const Array<float>& dense;
    const Array<float>& packed;
  } pairs_of_arrays[] = {{dense.means, packed.means}, {dense.quats, packed.quats}, {dense.scales, packed.scales}, {dense.opacities, packed.opacities}, {dense.sh, packed.sh}, {dense.features, packed.features}};
  bool same = true;
  for (size_t row = 0; row < static_cast<size_t>(visible); ++row) {
    const size_t index = static_cast<size_t>(rows[row]);
    if (index >= static_cast<size_t>(world.count) || (row > 0 && rows[row] <= rows[row - 1])) {
      CHECK(!"rows are ascending indices into the scene");
      return;
    }
    for (const auto& pair : pairs_of_arrays) {
      const size_t width = pair.dense.size() / static_cast<size_t>(world.count);
      same &= width == 0 || std::memcmp(pair.dense.data() + index * width, pair.packed.data() + row * width, width * sizeof(float)) == 0;
    }
  }
  CHECK(same);
}

// Draws, pulls back and sums weights on every instruction set; every picture and gradient is sound.
void check_all_passes(const World& world, bool gradients_finite = true) {
  const std::string subject = progress().subject;
  for (const std::string& isa : instruction_sets()) {
    progress().subject = subject + ", " + isa;
    Engine engine(isa.c_str(), 2);
    Canvas canvas(world), interleaved(world, true);
    CHECK(engine.draw(world, interleaved) == AOMGEN_OK);
    CHECK(engine.draw(world, canvas) == AOMGEN_OK);
    check_picture(world, canvas);
    bool same = interleaved.guards_are_whole();
    const size_t plane = canvas.alpha.size();
    for (size_t i = 0; i < 3 * plane; ++i) same &= interleaved.rgb[i] == canvas.rgb[i % 3 * plane + i / 3];
    CHECK(same);
    Gradients gradients(world);
    CHECK(engine.go_back(world, canvas, Pull(world, 5), gradients) == AOMGEN_OK);
    CHECK(gradients.guards_are_whole());
    if (gradients_finite) CHECK(gradients.are_finite());
    check_packed_gradients(engine, world, canvas, gradients);
    const std::vector<float> masks = Random(3).numbers(3 * plane, 0.0f, 1.0f);
    Array<float> weights(3 * static_cast<size_t>(world.count));
    const AomgenScene scene = world.scene();
    const AomgenView view = world.view();
    CHECK(aomgen_contribution_weights(engine.context(), &scene, &view, 3, masks.data(), weights.data()) == AOMGEN_OK);
    CHECK(weights.guards_are_whole());
    CHECK(all_finite(weights.data(), weights.size()));
  }
  progress().subject = subject;
}

std::string text(double number) {
  char buffer[40];
  std::snprintf(buffer, sizeof(buffer), "%g", number);
  return buffer;
}

}  // namespace

TEST(image_sizes) {
  for (const auto& size : {std::pair{1, 1}, {1, 17}, {33, 1}, {3, 5}, {15, 16}, {16, 16}, {17, 31}, {64, 2}}) {
    progress().subject = std::to_string(size.first) + " x " + std::to_string(size.second);
    check_all_passes(random_world(1, {40, 2, 3, size.first, size.second, 1}));
  }
}

TEST(gaussian_counts_around_the_vector_width) {
  for (int count : {0, 1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 31, 33, 255, 257}) {
    progress().subject = std::to_string(count) + " Gaussians";
    check_all_passes(random_world(2, {count, count % 4, count % 3, 20, 18, 1 + count % 2}));
  }
}

TEST(nothing_to_draw_leaves_the_background) {
  for (int64_t count : {0, 30}) {
    World world = random_world(3, {count, 1, 0, 19, 21, 1});
    for (int64_t i = 0; i < count; ++i) world.means[3 * static_cast<size_t>(i) + 2] = -2.0f;
    for (const std::string& isa : instruction_sets()) {
      Canvas canvas(world);
      CHECK(Engine(isa.c_str()).draw(world, canvas) == AOMGEN_OK);
      bool is_background = true;
      for (size_t i = 0; i < canvas.rgb.size(); ++i) is_background &= canvas.rgb[i] == world.background[i / canvas.alpha.size()];
      for (size_t i = 0; i < canvas.alpha.size(); ++i) is_background &= canvas.alpha[i] == 0 && canvas.max_id[i] == -1;
      CHECK(is_background);
    }
  }
}

// Gaussians with a NaN or infinite number change no pixel and get no gradient.
TEST(broken_numbers_are_left_out) {
  const World good = random_world(4, {50, 2, 2, 30, 22, 2});
  for (const std::string& isa : instruction_sets())
    for (float value : {kNan, kInf, -kInf}) {
      progress().subject = isa + ", " + text(value);
      World broken = good;
      std::vector<float>* const fields[] = {&broken.means, &broken.quats, &broken.scales, &broken.opacities, &broken.sh};
      for (int bad = 0; bad < 20; ++bad) {
        const World extra = random_world(50 + static_cast<uint64_t>(bad), {1, 2, 2, 30, 22, 1});
        const std::vector<float>* const from[] = {&extra.means, &extra.quats, &extra.scales, &extra.opacities, &extra.sh};
        for (int f = 0; f < 5; ++f) fields[f]->insert(fields[f]->end(), from[f]->begin(), from[f]->end());
        std::vector<float>& field = *fields[bad % 5];
        field[field.size() - 1 - static_cast<size_t>(bad) % from[bad % 5]->size()] = value;
        broken.feature_values.insert(broken.feature_values.end(), {1.0f, 1.0f});
        broken.parts.push_back(0);
        ++broken.count;
      }
      Engine engine(isa.c_str());
      Canvas want(good), have(broken);
      CHECK(engine.draw(good, want) == AOMGEN_OK);
      CHECK(engine.draw(broken, have) == AOMGEN_OK);
      CHECK(want == have);
      Gradients gradients(broken);
      CHECK(engine.go_back(broken, have, Pull(broken, 1), gradients) == AOMGEN_OK);
      CHECK(gradients.are_finite());
      bool is_zero = true;
      for (size_t i = 3 * static_cast<size_t>(good.count); i < gradients.means.size(); ++i) is_zero &= gradients.means[i] == 0;
      CHECK(is_zero);
    }
}

// Also as logarithms and logits, where the bits of a NaN are taken apart.
TEST(every_kind_of_nan_is_left_out) {
  for (const std::string& isa : instruction_sets())
    for (uint32_t bits : {0x7fc00000u, 0x7fc00001u, 0xffffffffu, 0x7f800001u})
      for (bool encoded : {false, true})
        for (int field = 0; field < 5; ++field) {
          progress().subject = isa + ", NaN " + std::to_string(bits) + ", field " + std::to_string(field);
          World world = random_world(6, {30, 1, 0, 30, 22, 1});
          world.encoded = encoded;
          std::vector<float>* const fields[] = {&world.means, &world.quats, &world.scales, &world.opacities, &world.sh};
          for (float& number : *fields[field]) std::memcpy(&number, &bits, sizeof(number));
          Engine engine(isa.c_str());
          Canvas canvas(world);
          CHECK(engine.draw(world, canvas) == AOMGEN_OK);
          int64_t visible = -1, pairs = 0;
          CHECK(aomgen_counts(engine.context(), &visible, &pairs) == AOMGEN_OK && visible == 0);
        }
}

TEST(extreme_parameters) {
  const struct {
    const char* name;
    std::vector<float> World::*field;
  } fields[] = {{"means", &World::means}, {"quats", &World::quats}, {"scales", &World::scales}, {"opacities", &World::opacities}, {"sh", &World::sh}};
  for (const auto& field : fields)
    for (float value : {0.0f, -1.0f, 1e-40f, 1e-20f, 1e5f, 1e20f, 3e38f, -3e38f}) {
      World world = random_world(6, {60, 1, 0, 24, 21, 1});
      std::vector<float>& numbers = world.*field.field;
      for (size_t i = 0; i < numbers.size(); i += 5) numbers[i] = value;
      progress().subject = std::string(field.name) + " = " + text(value) + " here and there";
      check_all_passes(world, std::fabs(value) < 1e30f);
      std::fill(numbers.begin(), numbers.end(), value);
      progress().subject = std::string("all ") + field.name + " = " + text(value);
      check_all_passes(world, std::fabs(value) < 1e30f);
    }
}

TEST(degenerate_shapes) {
  for (const auto& axes : {std::vector<float>{1e3f, 1e-6f, 1e-6f}, {1e6f, 1e6f, 0.0f}, {1e3f, 1e-3f, 1.0f}, {1e-20f, 1e-20f, 1e20f}, {1e8f, 1e-8f, 1e-8f}}) {
    World world = random_world(8, {80, 1, 0, 33, 18, 1});
    for (size_t i = 0; i < world.scales.size(); ++i) world.scales[i] = axes[i % 3];
    progress().subject = "scales " + text(axes[0]) + " " + text(axes[1]) + " " + text(axes[2]);
    check_all_passes(world);
  }
}

// Thin and long ones lose all digits of their exponent far from their centre.
TEST(needles) {
  Random random(5);
  for (int round = 0; round < 150; ++round) {
    progress().subject = "round " + std::to_string(round);
    World world = random_world(300 + static_cast<uint64_t>(round), {40, 0, 1, 40, 35, 1});
    for (float& scale : world.scales) scale = std::ldexp(1.0f, random.below(2) ? random.below(25) : -random.below(25));
    for (float& mean : world.means) mean *= std::ldexp(1.0f, random.below(14));
    check_all_passes(world);
  }
}

TEST(a_camera_inside_the_scene) {
  for (float near_depth : {1e-30f, 1e-6f, 0.01f, 0.5f, 1e30f}) {
    World world = random_world(9, {400, 3, 1, 40, 30, 1});
    world.means = Random(1).numbers(world.means.size(), -0.3f, 0.3f);
    world.near_depth = near_depth;
    progress().subject = "near depth " + text(near_depth);
    check_all_passes(world, near_depth > 1e-5f);
  }
}

TEST(all_gaussians_in_one_place) {
  World world = random_world(10, {300, 1, 0, 30, 30, 1});
  for (size_t i = 0; i < world.means.size(); ++i) world.means[i] = i % 3 == 2 ? 1.0f : 0.01f;
  check_all_passes(world);
}

TEST(gigantic_splats_cover_every_tile) {
  World world = random_world(11, {600, 0, 0, 90, 70, 1});
  for (float& scale : world.scales) scale = 50.0f;
  for (float& opacity : world.opacities) opacity = 0.005f;
  check_all_passes(world);
}

TEST(strange_cameras) {
  const struct {
    const char* name;
    std::function<void(World&)> change;
    bool gradients_finite;
  } cases[] = {
      {"focal length 1e8", [](World& w) { w.fx = w.fy = 1e8f; }, true},
      {"focal length 1e-8", [](World& w) { w.fx = w.fy = 1e-8f; }, true},
      {"focal length 1e-30", [](World& w) { w.fx = w.fy = 1e-30f; }, false},
      {"focal length 1e30", [](World& w) { w.fx = w.fy = 1e30f; }, false},
      {"centre far away", [](World& w) { w.cx = 1e9f; w.cy = -1e9f; }, true},
      {"centre out of range", [](World& w) { w.cx = 3e38f; w.cy = -3e38f; }, true},
      {"far away", [](World& w) { w.cam_from_part[11] = 1e30f; }, true},
      {"beyond numbers", [](World& w) { w.cam_from_part[3] = 3e38f; w.cam_from_part[11] = 3e38f; }, true},
      {"flat rotation", [](World& w) { std::fill_n(w.cam_from_part.begin(), 3, 0.0f); }, true},
      {"huge rotation", [](World& w) { for (int i : {0, 1, 2, 4, 5, 6, 8, 9, 10}) w.cam_from_part[static_cast<size_t>(i)] *= 1e15f; }, false},
      {"zero pose", [](World& w) { std::fill(w.cam_from_part.begin(), w.cam_from_part.end(), 0.0f); }, true},
      {"huge background", [](World& w) { w.background[0] = 1e30f; w.background[2] = -1e30f; }, false},
  };
  for (const auto& c : cases) {
    World world = random_world(12, {60, 1, 0, 25, 19, 1});
    c.change(world);
    progress().subject = c.name;
    check_all_passes(world, c.gradients_finite);
  }
}

TEST(logarithms_logits_and_antialiasing) {
  for (bool encoded : {false, true})
    for (float shift : {0.0f, -50.0f, 50.0f, -3e38f, 3e38f}) {
      World world = random_world(13, {60, 1, 2, 25, 19, 3});
      world.encoded = encoded;
      world.antialiased = true;
      for (size_t i = 0; i < world.scales.size(); i += 2) world.scales[i] += shift;
      for (size_t i = 0; i < world.opacities.size(); i += 3) world.opacities[i] -= shift;
      progress().subject = std::string(encoded ? "encoded" : "plain") + ", moved by " + text(shift);
      check_all_passes(world, std::fabs(shift) < 1e30f);
    }
}

// Numbers of any magnitude in any place, thousands of scenes: pictures stay sound.
TEST(random_magnitudes) {
  Random random(77);
  const auto any_number = [&random] { return std::ldexp(random.uniform(-1.0f, 1.0f), random.below(2) ? random.below(276) - 148 : random.below(30) - 20); };
  for (int round = 0; round < 600; ++round) {
    progress().subject = "round " + std::to_string(round);
    World world = random_world(1000 + static_cast<uint64_t>(round), {1 + random.below(40), random.below(4), random.below(3), 1 + random.below(40), 1 + random.below(40), 1 + random.below(3)});
    for (std::vector<float>* field : {&world.means, &world.quats, &world.scales, &world.opacities, &world.sh})
      if (random.below(2))
        for (float& number : *field)
          if (random.below(3) == 0) number = any_number();
    if (random.below(4) == 0) world.fx = std::fabs(any_number()) + 1e-37f;
    if (random.below(4) == 0) world.fy = std::fabs(any_number()) + 1e-37f;
    if (random.below(4) == 0) world.cx = any_number();
    if (random.below(4) == 0) world.cam_from_part[static_cast<size_t>(random.below(12))] = any_number();
    world.encoded = random.below(2);
    world.antialiased = random.below(2);
    check_all_passes(world, false);
  }
}

TEST(broken_image_gradients_do_no_harm_to_memory) {
  const World world = random_world(14, {100, 3, 2, 37, 29, 3});
  for (const std::string& isa : instruction_sets())
    for (float value : {kNan, kInf, 3e38f}) {
      Engine engine(isa.c_str(), 2);
      Canvas canvas(world);
      CHECK(engine.draw(world, canvas) == AOMGEN_OK);
      Pull pull(world, 2);
      for (std::vector<float>* image : {&pull.rgb, &pull.depth, &pull.alpha, &pull.features})
        for (size_t i = 0; i < image->size(); i += 3) (*image)[i] = value;
      Gradients gradients(world);
      CHECK(engine.go_back(world, canvas, pull, gradients) == AOMGEN_OK);
      CHECK(gradients.guards_are_whole());
    }
}

}  // namespace aomgen::tests
