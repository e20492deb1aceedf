// Lanes that change places: transposition, sums across lanes, triples taken apart.
#pragma once

#include <utility>

namespace aomgen::AOMGEN_ISA {

using LaneNumbers = std::make_integer_sequence<int, kLanes>;

// Lanes of a and b by turns: from their first halves, or from their second halves.
template <int... L>
AOMGEN_INLINE F interleaved_first(F a, F b, std::integer_sequence<int, L...>) {
  return __builtin_shufflevector(a, b, (L % 2 ? kLanes + L / 2 : L / 2)...);
}
template <int... L>
AOMGEN_INLINE F interleaved_second(F a, F b, std::integer_sequence<int, L...>) {
  return __builtin_shufflevector(a, b, (L % 2 ? kLanes + kLanes / 2 + L / 2 : kLanes / 2 + L / 2)...);
}

// Rows become columns: lane j of row i <-> lane i of row j. Every round of interleaving the upper half
// of the rows with the lower turns the combined index of row and lane by one bit.
AOMGEN_INLINE void transpose(F* rows) {
  for (int round = 1; round < kLanes; round *= 2) {
    F turned[kLanes];
    for (int i = 0; i < kLanes / 2; ++i) {
      turned[2 * i] = interleaved_first(rows[i], rows[i + kLanes / 2], LaneNumbers{});
      turned[2 * i + 1] = interleaved_second(rows[i], rows[i + kLanes / 2], LaneNumbers{});
    }
    for (int i = 0; i < kLanes; ++i) rows[i] = turned[i];
  }
}

// Both halves of every group of `Group` lanes added: groups of a, then groups of b, half as long.
template <int Group, int... L>
AOMGEN_INLINE F folded(F a, F b, std::integer_sequence<int, L...>) {
  return __builtin_shufflevector(a, b, (L / (Group / 2) * Group + L % (Group / 2))...) +
         __builtin_shufflevector(a, b, (L / (Group / 2) * Group + L % (Group / 2) + Group / 2)...);
}
template <int Group>
AOMGEN_INLINE void fold(F* sums, int count) {
  for (int i = 0; i < count / 2; ++i) sums[i] = folded<Group>(sums[2 * i], sums[2 * i + 1], LaneNumbers{});
}

// result[i] is the sum over the lanes of values[i], zero from Count to 15; the order of additions is fixed.
template <int Count>
AOMGEN_INLINE void lane_sums(const F (&values)[Count], float* result) {
  for (int part = 0; part < kParts; ++part) {
    F sums[kLanes];
    for (int i = 0; i < kLanes; ++i) sums[i] = part * kLanes + i < Count ? values[part * kLanes + i < Count ? part * kLanes + i : 0] : F{};
    if constexpr (kLanes >= 16) fold<16>(sums, kLanes);
    if constexpr (kLanes >= 8) fold<8>(sums, kLanes >= 16 ? kLanes / 2 : kLanes);
    fold<4>(sums, 4);
    fold<2>(sums, 2);
    store(result + part * kLanes, sums[0]);
  }
}

// Lane j of out[c] is p[3 j + c].
template <int... L>
AOMGEN_INLINE void load_triples(const float* p, F out[3], std::integer_sequence<int, L...>) {
  const F a = load(p), b = load(p + kLanes), c = load(p + 2 * kLanes);
  constexpr int k = kLanes;
  F first[3] = {__builtin_shufflevector(a, b, (3 * L < 2 * k ? 3 * L : 0)...),
                __builtin_shufflevector(a, b, (3 * L + 1 < 2 * k ? 3 * L + 1 : 0)...),
                __builtin_shufflevector(a, b, (3 * L + 2 < 2 * k ? 3 * L + 2 : 0)...)};
  out[0] = __builtin_shufflevector(first[0], c, (3 * L < 2 * k ? L : 3 * L - k)...);
  out[1] = __builtin_shufflevector(first[1], c, (3 * L + 1 < 2 * k ? L : 3 * L + 1 - k)...);
  out[2] = __builtin_shufflevector(first[2], c, (3 * L + 2 < 2 * k ? L : 3 * L + 2 - k)...);
}

// Column j of up to kLanes rows of `count` floats, `stride` apart, becomes columns[j]; zeros for
// lanes that are not wanted. Writes columns up to the next multiple of kLanes.
AOMGEN_INLINE void load_columns(const float* rows, size_t stride, int count, const int32_t index[kLanes], uint32_t wanted, F* columns) {
  for (int lane = 0; lane < kLanes; ++lane) {  // one row after the other, as they lie in memory
    const float* row = rows + stride * static_cast<size_t>(index[lane]);
    const bool is_wanted = wanted >> lane & 1;
    for (int part = 0; part < count; part += kLanes) {
      const int width = count - part < kLanes ? count - part : kLanes;
      columns[part + lane] = !is_wanted ? F{} : width == kLanes ? load(row + part) : load_first(row + part, width);
    }
  }
  for (int part = 0; part < count; part += kLanes) transpose(columns + part);
}

}  // namespace aomgen::AOMGEN_ISA
