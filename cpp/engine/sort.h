// Stable sort of depth keys.
#pragma once

#include <cstdint>

namespace aomgen {

// Sorts `count` keys and their values ascending, equal keys in their old order. Four arrays of `count`
// entries; the result is in keys and values, the other two are scratch.
void sort_by_key(uint32_t* keys, uint32_t* values, uint32_t* keys_scratch, uint32_t* values_scratch, uint32_t count);

}  // namespace aomgen
