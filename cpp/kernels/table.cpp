// The table of kernels of the instruction set this file is compiled for.
#include "declarations.h"

#define AOMGEN_TEXT_(x) #x
#define AOMGEN_TEXT(x) AOMGEN_TEXT_(x)
#define AOMGEN_TABLE_(isa) kernels_##isa
#define AOMGEN_TABLE(isa) AOMGEN_TABLE_(isa)

namespace aomgen {

const Kernels& AOMGEN_TABLE(AOMGEN_ISA)() {
  using namespace AOMGEN_ISA;
  static const Kernels table = {AOMGEN_TEXT(AOMGEN_ISA), project, blend, blend_backward, project_backward,
                                sum_weights, count_pairs, find_tiles, blend_session, show_still, ssim_row, loss_gradient_row, adam, multiply_adds};
  return table;
}

}  // namespace aomgen
