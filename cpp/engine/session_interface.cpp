// The C interface of sessions.
#include "checks.h"

using namespace aomgen;

namespace {

void check(const AomgenFrame& frame, const AomgenScene& moving, int part_count, int64_t colored_count) {
  require(frame.session, "a frame's session is null");
  check_poses(frame.cam_from_part, part_count);
  require(colored_count == 0 || frame.colors, "a frame's colors are null");
  require(frame.tiles, "a frame's tiles are null");
  require(frame.rgb8 || frame.rgb || frame.depth || frame.alpha || frame.max_id, "a frame has no image");
  require(!frame.median_depth == !frame.max_id, "median_depth and max_id come together");
  require(frame.session->session.gaussian_count() + moving.count <= kMaxGaussians, "the number of all Gaussians must be 0 to 16777216");
}

}  // namespace

extern "C" {

int32_t aomgen_session_open(AomgenContext* context, const AomgenScene* scene, const AomgenView* view, AomgenSession** session) {
  return guarded([&] {
    require(context && session, "an argument is null");
    check(scene);
    check(view);
    check_parts(*scene, view->part_count);
    *session = new AomgenSession(context->context, *scene, *view);
  });
}

void aomgen_session_free(AomgenSession* session) { delete session; }

int32_t aomgen_session_draw(AomgenContext* context, const AomgenScene* moving, int32_t part_count, int64_t colored_count,
                            int32_t frame_count, const AomgenFrame* frames) {
  return guarded([&] {
    require(context, "context is null");
    check(moving);
    require(part_count >= 1 && part_count <= kMaxParts, "the number of parts must be 1 to 4096");
    check_parts(*moving, part_count);
    require(colored_count >= 0 && colored_count <= moving->count, "more colors than Gaussians");
    require(frame_count >= 0 && (frame_count == 0 || frames), "the frames are null");
    for (int i = 0; i < frame_count; ++i) check(frames[i], *moving, part_count, colored_count);
    context->drawer.draw({*moving, part_count, colored_count}, frames, frame_count, context->context.threads());
  });
}

}  // extern "C"
