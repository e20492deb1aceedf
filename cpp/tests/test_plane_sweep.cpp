// The plane sweep refuses what it cannot do, and reads and writes inside its arrays.
#include <cmath>
#include <limits>

#include "../plane_sweep.h"
#include "check.h"
#include "world.h"

namespace aomgen::tests {

namespace {

struct Views {
  Views(int width, int height, int sources) : size(static_cast<size_t>(width) * static_cast<size_t>(height)) {
    reference = Random(1).numbers(size, 0.0f, 1.0f);
    others = Random(2).numbers(size * static_cast<size_t>(sources), 0.0f, 1.0f);
    for (int k = 0; k < sources; ++k) {
      rotations.insert(rotations.end(), {1, 0, 0, 0, 1, 0, 0, 0, 1});
      translations.insert(translations.end(), {3.0f * static_cast<float>(k + 1), 0.5f, 0.0f});
    }
    sweep = {width, height, sources, 8, reference.data(), others.data(), rotations.data(), translations.data(), 0.0f, 0.2f, 2, 1, 0.02f, 10.0f, 60.0f};
  }
  size_t size;
  std::vector<float> reference, others, rotations, translations;
  AomgenSweep sweep{};
};

}  // namespace

TEST(plane_sweep_on_small_images) {
  for (const auto& size : {std::pair{2, 2}, {2, 9}, {17, 3}, {24, 18}}) {
    Views views(size.first, size.second, 3);
    Array<float> depth(views.size), score(views.size);
    CHECK(aomgen_plane_sweep(&views.sweep, depth.data(), score.data()) == 0);
    CHECK(depth.guards_are_whole() && score.guards_are_whole());
    CHECK(all_finite(depth.data(), views.size) && all_finite(score.data(), views.size));
  }
}

TEST(plane_sweep_of_broken_numbers_returns) {
  for (float value : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity(), 3e38f, -3e38f})
    for (std::vector<float> Views::*field : {&Views::reference, &Views::others, &Views::rotations, &Views::translations}) {
      Views views(20, 15, 2);
      for (size_t i = 0; i < (views.*field).size(); i += 3) (views.*field)[i] = value;
      Array<float> depth(views.size), score(views.size);
      CHECK(aomgen_plane_sweep(&views.sweep, depth.data(), score.data()) == 0);
      CHECK(depth.guards_are_whole() && score.guards_are_whole());
    }
}

TEST(plane_sweep_refuses_impossible_requests) {
  const int numbers[] = {std::numeric_limits<int>::min(), -1, 0, 300, 100000, std::numeric_limits<int>::max()};
  for (int32_t AomgenSweep::*field : {&AomgenSweep::width, &AomgenSweep::height, &AomgenSweep::source_count, &AomgenSweep::plane_count,
                                      &AomgenSweep::window_radius, &AomgenSweep::best_sources})
    for (int number : numbers) {
      if (number == 300 && (field == &AomgenSweep::width || field == &AomgenSweep::height)) continue;  // a legal side
      Views views(6, 5, 2);
      Array<float> depth(views.size), score(views.size);
      views.sweep.*field = number;
      progress().subject = std::to_string(number);
      CHECK(aomgen_plane_sweep(&views.sweep, depth.data(), score.data()) == 1);
    }
  for (float AomgenSweep::*field : {&AomgenSweep::inverse_depth_step, &AomgenSweep::noise, &AomgenSweep::small_jump_penalty, &AomgenSweep::large_jump_penalty})
    for (float number : {-1.0f, std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
      Views views(6, 5, 2);
      Array<float> depth(views.size), score(views.size);
      views.sweep.*field = number;
      CHECK(aomgen_plane_sweep(&views.sweep, depth.data(), score.data()) == 1);
    }
  Views views(6, 5, 2);
  Array<float> depth(views.size), score(views.size);
  CHECK(aomgen_plane_sweep(nullptr, depth.data(), score.data()) == 1);
  CHECK(aomgen_plane_sweep(&views.sweep, nullptr, score.data()) == 1);
  CHECK(aomgen_plane_sweep(&views.sweep, depth.data(), nullptr) == 1);
  for (const float* AomgenSweep::*pointer : {&AomgenSweep::reference, &AomgenSweep::sources, &AomgenSweep::rotations, &AomgenSweep::translations}) {
    AomgenSweep sweep = views.sweep;
    sweep.*pointer = nullptr;
    CHECK(aomgen_plane_sweep(&sweep, depth.data(), score.data()) == 1);
  }
}

}  // namespace aomgen::tests
