// Stable sort of depth keys.
#pragma once

#include <cstdint>

namespace aomgen {

struct SortArrays {  // of `count` entries each
  uint32_t *keys, *values, *spare_keys, *spare_values;
};

// Sorts keys and their values ascending, equal keys in their old order. All four arrays are
// overwritten; returns the one that holds the sorted values.
uint32_t* sort_by_key(const SortArrays& arrays, uint32_t count);

}  // namespace aomgen
