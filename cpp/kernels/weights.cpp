// Which Gaussians carry which mask: sums of blended weight times mask value over one tile.
#include "tile.h"

namespace aomgen::AOMGEN_ISA {

void sum_weights(const Weights& w, int tile) {
  const int left = tile % w.tiles.columns * kTile, top = tile / w.tiles.columns * kTile;
  const size_t plane = static_cast<size_t>(w.view.width) * w.view.height;
  alignas(64) float masks[16][16][16], transmittance[16][16];
  for (int m = 0; m < w.mask_count; ++m) load_tile(w.masks + m * plane, left, top, w.view, masks[m]);
  for (int block = 0; block < 16; ++block) store(transmittance[block], all(1.0f));
  uint32_t alive = blocks_on_image(left, top, w.view);
  for (uint32_t k = w.tiles.begin[tile]; k < w.tiles.begin[tile + 1]; ++k) {
    const Splat& s = w.splats[w.tiles.splats[k]];
    const float x = s.x - left, y = s.y - top;
    uint32_t touched = alive ? touched_blocks(s, x, y) & alive : 0;
    F sums[16];
    for (int m = 0; m < 16; ++m) sums[m] = zeros();
    for (; touched; touched &= touched - 1) {
      const int block = __builtin_ctz(touched);
      F dx = load(kTileGeometry.x[block]) - all(x), dy = load(kTileGeometry.y[block]) - all(y);
      F e = log2_alpha(dx, dy, all(s.qxx), all(s.qxy), all(s.qyy), all(s.log2_opacity));
      F before = load(transmittance[block]);
      M drawn = (e > all(kMinLog2Alpha)) & (before > all(kMinTransmittance));
      F alpha = where(drawn, lesser(exp2(e), all(kMaxAlpha)));
      F weight = alpha * before, after = fnma(alpha, before, before);
      store(transmittance[block], after);
      for (int m = 0; m < w.mask_count; ++m) sums[m] = fma(weight, load(masks[m][block]), sums[m]);
      if (!any(after > all(kMinTransmittance))) alive &= ~(1u << block);
    }
    store(w.sums + 16 * static_cast<size_t>(w.tiles.slots[k]), lane_sums(sums));
  }
}

}  // namespace aomgen::AOMGEN_ISA
