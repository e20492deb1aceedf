// As many floats as one register of the machine holds: 16 (AVX-512), 8 (AVX2) or 4 (SSE, NEON, any
// other machine that GCC or Clang know).
//
// F (floats) and I (integers) are vectors of the compiler, so + - * / work on them and on scalars.
// What the compiler does not offer, or offers slowly, follows as functions: written once from
// vectors, and once more with an instruction where a machine has one. M holds truth values.
//
// Kernels use only this folder and no C++ standard library templates: their inline functions would
// be emitted once per instruction set under one name, and the linker could keep one that this
// machine cannot run.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#ifndef AOMGEN_ISA
#error "AOMGEN_ISA names the namespace of this instruction set"
#endif

#define AOMGEN_INLINE static inline __attribute__((always_inline))

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__) && defined(__AVX512BW__)
#define AOMGEN_LANES_AVX512
#elif defined(__AVX2__) && defined(__FMA__)
#define AOMGEN_LANES_AVX2
#elif defined(__ARM_NEON) && defined(__aarch64__)
#define AOMGEN_LANES_NEON
#endif

#if defined(AOMGEN_LANES_AVX512) || defined(AOMGEN_LANES_AVX2)
#include <immintrin.h>
#elif defined(AOMGEN_LANES_NEON)
#include <arm_neon.h>
#endif

namespace aomgen::AOMGEN_ISA {

#if defined(AOMGEN_LANES_AVX512)
constexpr int kLanes = 16;
#elif defined(AOMGEN_LANES_AVX2)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif
constexpr int kParts = 16 / kLanes;  // registers for sixteen floats

typedef float F __attribute__((vector_size(4 * kLanes)));
typedef int32_t I __attribute__((vector_size(4 * kLanes)));

AOMGEN_INLINE F load(const float* p) {
  F a;
  memcpy(&a, p, sizeof(a));
  return a;
}
AOMGEN_INLINE void store(float* p, F a) { memcpy(p, &a, sizeof(a)); }
AOMGEN_INLINE F zeros() { return F{}; }
AOMGEN_INLINE F all(float x) { return x - F{}; }

}  // namespace aomgen::AOMGEN_ISA

#include "lanes_special.h"
#include "lanes_shuffle.h"
#include "lanes_math.h"
