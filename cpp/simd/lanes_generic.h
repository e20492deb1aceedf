// Sixteen lanes as compiler vectors: correct on every machine that GCC or Clang know.
#pragma once

namespace aomgen::AOMGEN_ISA {

typedef float Floats __attribute__((vector_size(64)));
typedef int32_t Ints __attribute__((vector_size(64)));

struct F { Floats v; };
struct M { Ints v; };  // -1 where true

AOMGEN_INLINE F load_first(const float* p, int count) {
  F a = {};
  memcpy(&a.v, p, sizeof(float) * static_cast<size_t>(count));
  return a;
}
AOMGEN_INLINE F load(const float* p) {
  F a;
  memcpy(&a.v, p, sizeof(a.v));
  return a;
}
AOMGEN_INLINE void store(float* p, F a) { memcpy(p, &a.v, sizeof(a.v)); }
AOMGEN_INLINE void store_first(float* p, F a, int count) { memcpy(p, &a.v, sizeof(float) * static_cast<size_t>(count)); }
AOMGEN_INLINE F zeros() { return {Floats{}}; }
AOMGEN_INLINE F all(float x) { return {Floats{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}}; }

AOMGEN_INLINE F operator+(F a, F b) { return {a.v + b.v}; }
AOMGEN_INLINE F operator-(F a, F b) { return {a.v - b.v}; }
AOMGEN_INLINE F operator*(F a, F b) { return {a.v * b.v}; }
AOMGEN_INLINE F operator/(F a, F b) { return {a.v / b.v}; }
AOMGEN_INLINE F fma(F a, F b, F c) { return {a.v * b.v + c.v}; }
AOMGEN_INLINE F fnma(F a, F b, F c) { return {c.v - a.v * b.v}; }
AOMGEN_INLINE F lesser(F a, F b) { return {a.v < b.v ? a.v : b.v}; }
AOMGEN_INLINE F greater(F a, F b) { return {a.v > b.v ? a.v : b.v}; }
AOMGEN_INLINE F square_root(F a) {
  for (int i = 0; i < 16; ++i) a.v[i] = sqrtf(a.v[i]);
  return a;
}

AOMGEN_INLINE M operator>(F a, F b) { return {a.v > b.v}; }
AOMGEN_INLINE M operator==(F a, F b) { return {a.v == b.v}; }
AOMGEN_INLINE M operator&(M a, M b) { return {a.v & b.v}; }
AOMGEN_INLINE F where(M m, F a, F b) { return {m.v ? a.v : b.v}; }
AOMGEN_INLINE F where(M m, F a) { return {(Floats)((Ints)a.v & m.v)}; }
AOMGEN_INLINE uint32_t bits(M m) {
  uint32_t result = 0;
  for (int i = 0; i < 16; ++i) result |= static_cast<uint32_t>(m.v[i] & 1) << i;
  return result;
}
AOMGEN_INLINE bool any(M m) {
  uint64_t words[8], seen = 0;
  memcpy(words, &m.v, sizeof(words));
  for (uint64_t word : words) seen |= word;
  return seen != 0;
}

AOMGEN_INLINE F reciprocal(F x) { return all(1.0f) / x; }

// x = mantissa * 2^exponent with mantissa in [0.7, 1.42), x > 0 and normal.
AOMGEN_INLINE void split_exponent(F x, F& mantissa, F& exponent) {
  Ints number = (Ints)x.v;
  Ints power = (number - 0x3f3504f3) >> 23;
  mantissa.v = (Floats)(number - (power << 23));
  exponent.v = __builtin_convertvector(power, Floats);
}

// Adding and taking away 1.5 * 2^23 leaves no bits for the fraction; |x| < 2^22.
AOMGEN_INLINE F round_nearest(F x) {
  F shifted = x + all(12582912.0f);
  return shifted - all(12582912.0f);
}
AOMGEN_INLINE F scale_by_exponent(F x, F exponent) {
  Ints shift = __builtin_convertvector(exponent.v, Ints) << 23;
  return {(Floats)((Ints)x.v + shift)};
}

// Rows become columns: lane j of row i <-> lane i of row j.
AOMGEN_INLINE void transpose(F rows[16]) {
  float table[16][16];
  for (int i = 0; i < 16; ++i) store(table[i], rows[i]);
  for (int i = 0; i < 16; ++i)
    for (int j = 0; j < 16; ++j) rows[i].v[j] = table[j][i];
}

// Lane i is the sum over the lanes of values[i]; the fixed order makes it repeatable.
template <int Count>
AOMGEN_INLINE F lane_sums(const F (&values)[Count]) {
  F sums = zeros();
  for (int i = 0; i < Count; ++i) {
    float total = 0;
    for (int lane = 0; lane < 16; ++lane) total += values[i].v[lane];
    sums.v[i] = total;
  }
  return sums;
}

// Append base + i for every set bit i of mask; returns how many. Writes up to 16 entries.
AOMGEN_INLINE int append_set_bits(int32_t* list, uint32_t mask, int32_t base) {
  int count = 0;
  for (; mask; mask &= mask - 1) list[count++] = base + __builtin_ctz(mask);
  return count;
}

}  // namespace aomgen::AOMGEN_ISA
