// How fast this machine multiplies and adds: the yardstick of the blending speed.
#include "declarations.h"

namespace aomgen::AOMGEN_ISA {

double multiply_adds(int64_t rounds) {
  constexpr int kChains = 12;  // enough to hide the latency of one multiply-add
  F sums[kChains];
  for (int i = 0; i < kChains; ++i) sums[i] = all(1.0f + 0.01f * i);
  const F factor = all(0.9999f), offset = all(1e-4f);
  for (int64_t round = 0; round < rounds; ++round)
    for (int i = 0; i < kChains; ++i) sums[i] = fma(sums[i], factor, offset);
  F total = zeros();
  for (int i = 0; i < kChains; ++i) total = total + sums[i];
  // A comparison that is never true keeps the sums from being optimised away.
  return any(above(total, all(1e30f))) ? 0.0 : static_cast<double>(rounds) * kChains * kLanes;
}

}  // namespace aomgen::AOMGEN_ISA
