#include "world.h"

#include <cmath>

#include "check.h"

namespace aomgen::tests {

std::vector<float> Random::numbers(size_t count, float low, float high) {
  std::vector<float> values(count);
  for (float& value : values) value = uniform(low, high);
  return values;
}

AomgenScene World::scene() const {
  AomgenScene s{};
  s.count = count;
  s.sh_coefficients = coefficients;
  s.sh_degree = degree;
  s.means = means.data();
  s.quats = quats.data();
  s.scales = scales.data();
  s.opacities = opacities.data();
  s.sh = sh.data();
  s.encoded = encoded;
  s.feature_count = features;
  s.features = features ? feature_values.data() : nullptr;
  s.parts = parts.empty() ? nullptr : parts.data();
  return s;
}

AomgenView World::view() const {
  AomgenView v{};
  v.width = width;
  v.height = height;
  v.fx = fx;
  v.fy = fy;
  v.cx = cx;
  v.cy = cy;
  v.near_depth = near_depth;
  std::memcpy(v.background, background, sizeof(background));
  v.antialiased = antialiased;
  v.part_count = part_count;
  v.cam_from_part = cam_from_part.data();
  return v;
}

World random_world(uint64_t seed, const Shape& shape) {
  Random random(seed);
  World w;
  w.count = shape.count;
  w.degree = shape.degree;
  w.coefficients = (shape.degree + 1) * (shape.degree + 1);
  w.features = shape.features;
  w.width = shape.width;
  w.height = shape.height;
  w.part_count = shape.parts;
  w.fx = 0.9f * static_cast<float>(shape.width) + 3.0f;
  w.fy = 1.1f * static_cast<float>(shape.width) + 3.0f;
  w.cx = 0.47f * static_cast<float>(shape.width);
  w.cy = 0.55f * static_cast<float>(shape.height);
  const size_t n = static_cast<size_t>(shape.count);
  w.means = random.numbers(3 * n, -1.0f, 1.0f);
  for (size_t i = 0; i < n; ++i) w.means[3 * i + 2] = random.uniform(0.5f, 4.0f);
  w.quats = random.numbers(4 * n, -1.0f, 1.0f);
  w.scales.resize(3 * n);
  for (float& scale : w.scales) {
    const float u = random.uniform(0.0f, 1.0f);
    scale = 0.003f + 0.2f * u * u * u;
  }
  w.opacities = random.numbers(n, 0.0f, 1.0f);
  w.sh = random.numbers(3 * n * static_cast<size_t>(w.coefficients), -0.6f, 0.6f);
  w.feature_values = random.numbers(n * static_cast<size_t>(shape.features), -1.0f, 1.0f);
  for (int part = 0; part < shape.parts; ++part) {
    const float s = random.uniform(-0.3f, 0.3f), c = std::sqrt(1.0f - s * s);
    const float rows[12] = {c, 0, s, random.uniform(-0.2f, 0.2f), 0, 1, 0, random.uniform(-0.2f, 0.2f), -s, 0, c, 0.1f};
    w.cam_from_part.insert(w.cam_from_part.end(), rows, rows + 12);
  }
  if (shape.parts > 1)
    for (size_t i = 0; i < n; ++i) w.parts.push_back(random.below(shape.parts));
  return w;
}

namespace {

size_t pixels(const World& world) { return static_cast<size_t>(world.width) * static_cast<size_t>(world.height); }

}  // namespace

Canvas::Canvas(const World& world, bool interleaved)
    : interleaved(interleaved),
      rgb(3 * pixels(world)),
      depth(pixels(world)),
      alpha(pixels(world)),
      median_depth(pixels(world)),
      features(pixels(world) * static_cast<size_t>(world.features)),
      max_id(pixels(world)) {}

AomgenImages Canvas::images() {
  AomgenImages images{};
  images.rgb = rgb.data();
  images.interleaved = interleaved;
  images.differentiable = !interleaved;
  images.depth = depth.data();
  images.alpha = alpha.data();
  images.median_depth = median_depth.data();
  images.max_id = max_id.data();
  images.features = features.size() ? features.data() : nullptr;
  return images;
}

bool Canvas::guards_are_whole() const {
  for (const Array<float>* image : {&rgb, &depth, &alpha, &median_depth, &features})
    if (!image->guards_are_whole()) return false;
  return max_id.guards_are_whole();
}

bool Canvas::operator==(const Canvas& o) const {
  return rgb == o.rgb && depth == o.depth && alpha == o.alpha && median_depth == o.median_depth && features == o.features && max_id == o.max_id;
}

Pull::Pull(const World& world, uint64_t seed) {
  Random random(seed);
  rgb = random.numbers(3 * pixels(world), -1.0f, 1.0f);
  depth = random.numbers(pixels(world), -1.0f, 1.0f);
  alpha = random.numbers(pixels(world), -1.0f, 1.0f);
  features = random.numbers(pixels(world) * static_cast<size_t>(world.features), -1.0f, 1.0f);
}

Gradients::Gradients(const World& world)
    : means(world.means.size()),
      quats(world.quats.size()),
      scales(world.scales.size()),
      opacities(world.opacities.size()),
      sh(world.sh.size()),
      features(world.feature_values.size()),
      cam_from_part(world.cam_from_part.size()) {}

AomgenSceneGradients Gradients::pointers() {
  AomgenSceneGradients g{};
  g.rows = rows;
  g.means = means.data();
  g.quats = quats.data();
  g.scales = scales.data();
  g.opacities = opacities.data();
  g.sh = sh.data();
  g.features = features.size() ? features.data() : nullptr;
  g.cam_from_part = cam_from_part.data();
  return g;
}

bool Gradients::guards_are_whole() const {
  for (const Array<float>* g : {&means, &quats, &scales, &opacities, &sh, &features, &cam_from_part})
    if (!g->guards_are_whole()) return false;
  return true;
}

bool Gradients::operator==(const Gradients& o) const {
  return means == o.means && quats == o.quats && scales == o.scales && opacities == o.opacities && sh == o.sh && features == o.features &&
         cam_from_part == o.cam_from_part;
}

bool Gradients::are_finite() const {
  for (const Array<float>* g : {&means, &quats, &scales, &opacities, &sh, &features})
    if (!all_finite(g->data(), g->size())) return false;
  return true;
}

Engine::Engine(const char* instruction_set, int threads) : context_(aomgen_context_new()) {
  CHECK(context_);
  CHECK(aomgen_context_configure(context_, threads, instruction_set) == AOMGEN_OK);
}

int32_t Engine::draw(const World& world, Canvas& canvas) {
  const AomgenScene scene = world.scene();
  const AomgenView view = world.view();
  AomgenImages images = canvas.images();
  return aomgen_forward(context_, &scene, &view, &images);
}

int32_t Engine::go_back(const World&, const Canvas& canvas, const Pull& pull, Gradients& gradients) {
  AomgenImageGradients images{};
  images.rgb = pull.rgb.data();
  images.depth = pull.depth.data();
  images.alpha = pull.alpha.data();
  if (!pull.features.empty()) {
    images.features = pull.features.data();
    images.drawn_features = canvas.features.data();
  }
  const AomgenSceneGradients pointers = gradients.pointers();
  return aomgen_backward(context_, &images, &pointers);
}

std::vector<std::string> instruction_sets() {
  std::vector<std::string> names(1);
  for (const char* c = aomgen_instruction_sets(); *c; ++c) {
    if (*c == ',') names.emplace_back();
    else names.back() += *c;
  }
  return names;
}

bool all_finite(const float* values, size_t count) {
  for (size_t i = 0; i < count; ++i)
    if (!std::isfinite(values[i])) return false;
  return true;
}

}  // namespace aomgen::tests
