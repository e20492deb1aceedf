"""Sessions against full renders: the same to the last bit, whatever moves."""

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import SH_C0, Gaussians, concatenate, gaussians_of
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.errors import BackendError
from aomgen.splatting import native
from aomgen.splatting.rasterizer import Rendering, RigidParts, native_scene, render
from aomgen.splatting.session import TILE, Motion, RenderSession, draw_outputs

BACKGROUND = (0.2, 0.4, 0.6)
FIELDS = ("rgb", "alpha", "depth", "median_depth", "max_id")


def make_camera(width: int = 170, height: int = 130) -> Camera:
    """Off-centre principal point, unequal focal lengths, size that is no multiple of a tile."""
    pose = look_at([0.9, -1.2, 0.8], [0.0, 0.0, 0.1])
    return Camera(fx=175.0, fy=171.0, cx=83.0, cy=57.5, width=width, height=height, T_world_cam=pose)


def cloud(count: int, seed: int, *, degree: int = 2, spread: float = 0.5, size: float = 0.05) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return gaussians_of(
        means=rng.normal(size=(count, 3)) * [spread, spread, 0.6 * spread],
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(np.log(size), 0.7, (count, 3))),
        opacities=1 / (1 + np.exp(-rng.normal(0.5, 2.0, count))),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    )


def wall(distance: float, camera: Camera, spacing: float = 0.05) -> Gaussians:
    """An opaque plane across the view, at a depth, [m]."""
    x, y = np.meshgrid(np.arange(-1, 1, spacing), np.arange(-1, 1, spacing))
    in_cam = np.stack([x.ravel(), y.ravel(), np.full(x.size, distance)], 1)
    # Three layers: one alone lets more than the least light through.
    in_cam = np.concatenate([in_cam + [0, 0, 0.001 * layer] for layer in range(3)])
    count = len(in_cam)
    return gaussians_of(
        means=in_cam @ camera.T_world_cam[:3, :3].T + camera.T_world_cam[:3, 3],
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        scales=np.full((count, 3), 1.2 * spacing),
        opacities=np.full(count, 0.99),
        sh=np.random.default_rng(7).normal(size=(count, 1, 3)) * 0.5,
    )


def poses(seed: int, count: int = 3, shift: float = 0.2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack(
        [transform(matrix_from_rotvec(rng.normal(size=3)), rng.normal(size=3) * shift) for _ in range(count)]
    )


def parts_of(count: int, seed: int, Ts: np.ndarray) -> RigidParts:
    indices = np.random.default_rng(seed).integers(0, len(Ts), count).astype(np.int32)
    return RigidParts(indices=indices, Ts_world_part=Ts)


def full(
    static: Gaussians, moving: Gaussians, parts: RigidParts | None, camera: Camera, antialiased: bool = False
) -> Rendering:
    """All Gaussians in one render, static ones in a part of their own."""
    Ts = np.eye(4)[None] if parts is None else np.concatenate([np.eye(4)[None], parts.Ts_world_part])
    indices = np.zeros(len(moving), np.int32) if parts is None else parts.indices + 1
    together = RigidParts(indices=np.append(np.zeros(len(static), np.int32), indices), Ts_world_part=Ts)
    return render(
        concatenate([static, moving]),
        camera,
        parts=together,
        background=BACKGROUND,
        antialiased=antialiased,
        with_ids=True,
    )


def assert_same(have: Rendering, want: Rendering) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(have, name), getattr(want, name), err_msg=name)


@pytest.fixture
def instruction_set(request, monkeypatch) -> str:
    """Full renders run on this instruction set too."""
    configure = native.Context.configure
    monkeypatch.setattr(
        native.Context,
        "configure",
        lambda self, threads=None, _=None: configure(self, threads, request.param),
    )
    return request.param


@pytest.mark.parametrize("instruction_set", native.instruction_sets(), indirect=True)
@pytest.mark.parametrize("antialiased", [False, True])
def test_a_frame_is_the_full_render(instruction_set, antialiased):
    camera, static, moving = make_camera(), cloud(900, 1), cloud(300, 2, degree=1, spread=0.1, size=0.02)
    session = RenderSession(static, camera, background=BACKGROUND, antialiased=antialiased)
    parts = parts_of(300, 3, poses(4))
    have = session.draw(moving, parts, with_ids=True)
    want = full(static, moving, parts, camera, antialiased=antialiased)
    assert_same(have, want)
    assert (np.asarray(have.max_id) >= len(static)).sum() > 100
    assert (np.asarray(have.max_id) < len(static)).sum() > 100


@pytest.mark.parametrize("instruction_set", native.instruction_sets(), indirect=True)
@pytest.mark.parametrize("offset", [-0.4, 0.0, 0.4], ids=["in front", "inside", "behind"])
def test_before_inside_and_behind_an_opaque_wall(instruction_set, offset):
    camera = make_camera()
    static = wall(1.2, camera)
    ball = cloud(200, 5, degree=0, spread=0.1, size=0.03)
    middle = camera.center + (1.2 + offset) * camera.T_world_cam[:3, 2]
    parts = RigidParts(indices=np.zeros(200, np.int32), Ts_world_part=transform(np.eye(3), middle)[None])
    session = RenderSession(static, camera, background=BACKGROUND)
    have = session.draw(ball, parts, with_ids=True)
    assert_same(have, full(static, ball, parts, camera))
    assert (np.asarray(have.max_id) >= len(static)).any() == (offset <= 0)
    _, changed = session.picture(ball, parts)
    if offset > 0:
        assert not changed.any()  # what is hidden costs nothing
    else:
        assert 0 < changed.sum() < changed.size


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_threads_change_nothing(threads):
    camera, static, moving = make_camera(), cloud(900, 1), cloud(2500, 2, spread=0.1, size=0.01)
    motion = Motion(
        parts=parts_of(2500, 3, poses(0)).indices, Ts_world_part=np.stack([poses(seed) for seed in range(5)])
    )
    session = RenderSession(static, camera, background=BACKGROUND, threads=threads)
    one = RenderSession(static, camera, background=BACKGROUND, threads=1)
    frames = session.draw_many(moving, motion)
    np.testing.assert_array_equal(frames, one.draw_many(moving, motion))
    for t, Ts in enumerate(motion.Ts_world_part):
        parts = RigidParts(indices=motion.parts, Ts_world_part=Ts)
        drawn = session.draw(moving, parts, with_ids=True)
        assert_same(drawn, full(static, moving, parts, camera))
        assert np.abs(frames[t] - 255 * drawn.rgb.astype(np.float64)).max() < 0.501
        np.testing.assert_array_equal(session.picture(moving, parts)[0], frames[t])


def test_tiles_become_free_again():
    camera, static, moving = make_camera(), cloud(900, 1), cloud(60, 2, spread=0.05, size=0.01)
    session = RenderSession(static, camera, background=BACKGROUND)
    indices = np.zeros(60, np.int32)
    shade = np.ones((130, 170), np.float32)
    shade[40:60, 90:120] = 0.5
    picture, seen = None, []
    for x, dark in ((0.0, None), (0.3, shade), (0.3, None), (-0.2, shade), (9.0, None)):
        parts = RigidParts(indices=indices, Ts_world_part=transform(np.eye(3), np.array([x, 0, 0.2]))[None])
        picture = session.picture(moving, parts, shade=dark, into=picture)
        fresh = session.picture(moving, parts, shade=dark)
        for array, own in zip(picture, fresh, strict=True):
            np.testing.assert_array_equal(array, own)
        seen.append(picture[1].sum())
    assert min(seen[:4]) > 0
    assert seen[4] == 0
    alone = render(static, camera, background=BACKGROUND).rgb
    assert np.abs(picture[0] - 255 * alone.astype(np.float64)).max() < 0.501


def test_nothing_moves_and_nothing_stands():
    camera, some, none = make_camera(), cloud(200, 1), cloud(0, 1)
    assert_same(
        RenderSession(some, camera, background=BACKGROUND).draw(none, with_ids=True),
        full(some, none, None, camera),
    )
    assert_same(
        RenderSession(none, camera, background=BACKGROUND).draw(some, with_ids=True),
        full(none, some, None, camera),
    )
    nothing = RenderSession(none, camera, background=BACKGROUND).draw(none)
    np.testing.assert_array_equal(nothing.rgb, np.full((130, 170, 3), BACKGROUND, np.float32))
    motion = Motion(parts=np.zeros(0, np.int32), Ts_world_part=np.zeros((0, 1, 4, 4)))
    assert RenderSession(some, camera).draw_many(none, motion).shape == (0, 130, 170, 3)


@pytest.mark.parametrize("name", ["means", "scales", "quats", "opacities", "sh"])
def test_gaussians_that_are_not_numbers_are_left_out(name):
    camera, static, moving = make_camera(), cloud(300, 1), cloud(100, 2)
    array = np.array(getattr(moving, name))
    array[:50] = np.nan
    values = {key: getattr(moving, key) for key in ("means", "scales", "quats", "opacities", "sh")}
    broken = Gaussians(**{**values, name: array})
    session = RenderSession(static, camera, background=BACKGROUND)
    have = session.draw(broken, with_ids=True)
    want = session.draw(moving.select(np.arange(50, 100)))
    np.testing.assert_array_equal(have.rgb, want.rgb)
    assert_same(have, full(static, broken, None, camera))


def test_shade_darkens_what_never_moves_and_only_that():
    camera, static, moving = make_camera(), cloud(900, 1), cloud(200, 2, spread=0.1, size=0.02)
    session = RenderSession(static, camera, background=BACKGROUND)
    shade = np.random.default_rng(0).uniform(0.3, 1, (130, 170)).astype(np.float32)
    bright, dark = session.draw(moving, with_ids=True), session.draw(moving, shade=shade, with_ids=True)
    for name in FIELDS[1:]:
        np.testing.assert_array_equal(getattr(bright, name), getattr(dark, name))
    # Black where it moves: what is left of the picture is the static part.
    black = moving.with_sh(np.full((200, 1, 3), -0.5 / SH_C0))
    np.testing.assert_allclose(
        session.draw(black, shade=shade).rgb, session.draw(black).rgb * shade[..., None], atol=2e-6
    )
    alone = session.draw(cloud(0, 1), shade=shade).rgb
    np.testing.assert_allclose(alone, session.draw(cloud(0, 1)).rgb * shade[..., None], atol=1e-6)
    np.testing.assert_array_equal(session.draw(moving, shade=np.ones_like(shade)).rgb, bright.rgb)


def test_given_colors_take_the_place_of_the_constant_term():
    camera, static, moving = make_camera(), cloud(300, 1), cloud(120, 2, spread=0.2)
    session = RenderSession(static, camera)
    colors = np.random.default_rng(1).uniform(0, 1, (2, 70, 3)).astype(np.float32)
    Ts = np.tile(np.eye(4), (2, 1, 1, 1))
    motion = Motion(parts=np.zeros(120, np.int32), Ts_world_part=Ts, colors=colors)
    frames = session.draw_many(moving, motion)
    for t in range(2):
        sh = np.array(moving.sh)
        sh[50:, 0] = (colors[t] - 0.5) / SH_C0
        want, _ = session.picture(moving.with_sh(sh))
        assert np.abs(frames[t].astype(int) - want).max() <= 1
    assert np.abs(frames[0].astype(int) - frames[1]).max() > 20


def test_several_cameras_draw_together():
    static, moving = cloud(300, 1), cloud(100, 2)
    cameras = [make_camera(), make_camera(64, 48)]
    sessions = [RenderSession(static, camera) for camera in cameras]
    motion = Motion(parts=np.zeros(100, np.int32), Ts_world_part=np.stack([poses(s, 1) for s in range(3)]))
    shades = np.full((3, 48, 64), 0.5, np.float32)
    first, second = draw_outputs(sessions, moving, motion, ("rgb8",), [None, shades])
    np.testing.assert_array_equal(first["rgb8"], sessions[0].draw_many(moving, motion))
    np.testing.assert_array_equal(second["rgb8"], sessions[1].draw_many(moving, motion, shades))


def test_wrong_sizes_are_refused():
    camera, moving = make_camera(), cloud(10, 2)
    session = RenderSession(cloud(20, 1), camera)
    motion = Motion(parts=np.zeros(10, np.int32), Ts_world_part=np.eye(4)[None, None])
    with pytest.raises(ValueError, match=r"shade has shape \(3, 4\), expected \(130, 170\)"):
        session.draw(moving, shade=np.ones((3, 4), np.float32))
    with pytest.raises(ValueError, match="expected \\(1, 130, 170\\)"):
        session.draw_many(moving, motion, np.ones((2, 130, 170), np.float32))
    with pytest.raises(ValueError, match="10 part indices for 4 Gaussians"):
        session.draw_many(moving.select(np.arange(4)), motion)
    with pytest.raises(BackendError, match="more colors than Gaussians"):
        session.draw_many(
            moving,
            Motion(
                parts=motion.parts,
                Ts_world_part=motion.Ts_world_part,
                colors=np.zeros((1, 11, 3), np.float32),
            ),
        )
    with pytest.raises(BackendError, match="a Gaussian's part has no pose"):
        session.draw(moving, RigidParts(indices=np.full(10, 2, np.int32), Ts_world_part=np.eye(4)[None]))
    with pytest.raises(BackendError, match="a pose is not finite"):
        session.draw(
            moving, RigidParts(indices=np.zeros(10, np.int32), Ts_world_part=np.full((1, 4, 4), np.nan))
        )
    other = RenderSession(cloud(20, 1), make_camera(80, 60)).picture(moving)
    with pytest.raises(ValueError, match="image"):
        session.picture(moving, into=other)


def test_the_engine_refuses_frames_that_are_not_complete():
    context, moving = native.Context(), cloud(10, 2)
    session = RenderSession(cloud(20, 1), make_camera())
    tiles = np.ones((-(-130 // TILE), -(-170 // TILE)), np.uint8)
    image, pose = np.empty((130, 170, 3), np.uint8), np.eye(4, dtype=np.float32)[:3].copy()
    scene = native_scene(moving)
    good = {
        "session": session._handle,
        "cam_from_part": pose.ctypes.data,
        "tiles": tiles.ctypes.data,
        "rgb8": image.ctypes.data,
    }
    context.draw_session(scene, 1, 0, [native.Frame(**good)])
    for name, problem in (
        ("session", "session is null"),
        ("cam_from_part", "cam_from_part is null"),
        ("tiles", "tiles are null"),
        ("rgb8", "no image"),
    ):
        with pytest.raises(BackendError, match=problem):
            context.draw_session(scene, 1, 0, [native.Frame(**{**good, name: None})])
    with pytest.raises(BackendError, match="colors are null"):
        context.draw_session(scene, 1, 5, [native.Frame(**good)])
    with pytest.raises(BackendError, match="come together"):
        context.draw_session(scene, 1, 0, [native.Frame(**good, max_id=image.ctypes.data)])
    with pytest.raises(BackendError, match="number of parts"):
        context.draw_session(scene, 0, 0, [native.Frame(**good)])
