// What the functions of the C interface share: checks of their arguments, and no exception leaves them.
#pragma once

#include <new>
#include <stdexcept>

#include "../aomgen_splatting.h"
#include "context.h"
#include "session.h"

struct AomgenContext {
  aomgen::Context context;
  aomgen::SessionDrawer drawer;
};

namespace aomgen {

constexpr int64_t kMaxGaussians = 1 << 24;  // indices are kept as exact floats in one place
constexpr int kMaxSide = 16384, kMaxFeatures = 4096, kMaxThreads = 256, kMaxParts = 4096;

// Reason of the last failure on this thread; needs no memory, which may be what is missing.
const char* last_error();
void set_last_error(const char* reason);

// Throws std::invalid_argument with the problem unless the condition holds.
void require(bool condition, const char* problem);

void check(const AomgenScene* scene);
void check(const AomgenView* view);
void check_poses(const float* cam_from_part, int part_count);
void check_parts(const AomgenScene& scene, int part_count);

template <class Function>
int32_t guarded(Function&& function) {
  try {
    function();
    return AOMGEN_OK;
  } catch (const std::bad_alloc&) {
    set_last_error("not enough memory");
    return AOMGEN_OUT_OF_MEMORY;
  } catch (const std::exception& error) {
    set_last_error(error.what());
    return AOMGEN_INVALID_ARGUMENT;
  }
}

}  // namespace aomgen
