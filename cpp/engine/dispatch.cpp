#include "dispatch.h"

#include <cstring>
#include <string>

namespace aomgen {

#if defined(AOMGEN_X86)
const Kernels& kernels_avx512();
const Kernels& kernels_avx2();
#endif
const Kernels& kernels_baseline();

namespace {

struct Choice {
  bool usable;
  const Kernels& (*kernels)();
};

template <class Visit>
void for_each_usable(Visit visit) {
#if defined(AOMGEN_X86)
  // The same names as in CMakeLists.txt, so that nothing is compiled in that is not asked for here.
  const Choice choices[] = {{__builtin_cpu_supports("x86-64-v4") != 0, kernels_avx512},
                            {__builtin_cpu_supports("x86-64-v3") != 0, kernels_avx2},
                            {true, kernels_baseline}};
#else
  const Choice choices[] = {{true, kernels_baseline}};
#endif
  for (const Choice& choice : choices)
    if (choice.usable) visit(choice.kernels());
}

}  // namespace

const Kernels* find_kernels(const char* name) {
  const Kernels* found = nullptr;
  for_each_usable([&](const Kernels& kernels) {
    if (!found && (!name || std::strcmp(name, kernels.name) == 0)) found = &kernels;
  });
  return found;
}

const char* usable_instruction_sets() {
  static const std::string names = [] {
    std::string list;
    for_each_usable([&](const Kernels& kernels) { list += (list.empty() ? "" : ",") + std::string(kernels.name); });
    return list;
  }();
  return names.c_str();
}

}  // namespace aomgen
