#include "images.h"

#include <cmath>
#include <cstdio>
#include <memory>

#include "world.h"

namespace aomgen::tests {

namespace {

constexpr float kTolerance = 1e-5f;

struct CloseFile {
  void operator()(std::FILE* file) const { std::fclose(file); }
};
using File = std::unique_ptr<std::FILE, CloseFile>;

struct Named {
  std::string name;
  std::vector<float> values;
};

bool write(const File& file, const std::string& name, const Array<float>& values) {
  char title[16] = {};
  std::snprintf(title, sizeof(title), "%s", name.c_str());
  const uint64_t count = values.size();
  return std::fwrite(title, sizeof(title), 1, file.get()) == 1 && std::fwrite(&count, sizeof(count), 1, file.get()) == 1 &&
         std::fwrite(values.data(), sizeof(float), count, file.get()) == count;
}

std::vector<Named> read(const char* path) {
  std::vector<Named> arrays;
  const File file(std::fopen(path, "rb"));
  char title[16];
  uint64_t count;
  while (file && std::fread(title, sizeof(title), 1, file.get()) == 1 && std::fread(&count, sizeof(count), 1, file.get()) == 1 && count < 1u << 26) {
    arrays.push_back({title, std::vector<float>(count)});
    if (std::fread(arrays.back().values.data(), sizeof(float), count, file.get()) != count) return {};
  }
  return arrays;
}

bool same(const Named& a, const Named& b) {
  if (a.name != b.name || a.values.size() != b.values.size()) return false;
  double largest = 0, most = 0, sum = 0;
  size_t beyond = 0;
  for (size_t i = 0; i < a.values.size(); ++i) {
    const double difference = std::fabs(static_cast<double>(a.values[i]) - b.values[i]);
    if (!std::isfinite(difference)) return false;
    largest = std::fmax(largest, std::fabs(a.values[i]));
    most = std::fmax(most, difference);
    sum += difference;
    beyond += difference > kTolerance;
  }
  const double share = static_cast<double>(beyond) / static_cast<double>(a.values.size()), mean = sum / static_cast<double>(a.values.size());
  std::printf("%-16s largest %9.3g  difference: mean %8.2g, most %8.2g, beyond 1e-5: %.4f %%\n", a.name.c_str(), largest, mean, most, 100 * share);
  const bool is_gradient = a.name[1] == 'd';
  return mean <= kTolerance * (is_gradient ? largest : 0.1) && (is_gradient || share < 0.005);
}

}  // namespace

bool write_images(const char* path) {
  const File file(std::fopen(path, "wb"));
  bool good = file != nullptr;
  for (int degree = 0; degree <= 3 && good; ++degree) {
    const World world = random_world(700 + static_cast<uint64_t>(degree), {1500, degree, 2, 161, 99, 1 + degree});
    Engine engine("baseline");
    Canvas canvas(world);
    Gradients gradients(world);
    good = engine.draw(world, canvas) == AOMGEN_OK && engine.go_back(world, canvas, Pull(world, 1), gradients) == AOMGEN_OK;
    const std::string prefix = std::to_string(degree);
    good = good && write(file, prefix + " rgb", canvas.rgb) && write(file, prefix + " depth", canvas.depth) && write(file, prefix + " alpha", canvas.alpha) &&
           write(file, prefix + " features", canvas.features) && write(file, prefix + "d means", gradients.means) && write(file, prefix + "d quats", gradients.quats) &&
           write(file, prefix + "d scales", gradients.scales) && write(file, prefix + "d opacities", gradients.opacities) && write(file, prefix + "d sh", gradients.sh);
    good = good && write(file, prefix + "d features", gradients.features) && write(file, prefix + "d pose", gradients.cam_from_part);
  }
  return good;
}

bool same_images(const char* path, const char* other) {
  const std::vector<Named> a = read(path), b = read(other);
  bool good = !a.empty() && a.size() == b.size();
  for (size_t i = 0; i < a.size() && i < b.size(); ++i) good &= same(a[i], b[i]);
  std::printf("%s\n", good ? "the same" : "NOT the same");
  return good;
}

}  // namespace aomgen::tests
