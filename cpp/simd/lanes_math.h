// Functions of lanes that are built from the basic operations.
#pragma once

namespace aomgen::AOMGEN_ISA {

AOMGEN_INLINE F clamp(F x, F low, F high) { return minimum(maximum(x, low), high); }
AOMGEN_INLINE F absolute(F x) { return maximum(x, -x); }

// 1 / x to about 3e-7.
AOMGEN_INLINE F reciprocal(F x) {
#if defined(AOMGEN_LANES_AVX512) || defined(AOMGEN_LANES_AVX2)
  F r = rough_reciprocal(x);
  return r * fnma(x, r, all(2.0f));
#else
  return 1.0f / x;
#endif
}

// 2^x for x in [-126, 127], anything elsewhere; relative error 2e-7 (minimax polynomial on [-0.5, 0.5]).
AOMGEN_INLINE F exp2_inside(F x) {
#if defined(AOMGEN_LANES_AVX512)
  F whole = _mm512_roundscale_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#else
  // Adding 1.5 * 2^23 leaves no bits for the fraction, and the whole number in the lowest bits.
  F shifted = x + 12582912.0f;
  F whole = shifted - 12582912.0f;
#endif
  F f = x - whole;
  F p = all(1.33336498e-3f);
  p = fma(p, f, all(9.61013257e-3f));
  p = fma(p, f, all(5.55055532e-2f));
  p = fma(p, f, all(2.40226444e-1f));
  p = fma(p, f, all(6.93147182e-1f));
  p = fma(p, f, all(1.0f));
#if defined(AOMGEN_LANES_AVX512)
  return _mm512_scalef_ps(p, whole);
#else
  return (F)((I)p + ((I)shifted << 23));
#endif
}

// 2^x, with x limited to [-126, 127]; NaN stays NaN, whatever its lowest bits.
AOMGEN_INLINE F exp2(F x) { return where(same(x, x), exp2_inside(clamp(x, all(-126.0f), all(127.0f))), x); }

// log2(x) for normal x > 0, by the series of atanh around 1.
AOMGEN_INLINE F log2(F x) {
  I number = (I)x;
  I power = (number - 0x3f3504f3) >> 23;  // mantissa in [0.7, 1.42)
  F mantissa = (F)(number - (power << 23)), exponent = __builtin_convertvector(power, F);
  F t = (mantissa - 1.0f) / (mantissa + 1.0f);
  F t2 = t * t;
  F series = fma(t2, fma(t2, fma(t2, all(0.412198583f), all(0.577078016f)), all(0.961796694f)), all(2.88539008f));
  return fma(t, series, exponent);
}

}  // namespace aomgen::AOMGEN_ISA
