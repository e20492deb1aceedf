// Sixteen lanes in two AVX2 registers.
#pragma once

#include <immintrin.h>

namespace aomgen::AOMGEN_ISA {

struct F { __m256 lo, hi; };
struct M { __m256 lo, hi; };

AOMGEN_INLINE F load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
AOMGEN_INLINE void store(float* p, F a) {
  _mm256_storeu_ps(p, a.lo);
  _mm256_storeu_ps(p + 8, a.hi);
}
AOMGEN_INLINE F load_first(const float* p, int count) {
  float padded[16] = {};
  memcpy(padded, p, sizeof(float) * static_cast<size_t>(count));
  return load(padded);
}
AOMGEN_INLINE void store_first(float* p, F a, int count) {
  float padded[16];
  store(padded, a);
  memcpy(p, padded, sizeof(float) * static_cast<size_t>(count));
}
AOMGEN_INLINE F all(float x) { return {_mm256_set1_ps(x), _mm256_set1_ps(x)}; }
AOMGEN_INLINE F zeros() { return {_mm256_setzero_ps(), _mm256_setzero_ps()}; }

AOMGEN_INLINE F operator+(F a, F b) { return {_mm256_add_ps(a.lo, b.lo), _mm256_add_ps(a.hi, b.hi)}; }
AOMGEN_INLINE F operator-(F a, F b) { return {_mm256_sub_ps(a.lo, b.lo), _mm256_sub_ps(a.hi, b.hi)}; }
AOMGEN_INLINE F operator*(F a, F b) { return {_mm256_mul_ps(a.lo, b.lo), _mm256_mul_ps(a.hi, b.hi)}; }
AOMGEN_INLINE F operator/(F a, F b) { return {_mm256_div_ps(a.lo, b.lo), _mm256_div_ps(a.hi, b.hi)}; }
AOMGEN_INLINE F fma(F a, F b, F c) { return {_mm256_fmadd_ps(a.lo, b.lo, c.lo), _mm256_fmadd_ps(a.hi, b.hi, c.hi)}; }
AOMGEN_INLINE F fnma(F a, F b, F c) { return {_mm256_fnmadd_ps(a.lo, b.lo, c.lo), _mm256_fnmadd_ps(a.hi, b.hi, c.hi)}; }
AOMGEN_INLINE F lesser(F a, F b) { return {_mm256_min_ps(a.lo, b.lo), _mm256_min_ps(a.hi, b.hi)}; }
AOMGEN_INLINE F greater(F a, F b) { return {_mm256_max_ps(a.lo, b.lo), _mm256_max_ps(a.hi, b.hi)}; }
AOMGEN_INLINE F square_root(F a) { return {_mm256_sqrt_ps(a.lo), _mm256_sqrt_ps(a.hi)}; }

AOMGEN_INLINE M operator>(F a, F b) {
  return {_mm256_cmp_ps(a.lo, b.lo, _CMP_GT_OQ), _mm256_cmp_ps(a.hi, b.hi, _CMP_GT_OQ)};
}
AOMGEN_INLINE M operator==(F a, F b) {
  return {_mm256_cmp_ps(a.lo, b.lo, _CMP_EQ_OQ), _mm256_cmp_ps(a.hi, b.hi, _CMP_EQ_OQ)};
}
AOMGEN_INLINE M operator&(M a, M b) { return {_mm256_and_ps(a.lo, b.lo), _mm256_and_ps(a.hi, b.hi)}; }
AOMGEN_INLINE F where(M m, F a, F b) { return {_mm256_blendv_ps(b.lo, a.lo, m.lo), _mm256_blendv_ps(b.hi, a.hi, m.hi)}; }
AOMGEN_INLINE F where(M m, F a) { return {_mm256_and_ps(m.lo, a.lo), _mm256_and_ps(m.hi, a.hi)}; }
AOMGEN_INLINE uint32_t bits(M m) {
  return static_cast<uint32_t>(_mm256_movemask_ps(m.lo)) | static_cast<uint32_t>(_mm256_movemask_ps(m.hi)) << 8;
}
AOMGEN_INLINE bool any(M m) { return _mm256_movemask_ps(_mm256_or_ps(m.lo, m.hi)) != 0; }

// 1 / x to about 3e-7 by one Newton step.
AOMGEN_INLINE F reciprocal(F x) {
  F r = {_mm256_rcp_ps(x.lo), _mm256_rcp_ps(x.hi)};
  return r * fnma(x, r, all(2.0f));
}

// x = mantissa * 2^exponent with mantissa in [0.7, 1.42), x > 0 and normal.
AOMGEN_INLINE void split_half(__m256 x, __m256& mantissa, __m256& exponent) {
  const __m256i root_half = _mm256_set1_epi32(0x3f3504f3);
  __m256i number = _mm256_castps_si256(x);
  __m256i power = _mm256_srai_epi32(_mm256_sub_epi32(number, root_half), 23);
  mantissa = _mm256_castsi256_ps(_mm256_sub_epi32(number, _mm256_slli_epi32(power, 23)));
  exponent = _mm256_cvtepi32_ps(power);
}
AOMGEN_INLINE void split_exponent(F x, F& mantissa, F& exponent) {
  split_half(x.lo, mantissa.lo, exponent.lo);
  split_half(x.hi, mantissa.hi, exponent.hi);
}

AOMGEN_INLINE F round_nearest(F x) {
  constexpr int mode = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;
  return {_mm256_round_ps(x.lo, mode), _mm256_round_ps(x.hi, mode)};
}
AOMGEN_INLINE __m256 scale_half(__m256 x, __m256 exponent) {
  __m256i shift = _mm256_slli_epi32(_mm256_cvtps_epi32(exponent), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(x), shift));
}
AOMGEN_INLINE F scale_by_exponent(F x, F exponent) {
  return {scale_half(x.lo, exponent.lo), scale_half(x.hi, exponent.hi)};
}

AOMGEN_INLINE void transpose_block(__m256 r[8]) {
  __m256 t[8], s[8];
  for (int i = 0; i < 4; ++i) {
    t[2 * i] = _mm256_unpacklo_ps(r[2 * i], r[2 * i + 1]);
    t[2 * i + 1] = _mm256_unpackhi_ps(r[2 * i], r[2 * i + 1]);
  }
  for (int i = 0; i < 2; ++i) {
    s[4 * i] = _mm256_shuffle_ps(t[4 * i], t[4 * i + 2], 0x44);
    s[4 * i + 1] = _mm256_shuffle_ps(t[4 * i], t[4 * i + 2], 0xEE);
    s[4 * i + 2] = _mm256_shuffle_ps(t[4 * i + 1], t[4 * i + 3], 0x44);
    s[4 * i + 3] = _mm256_shuffle_ps(t[4 * i + 1], t[4 * i + 3], 0xEE);
  }
  for (int i = 0; i < 4; ++i) {
    r[i] = _mm256_permute2f128_ps(s[i], s[i + 4], 0x20);
    r[i + 4] = _mm256_permute2f128_ps(s[i], s[i + 4], 0x31);
  }
}

// Rows become columns: lane j of row i <-> lane i of row j.
AOMGEN_INLINE void transpose(F rows[16]) {
  __m256 upper_left[8], upper_right[8], lower_left[8], lower_right[8];
  for (int i = 0; i < 8; ++i) {
    upper_left[i] = rows[i].lo;
    upper_right[i] = rows[i].hi;
    lower_left[i] = rows[i + 8].lo;
    lower_right[i] = rows[i + 8].hi;
  }
  transpose_block(upper_left);
  transpose_block(upper_right);
  transpose_block(lower_left);
  transpose_block(lower_right);
  for (int i = 0; i < 8; ++i) {
    rows[i] = {upper_left[i], lower_left[i]};
    rows[i + 8] = {upper_right[i], lower_right[i]};
  }
}

AOMGEN_INLINE __m128 four_sums(__m256 a, __m256 b, __m256 c, __m256 d) {
  __m256 pairs = _mm256_hadd_ps(_mm256_hadd_ps(a, b), _mm256_hadd_ps(c, d));
  return _mm_add_ps(_mm256_castps256_ps128(pairs), _mm256_extractf128_ps(pairs, 1));
}

// Lane i is the sum over the lanes of values[i]; the fixed order makes it repeatable.
template <int Count>
AOMGEN_INLINE F lane_sums(const F (&values)[Count]) {
  __m256 folded[16];
  for (int i = 0; i < 16; ++i)
    folded[i] = i < Count ? _mm256_add_ps(values[i < Count ? i : 0].lo, values[i < Count ? i : 0].hi) : _mm256_setzero_ps();
  __m128 s[4];
  for (int q = 0; q < 4; ++q) s[q] = four_sums(folded[4 * q], folded[4 * q + 1], folded[4 * q + 2], folded[4 * q + 3]);
  return {_mm256_set_m128(s[1], s[0]), _mm256_set_m128(s[3], s[2])};
}

// Append base + i for every set bit i of mask; returns how many. Writes up to 16 entries.
AOMGEN_INLINE int append_set_bits(int32_t* list, uint32_t mask, int32_t base) {
  int count = 0;
  for (; mask; mask &= mask - 1) list[count++] = base + __builtin_ctz(mask);
  return count;
}

}  // namespace aomgen::AOMGEN_ISA
