// Which instruction set's kernels run.
#pragma once

#include "../kernels/kernels.h"

namespace aomgen {

// Kernels by name, or the best for this machine when name is null; null when the name is unknown or
// the machine cannot run it.
const Kernels* find_kernels(const char* name);

// Names of all usable instruction sets, comma separated, best first.
const char* usable_instruction_sets();

}  // namespace aomgen
