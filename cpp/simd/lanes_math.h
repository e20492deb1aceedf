// Functions of sixteen lanes that are built from the basic operations.
#pragma once

namespace aomgen::AOMGEN_ISA {

AOMGEN_INLINE F operator-(F a) { return zeros() - a; }
AOMGEN_INLINE F operator*(float a, F b) { return all(a) * b; }
AOMGEN_INLINE F clamp(F x, F low, F high) { return lesser(greater(x, low), high); }
AOMGEN_INLINE F absolute(F x) { return greater(x, -x); }

// 2^x for x in [-126, 126]; relative error 2e-7 (minimax polynomial on [-0.5, 0.5]).
AOMGEN_INLINE F exp2(F x) {
  x = greater(x, all(-126.0f));
  F whole = round_nearest(x);
  F f = x - whole;
  F p = all(1.33336498e-3f);
  p = fma(p, f, all(9.61013257e-3f));
  p = fma(p, f, all(5.55055532e-2f));
  p = fma(p, f, all(2.40226444e-1f));
  p = fma(p, f, all(6.93147182e-1f));
  p = fma(p, f, all(1.0f));
  return scale_by_exponent(p, whole);
}

// log2(x) for normal x > 0, by the series of atanh around 1.
AOMGEN_INLINE F log2(F x) {
  F mantissa, exponent;
  split_exponent(x, mantissa, exponent);
  F t = (mantissa - all(1.0f)) / (mantissa + all(1.0f));
  F t2 = t * t;
  F series = fma(t2, fma(t2, fma(t2, all(0.412198583f), all(0.577078016f)), all(0.961796694f)), all(2.88539008f));
  return fma(t, series, exponent);
}

}  // namespace aomgen::AOMGEN_ISA
