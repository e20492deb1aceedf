// Sums over one tile that need only the weights of its splats: which Gaussians carry which mask, and
// how much work the tile is.
#include "tile.h"

namespace aomgen::AOMGEN_ISA {

namespace {

// Walks the tile's splats near to far and calls visit(entry, block, part, weight, drawn) for every
// register of pixels that a splat may touch, and done(entry) after each splat.
template <class Visit, class Done>
AOMGEN_INLINE void walk(const AomgenView& view, const TileLists& tiles, const Splat* splats, int tile, Visit visit, Done done) {
  const int left = tile % tiles.columns * kTile, top = tile / tiles.columns * kTile;
  alignas(64) float transmittance[256];
  for (int i = 0; i < 256; i += kLanes) store(transmittance + i, all(1.0f));
  uint32_t alive = blocks_on_image(left, top, view);
  for (uint32_t k = tiles.begin[tile]; k < tiles.begin[tile + 1]; ++k) {
    Splat s = splats[tiles.slots[k]];
    s.x -= left;
    s.y -= top;
    for (uint32_t rest = alive ? touched_blocks(s, s.x, s.y) & alive : 0; rest; rest &= rest - 1) {
      const int block = __builtin_ctz(rest);
      bool light = false;
      for (int part = 0; part < kParts; ++part) {
        const int at = 16 * block + part * kLanes;
        const F before = load(transmittance + at);
        const Touch t = touch(s, load(kTileGeometry.x[block] + part * kLanes), load(kTileGeometry.y[block] + part * kLanes), before);
        const F after = fnma(t.alpha, before, before);
        store(transmittance + at, after);
        visit(block, part, t.alpha * before, t.drawn);
        light |= any(above(after, all(kMinTransmittance)));
      }
      if (!light) alive &= ~(1u << block);
    }
    done(k);
  }
}

}  // namespace

void sum_weights(const Weights& w, int tile) {
  const int left = tile % w.tiles.columns * kTile, top = tile / w.tiles.columns * kTile;
  const size_t plane = static_cast<size_t>(w.view.width) * w.view.height;
  alignas(64) float masks[16][16][16];
  F sums[16];
  for (int m = 0; m < w.mask_count; ++m) load_tile(w.masks + m * plane, left, top, w.view, masks[m]);
  for (F& sum : sums) sum = zeros();
  walk(
      w.view, w.tiles, w.splats, tile,
      [&](int block, int part, F weight, M) {
        for (int m = 0; m < w.mask_count; ++m) sums[m] = fma(weight, load(&masks[m][block][part * kLanes]), sums[m]);
      },
      [&](uint32_t entry) {
        lane_sums(sums, w.sums + 16 * static_cast<size_t>(entry));
        for (F& sum : sums) sum = zeros();
      });
}

void count_pairs(const PairCount& c, int tile) {
  int64_t evaluated = 0, blended = 0;
  walk(
      c.view, c.tiles, c.splats, tile,
      [&](int, int, F, M drawn) {
        evaluated += kLanes;
        blended += __builtin_popcount(bits(drawn));
      },
      [](uint32_t) {});
  c.evaluated[tile] = evaluated;
  c.blended[tile] = blended;
}

}  // namespace aomgen::AOMGEN_ISA
