// The optimizer's step over one block of values.
#include "declarations.h"

namespace aomgen::AOMGEN_ISA {

// Source: Kingma & Ba, "Adam: a method for stochastic optimization", 2015.
void adam(const AdamStep& a, int block) {
  const int64_t first = static_cast<int64_t>(block) * a.block_size;
  const int64_t last = first + a.block_size < a.count ? first + a.block_size : a.count;
  const F mean_decay = all(a.mean_decay), mean_share = all(a.mean_share);
  const F square_decay = all(a.square_decay), square_share = all(a.square_share);
  int phase = 0;  // blocks start at multiples of the period
  for (int64_t i = first; i < last; i += kLanes) {
    const int lanes = last - i < kLanes ? static_cast<int>(last - i) : kLanes;
    F gradient = load_first(a.gradients + i, lanes);
    F mean = load_first(a.means + i, lanes), square = load_first(a.squares + i, lanes);
    mean = fma(mean_decay, mean, mean_share * gradient);
    square = fma(square_decay, square, square_share * gradient * gradient);
    F step = load(a.rates + phase) * mean * all(a.mean_correction) /
             (square_root(square * all(a.square_correction)) + all(a.epsilon));
    store_first(a.values + i, load_first(a.values + i, lanes) - step, lanes);
    store_first(a.means + i, mean, lanes);
    store_first(a.squares + i, square, lanes);
    phase = phase + kLanes == a.period ? 0 : phase + kLanes;
  }
}

}  // namespace aomgen::AOMGEN_ISA
