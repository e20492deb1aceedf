// The image loss and the optimizer's step on sizes and numbers at the edge.
#include <cmath>
#include <limits>

#include "check.h"
#include "world.h"

namespace aomgen::tests {

namespace {

struct LossResult {
  double loss = -1;
  Array<float> gradient, by_gain;
  bool operator==(const LossResult& o) const { return loss == o.loss && gradient == o.gradient && by_gain == o.by_gain; }
};

LossResult loss_of(Engine& engine, int channels, int height, int width, const std::vector<float>& x, const std::vector<float>& y, bool with_gains) {
  const std::vector<float> gains = Random(4).numbers(static_cast<size_t>(channels), 0.8f, 1.2f);
  LossResult r;
  r.gradient = Array<float>(x.size());
  r.by_gain = Array<float>(static_cast<size_t>(with_gains ? channels : 0));
  CHECK(aomgen_image_loss(engine.context(), channels, height, width, x.data(), y.data(), with_gains ? gains.data() : nullptr, 0.2f, &r.loss,
                          r.gradient.data(), with_gains ? r.by_gain.data() : nullptr) == AOMGEN_OK);
  CHECK(r.gradient.guards_are_whole() && r.by_gain.guards_are_whole());
  return r;
}

}  // namespace

TEST(image_loss_on_odd_sizes) {
  for (const std::string& isa : instruction_sets())
    for (const auto& size : {std::pair{1, 1}, {1, 40}, {40, 1}, {5, 7}, {11, 16}, {17, 33}, {64, 65}}) {
      progress().subject = isa + ", " + std::to_string(size.first) + " x " + std::to_string(size.second);
      Engine one(isa.c_str(), 1), four(isa.c_str(), 4);
      const size_t count = static_cast<size_t>(3 * size.first * size.second);
      const std::vector<float> x = Random(1).numbers(count, 0.0f, 1.0f), y = Random(2).numbers(count, 0.0f, 1.0f);
      for (bool with_gains : {false, true}) {
        const LossResult r = loss_of(one, 3, size.first, size.second, x, y, with_gains);
        CHECK(r.loss > 0 && r.loss < 2);
        CHECK(all_finite(r.gradient.data(), count));
        CHECK(r == loss_of(four, 3, size.first, size.second, x, y, with_gains));
      }
      const LossResult same = loss_of(one, 3, size.first, size.second, x, x, false);
      CHECK(std::fabs(same.loss) < 1e-5);
    }
}

TEST(image_loss_of_broken_pixels_returns) {
  for (const std::string& isa : instruction_sets())
    for (float value : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity(), 3e38f}) {
      Engine engine(isa.c_str());
      std::vector<float> x = Random(1).numbers(3 * 20 * 30, 0.0f, 1.0f);
      const std::vector<float> y = x;
      for (size_t i = 0; i < x.size(); i += 17) x[i] = value;
      loss_of(engine, 3, 20, 30, x, y, true);
    }
}

TEST(adam_moves_every_value_against_its_gradient) {
  for (const std::string& isa : instruction_sets())
    for (const auto& shape : {std::pair{0, 3}, {1, 1}, {5, 1}, {7, 3}, {33, 4}, {1000, 48}, {2, 1024}}) {
      progress().subject = isa + ", " + std::to_string(shape.first) + " x " + std::to_string(shape.second);
      const size_t columns = static_cast<size_t>(shape.second), count = static_cast<size_t>(shape.first) * columns;
      const std::vector<float> gradients = Random(5).numbers(count, -1.0f, 1.0f), rates = Random(6).numbers(columns, 0.001f, 0.1f);
      Array<float> first(count);
      for (int threads : {1, 3}) {
        Array<float> values(count), means(count), squares(count);
        for (Array<float>* a : {&values, &means, &squares}) std::fill_n(a->data(), count, 0.0f);
        Engine engine(isa.c_str(), threads);
        CHECK(aomgen_adam_step(engine.context(), shape.first, shape.second, values.data(), gradients.data(), means.data(), squares.data(), rates.data(), 1) == AOMGEN_OK);
        CHECK(values.guards_are_whole() && means.guards_are_whole() && squares.guards_are_whole());
        bool right = true;
        for (size_t i = 0; i < count; ++i) right &= std::fabs(values[i] + std::copysign(rates[i % columns], gradients[i])) < 1e-4f * rates[i % columns] + 1e-9f;
        CHECK(right);
        if (threads == 1) first = values;
        else CHECK(values == first);
      }
    }
}

}  // namespace aomgen::tests
