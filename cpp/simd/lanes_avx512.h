// Sixteen lanes in one AVX-512 register.
#pragma once

#include <immintrin.h>

namespace aomgen::AOMGEN_ISA {

struct F { __m512 v; };
struct M { __mmask16 v; };

AOMGEN_INLINE F load(const float* p) { return {_mm512_loadu_ps(p)}; }
AOMGEN_INLINE void store(float* p, F a) { _mm512_storeu_ps(p, a.v); }
AOMGEN_INLINE __mmask16 first_lanes(int count) { return static_cast<__mmask16>((1u << count) - 1u); }
AOMGEN_INLINE F load_first(const float* p, int count) { return {_mm512_maskz_loadu_ps(first_lanes(count), p)}; }
AOMGEN_INLINE void store_first(float* p, F a, int count) { _mm512_mask_storeu_ps(p, first_lanes(count), a.v); }
AOMGEN_INLINE F all(float x) { return {_mm512_set1_ps(x)}; }
AOMGEN_INLINE F zeros() { return {_mm512_setzero_ps()}; }

AOMGEN_INLINE F operator+(F a, F b) { return {_mm512_add_ps(a.v, b.v)}; }
AOMGEN_INLINE F operator-(F a, F b) { return {_mm512_sub_ps(a.v, b.v)}; }
AOMGEN_INLINE F operator*(F a, F b) { return {_mm512_mul_ps(a.v, b.v)}; }
AOMGEN_INLINE F operator/(F a, F b) { return {_mm512_div_ps(a.v, b.v)}; }
AOMGEN_INLINE F fma(F a, F b, F c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
AOMGEN_INLINE F fnma(F a, F b, F c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }  // c - a b
AOMGEN_INLINE F lesser(F a, F b) { return {_mm512_min_ps(a.v, b.v)}; }             // b where a is NaN
AOMGEN_INLINE F greater(F a, F b) { return {_mm512_max_ps(a.v, b.v)}; }            // b where a is NaN
AOMGEN_INLINE F square_root(F a) { return {_mm512_sqrt_ps(a.v)}; }

AOMGEN_INLINE M operator>(F a, F b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
AOMGEN_INLINE M operator==(F a, F b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_EQ_OQ)}; }
AOMGEN_INLINE M operator&(M a, M b) { return {static_cast<__mmask16>(a.v & b.v)}; }
AOMGEN_INLINE F where(M m, F a, F b) { return {_mm512_mask_blend_ps(m.v, b.v, a.v)}; }
AOMGEN_INLINE F where(M m, F a) { return {_mm512_maskz_mov_ps(m.v, a.v)}; }
AOMGEN_INLINE uint32_t bits(M m) { return m.v; }
AOMGEN_INLINE bool any(M m) { return m.v != 0; }

// 1 / x to about 1e-7 by one Newton step.
AOMGEN_INLINE F reciprocal(F x) {
  F r = {_mm512_rcp14_ps(x.v)};
  return r * fnma(x, r, all(2.0f));
}

// x = mantissa * 2^exponent with mantissa in [0.75, 1.5), x > 0.
AOMGEN_INLINE void split_exponent(F x, F& mantissa, F& exponent) {
  mantissa = {_mm512_getmant_ps(x.v, _MM_MANT_NORM_p75_1p5, _MM_MANT_SIGN_src)};
  exponent = {_mm512_getexp_ps(_mm512_div_ps(x.v, mantissa.v))};
}

AOMGEN_INLINE F round_nearest(F x) { return {_mm512_roundscale_ps(x.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)}; }
AOMGEN_INLINE F scale_by_exponent(F x, F exponent) { return {_mm512_scalef_ps(x.v, exponent.v)}; }

AOMGEN_INLINE void transpose_quads(F& a, F& b, F& c, F& d) {  // 4x4 inside every 128-bit part
  __m512 ab_lo = _mm512_unpacklo_ps(a.v, b.v), ab_hi = _mm512_unpackhi_ps(a.v, b.v);
  __m512 cd_lo = _mm512_unpacklo_ps(c.v, d.v), cd_hi = _mm512_unpackhi_ps(c.v, d.v);
  a.v = _mm512_shuffle_ps(ab_lo, cd_lo, 0x44);
  b.v = _mm512_shuffle_ps(ab_lo, cd_lo, 0xEE);
  c.v = _mm512_shuffle_ps(ab_hi, cd_hi, 0x44);
  d.v = _mm512_shuffle_ps(ab_hi, cd_hi, 0xEE);
}

AOMGEN_INLINE void transpose_parts(F& a, F& b, F& c, F& d) {  // 4x4 of whole 128-bit parts
  __m512 ab_lo = _mm512_shuffle_f32x4(a.v, b.v, 0x44), ab_hi = _mm512_shuffle_f32x4(a.v, b.v, 0xEE);
  __m512 cd_lo = _mm512_shuffle_f32x4(c.v, d.v, 0x44), cd_hi = _mm512_shuffle_f32x4(c.v, d.v, 0xEE);
  a.v = _mm512_shuffle_f32x4(ab_lo, cd_lo, 0x88);
  b.v = _mm512_shuffle_f32x4(ab_lo, cd_lo, 0xDD);
  c.v = _mm512_shuffle_f32x4(ab_hi, cd_hi, 0x88);
  d.v = _mm512_shuffle_f32x4(ab_hi, cd_hi, 0xDD);
}

// Rows become columns: lane j of row i <-> lane i of row j.
AOMGEN_INLINE void transpose(F rows[16]) {
  for (int i = 0; i < 16; i += 4) transpose_quads(rows[i], rows[i + 1], rows[i + 2], rows[i + 3]);
  for (int i = 0; i < 4; ++i) transpose_parts(rows[i], rows[i + 4], rows[i + 8], rows[i + 12]);
}

AOMGEN_INLINE F halves_added(F a, F b) {  // 256-bit halves: a summed, b summed
  return {_mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x44), _mm512_shuffle_f32x4(a.v, b.v, 0xEE))};
}
AOMGEN_INLINE F quarters_added(F a, F b) {  // 128-bit parts: first and second of a, then of b
  return {_mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x88), _mm512_shuffle_f32x4(a.v, b.v, 0xDD))};
}

// Lane i is the sum over the lanes of values[i]; the fixed order makes it repeatable.
template <int Count>
AOMGEN_INLINE F lane_sums(const F (&values)[Count]) {
  F quads[4];
  for (int q = 0; q < 4; ++q) {
    auto value = [&](int k) { return 4 * q + k < Count ? values[4 * q + k < Count ? 4 * q + k : 0] : zeros(); };
    quads[q] = 4 * q < Count ? quarters_added(halves_added(value(0), value(1)), halves_added(value(2), value(3))) : zeros();
  }
  __m512 t0 = _mm512_add_ps(_mm512_unpacklo_ps(quads[0].v, quads[1].v), _mm512_unpackhi_ps(quads[0].v, quads[1].v));
  __m512 t1 = _mm512_add_ps(_mm512_unpacklo_ps(quads[2].v, quads[3].v), _mm512_unpackhi_ps(quads[2].v, quads[3].v));
  __m512 sums = _mm512_add_ps(_mm512_shuffle_ps(t0, t1, 0x44), _mm512_shuffle_ps(t0, t1, 0xEE));
  const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  return {_mm512_permutexvar_ps(order, sums)};
}

// Append base + i for every set bit i of mask; returns how many. Writes up to 16 entries.
AOMGEN_INLINE int append_set_bits(int32_t* list, uint32_t mask, int32_t base) {
  const __m512i lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  const __m512i numbers = _mm512_add_epi32(_mm512_set1_epi32(base), lanes);
  _mm512_storeu_si512(list, _mm512_maskz_compress_epi32(static_cast<__mmask16>(mask), numbers));
  return __builtin_popcount(mask);
}

}  // namespace aomgen::AOMGEN_ISA
