// Random scenes and the memory that the engine's passes read and write.
#pragma once

#include <cstdint>
#include <cstring>
#include <string>
#include <utility>
#include <vector>

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/asan_interface.h>
#endif

#include "../aomgen_splatting.h"

namespace aomgen::tests {

// Uniform numbers that are the same on every machine, bit for bit.
class Random {
 public:
  explicit Random(uint64_t seed) : state_(seed * 2654435769u + 1) {}
  uint32_t bits() {
    state_ = state_ * 6364136223846793005u + 1442695040888963407u;
    const uint64_t mixed = (state_ ^ (state_ >> 29)) * 0xbf58476d1ce4e5b9u;
    return static_cast<uint32_t>(mixed >> 32);
  }
  int below(int count) { return static_cast<int>(bits() % static_cast<uint32_t>(count)); }
  float uniform(float low, float high) { return low + (high - low) * (static_cast<float>(bits() >> 8) * (1.0f / 16777216.0f)); }
  std::vector<float> numbers(size_t count, float low, float high);

 private:
  uint64_t state_;
};

// Memory between guards that tell writes out of bounds. The address sanitizer stops at any access to
// them; it does not see masked vector stores, which are found by looking at the guards.
template <class T>
class Array {
 public:
  explicit Array(size_t size = 0) : size_(size), all_(size + 2 * kGuard) {
    std::memset(all_.data(), kFill, all_.size() * sizeof(T));
    forbid_guards(true);
  }
  Array(const Array& other) : Array(other.size_) { std::memcpy(data(), other.data(), size_ * sizeof(T)); }
  Array& operator=(Array other) {
    std::swap(size_, other.size_);
    all_.swap(other.all_);
    return *this;
  }
  ~Array() { forbid_guards(false); }
  T* data() { return all_.data() + kGuard; }
  const T* data() const { return all_.data() + kGuard; }
  size_t size() const { return size_; }
  T operator[](size_t i) const { return data()[i]; }
  bool guards_are_whole() const {
    forbid_guards(false);
    const auto* bytes = reinterpret_cast<const unsigned char*>(all_.data());
    bool whole = true;
    for (size_t i = 0; i < kGuard * sizeof(T); ++i) whole &= bytes[i] == kFill && bytes[(kGuard + size_) * sizeof(T) + i] == kFill;
    forbid_guards(true);
    return whole;
  }
  bool operator==(const Array& other) const { return size_ == other.size_ && std::memcmp(data(), other.data(), size_ * sizeof(T)) == 0; }

 private:
  static constexpr size_t kGuard = 64;
  static constexpr unsigned char kFill = 0xa5;

  void forbid_guards([[maybe_unused]] bool forbid) const {
#if defined(__SANITIZE_ADDRESS__)
    const auto change = forbid ? __asan_poison_memory_region : __asan_unpoison_memory_region;
    change(all_.data(), kGuard * sizeof(T));
    change(data() + size_, kGuard * sizeof(T));
#endif
  }

  size_t size_;
  std::vector<T> all_;
};

struct World {
  int64_t count = 0;
  int coefficients = 1, degree = 0, features = 0;
  int width = 0, height = 0, part_count = 1;
  float fx = 0, fy = 0, cx = 0, cy = 0, near_depth = 0.01f;
  float background[3] = {0.2f, 0.4f, 0.6f};
  bool encoded = false, antialiased = false;
  std::vector<float> means, quats, scales, opacities, sh, feature_values, cam_from_part;
  std::vector<int32_t> parts;  // empty: all Gaussians in part 0

  AomgenScene scene() const;
  AomgenView view() const;
};

struct Shape {
  int64_t count = 60;
  int degree = 1, features = 0, width = 50, height = 37, parts = 1;
};

// Gaussians in a box before the camera, which looks along +z.
World random_world(uint64_t seed, const Shape& shape);

struct Canvas {
  explicit Canvas(const World& world, bool interleaved = false);
  AomgenImages images();
  bool guards_are_whole() const;
  bool operator==(const Canvas& other) const;

  bool interleaved;
  Array<float> rgb, depth, alpha, median_depth, features;
  Array<int32_t> max_id;
};

// The loss's gradient by the images: random numbers of a seed, unless set otherwise.
struct Pull {
  Pull(const World& world, uint64_t seed);
  std::vector<float> rgb, depth, alpha, features;
};

struct Gradients {
  explicit Gradients(const World& world);
  AomgenSceneGradients pointers();
  bool guards_are_whole() const;
  bool operator==(const Gradients& other) const;
  bool are_finite() const;

  Array<float> means, quats, scales, opacities, sh, features, cam_from_part;
  int32_t* rows = nullptr;  // set to get packed gradients
};

// A context with its settings.
class Engine {
 public:
  explicit Engine(const char* instruction_set = nullptr, int threads = 1);
  ~Engine() { aomgen_context_free(context_); }
  Engine(const Engine&) = delete;
  Engine& operator=(const Engine&) = delete;
  AomgenContext* context() const { return context_; }
  int32_t draw(const World& world, Canvas& canvas);
  int32_t go_back(const World& world, const Canvas& canvas, const Pull& pull, Gradients& gradients);

 private:
  AomgenContext* context_;
};

std::vector<std::string> instruction_sets();
bool all_finite(const float* values, size_t count);

}  // namespace aomgen::tests
