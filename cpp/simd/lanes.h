// Sixteen floats at a time. One of three implementations, chosen by the compiler's target:
// AVX-512 (one register), AVX2 (two registers) or compiler vectors (any machine, also ARM).
//
// Types: F (16 floats), M (16 truth values). Kernels use only what this folder offers and no
// C++ standard library templates: their inline functions would be emitted once per
// instruction set under one name, and the linker could keep one that this machine cannot run.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#ifndef AOMGEN_ISA
#error "AOMGEN_ISA names the namespace of this instruction set"
#endif

#define AOMGEN_INLINE static inline __attribute__((always_inline))

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__) && defined(__AVX512BW__)
#include "lanes_avx512.h"
#elif defined(__AVX2__) && defined(__FMA__)
#include "lanes_avx2.h"
#else
#include "lanes_generic.h"
#endif
#include "lanes_math.h"
