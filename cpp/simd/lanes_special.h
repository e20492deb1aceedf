// Operations for which machines have instructions that the compiler does not find by itself.
#pragma once

namespace aomgen::AOMGEN_ISA {

#if defined(AOMGEN_LANES_AVX512)

struct M { __mmask16 bits; };
AOMGEN_INLINE M above(F a, F b) { return {_mm512_cmp_ps_mask(a, b, _CMP_GT_OQ)}; }
AOMGEN_INLINE M same(F a, F b) { return {_mm512_cmp_ps_mask(a, b, _CMP_EQ_OQ)}; }
AOMGEN_INLINE M operator&(M a, M b) { return {static_cast<__mmask16>(a.bits & b.bits)}; }
AOMGEN_INLINE F where(M m, F a, F b) { return _mm512_mask_blend_ps(m.bits, b, a); }
AOMGEN_INLINE F where(M m, F a) { return _mm512_maskz_mov_ps(m.bits, a); }
AOMGEN_INLINE uint32_t bits(M m) { return m.bits; }
AOMGEN_INLINE bool any(M m) { return m.bits != 0; }
AOMGEN_INLINE F fma(F a, F b, F c) { return _mm512_fmadd_ps(a, b, c); }
AOMGEN_INLINE F fnma(F a, F b, F c) { return _mm512_fnmadd_ps(a, b, c); }
AOMGEN_INLINE F minimum(F a, F b) { return _mm512_min_ps(a, b); }
AOMGEN_INLINE F maximum(F a, F b) { return _mm512_max_ps(a, b); }
AOMGEN_INLINE F square_root(F a) { return _mm512_sqrt_ps(a); }
AOMGEN_INLINE F rough_reciprocal(F a) { return _mm512_rcp14_ps(a); }
AOMGEN_INLINE F load_first(const float* p, int count) {
  return _mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1u), p);
}
AOMGEN_INLINE void store_first(float* p, F a, int count) {
  _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << count) - 1u), a);
}

#else

#if defined(AOMGEN_LANES_AVX2)

struct M { __m256 lanes; };
AOMGEN_INLINE M above(F a, F b) { return {_mm256_cmp_ps(a, b, _CMP_GT_OQ)}; }
AOMGEN_INLINE M same(F a, F b) { return {_mm256_cmp_ps(a, b, _CMP_EQ_OQ)}; }
AOMGEN_INLINE M operator&(M a, M b) { return {_mm256_and_ps(a.lanes, b.lanes)}; }
AOMGEN_INLINE F where(M m, F a, F b) { return _mm256_blendv_ps(b, a, m.lanes); }
AOMGEN_INLINE F where(M m, F a) { return _mm256_and_ps(m.lanes, a); }
AOMGEN_INLINE uint32_t bits(M m) { return static_cast<uint32_t>(_mm256_movemask_ps(m.lanes)); }
AOMGEN_INLINE F fma(F a, F b, F c) { return _mm256_fmadd_ps(a, b, c); }
AOMGEN_INLINE F fnma(F a, F b, F c) { return _mm256_fnmadd_ps(a, b, c); }
AOMGEN_INLINE F minimum(F a, F b) { return _mm256_min_ps(a, b); }
AOMGEN_INLINE F maximum(F a, F b) { return _mm256_max_ps(a, b); }
AOMGEN_INLINE F square_root(F a) { return _mm256_sqrt_ps(a); }
AOMGEN_INLINE F rough_reciprocal(F a) { return _mm256_rcp_ps(a); }

#else

struct M { I lanes; };  // -1 where true
AOMGEN_INLINE M above(F a, F b) { return {a > b}; }
AOMGEN_INLINE M same(F a, F b) { return {a == b}; }
AOMGEN_INLINE M operator&(M a, M b) { return {a.lanes & b.lanes}; }
AOMGEN_INLINE F where(M m, F a, F b) { return m.lanes ? a : b; }
AOMGEN_INLINE F where(M m, F a) { return (F)((I)a & m.lanes); }
AOMGEN_INLINE uint32_t bits(M m) {
  uint32_t result = 0;
  for (int i = 0; i < kLanes; ++i) result |= static_cast<uint32_t>(m.lanes[i] & 1) << i;
  return result;
}
AOMGEN_INLINE F minimum(F a, F b) { return a < b ? a : b; }
AOMGEN_INLINE F maximum(F a, F b) { return a > b ? a : b; }
AOMGEN_INLINE F square_root(F a) {
  for (int i = 0; i < kLanes; ++i) a[i] = sqrtf(a[i]);
  return a;
}
#if defined(AOMGEN_LANES_NEON)
AOMGEN_INLINE F fma(F a, F b, F c) { return vfmaq_f32(c, a, b); }
AOMGEN_INLINE F fnma(F a, F b, F c) { return vfmsq_f32(c, a, b); }
#else
AOMGEN_INLINE F fma(F a, F b, F c) { return a * b + c; }
AOMGEN_INLINE F fnma(F a, F b, F c) { return c - a * b; }
#endif

#endif

AOMGEN_INLINE bool any(M m) { return bits(m) != 0; }
AOMGEN_INLINE F load_first(const float* p, int count) {
  F a = {};
  memcpy(&a, p, sizeof(float) * static_cast<size_t>(count));
  return a;
}
AOMGEN_INLINE void store_first(float* p, F a, int count) { memcpy(p, &a, sizeof(float) * static_cast<size_t>(count)); }

#endif

}  // namespace aomgen::AOMGEN_ISA
