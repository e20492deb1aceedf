"""Laws of the rasterizer that need no reference, and inputs it must survive or refuse."""

import multiprocessing

import numpy as np
import pytest

from aomgen.core.camera import Camera, look_at
from aomgen.core.gaussians import Gaussians, concatenate
from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.errors import BackendError
from aomgen.splatting import native
from aomgen.splatting.rasterizer import contribution_weights, render

CAMERA = Camera(
    fx=110.0,
    fy=108.0,
    cx=63.0,
    cy=50.0,
    width=130,
    height=99,
    T_world_cam=look_at([1.0, -1.4, 0.9], [0, 0, 0]),
)


def scatter(count: int = 400, degree: int = 3, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=rng.normal(size=(count, 3)) * 0.4,
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-3, 0.6, (count, 3))),
        opacities=rng.uniform(0.05, 1, count),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
    )


def one(means=(0.0, 0.0, 0.0), scale=0.05, opacity=0.9, color=(1.0, 0.5, 0.25)) -> Gaussians:
    return Gaussians(
        means=np.array([means]),
        quats=np.array([[1.0, 0, 0, 0]]),
        scales=np.full((1, 3), scale),
        opacities=np.array([opacity]),
        sh=(np.array([[color]]) - 0.5) / 0.28209479177387814,
    )


def same(a, b) -> bool:
    names = ("rgb", "alpha", "depth", "median_depth", "max_id", "features")
    pairs = [(getattr(a, name), getattr(b, name)) for name in names]
    return all(x is y is None or np.array_equal(x, y) for x, y in pairs)


def test_one_gaussian_lands_where_the_camera_projects_it() -> None:
    g = one(means=(0.1, 0.05, 0.1))
    drawn = render(g, CAMERA, with_ids=True)
    pixel, depth = CAMERA.project(g.means)
    v, u = np.unravel_index(drawn.alpha.argmax(), drawn.alpha.shape)
    assert abs(u + 0.5 - pixel[0, 0]) <= 0.5
    assert abs(v + 0.5 - pixel[0, 1]) <= 0.5
    assert drawn.depth[v, u] == pytest.approx(depth[0], rel=1e-5)
    assert drawn.median_depth[v, u] == pytest.approx(depth[0], rel=1e-5)
    assert drawn.max_id[v, u] == 0
    assert drawn.max_id[0, 0] == -1
    np.testing.assert_allclose(drawn.rgb[v, u] / drawn.alpha[v, u], [1, 0.5, 0.25], atol=1e-4)


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_any_number_of_threads_gives_the_same_bits(threads: int) -> None:
    g = scatter(9000)
    features = np.random.default_rng(1).normal(size=(9000, 3)).astype(np.float32)
    want = render(g, CAMERA, features=features, with_ids=True, threads=1)
    assert same(want, render(g, CAMERA, features=features, with_ids=True, threads=threads))


def test_order_of_gaussians_does_not_matter() -> None:
    g = scatter(500)
    shuffled = g.select(np.random.default_rng(0).permutation(500))
    np.testing.assert_array_equal(render(g, CAMERA).rgb, render(shuffled, CAMERA).rgb)


def test_turning_scene_and_camera_together_changes_nothing() -> None:
    g = scatter(300)
    T = transform(matrix_from_rotvec(np.array([0.7, -1.1, 0.4])), np.array([0.3, -0.2, 0.5]))
    want = render(g, CAMERA)
    have = render(g.transform(T), CAMERA.move(T @ CAMERA.T_world_cam))
    np.testing.assert_allclose(have.rgb, want.rgb, atol=2e-4)
    np.testing.assert_allclose(have.depth, want.depth, atol=2e-3)
    only_moved = Gaussians(
        means=g.transform(T).means,
        quats=g.transform(T).quats,
        scales=g.scales,
        opacities=g.opacities,
        sh=g.sh,
    )
    unturned_sh = render(only_moved, CAMERA.move(T @ CAMERA.T_world_cam))
    assert np.abs(unturned_sh.rgb - want.rgb).max() > 0.05


def test_contributions_of_a_full_mask_add_up_to_alpha() -> None:
    g = scatter(300)
    masks = np.ones((1, CAMERA.height, CAMERA.width), np.float32)
    total = contribution_weights(g, CAMERA, masks).sum()
    assert total == pytest.approx(render(g, CAMERA).alpha.sum(), rel=1e-4)


def test_features_equal_to_colors_blend_like_colors() -> None:
    g = scatter(200, degree=0)
    colors = np.maximum(0.5 + 0.28209479177387814 * g.sh[:, 0], 0)
    drawn = render(g, CAMERA, features=colors)
    np.testing.assert_allclose(np.minimum(drawn.features, 1), drawn.rgb, atol=1e-5)


def test_nothing_in_view_shows_the_background() -> None:
    behind = one(means=(2.0, -2.8, 1.8))
    for g in (behind, behind.select(np.zeros(1, bool))):
        drawn = render(g, CAMERA, background=(0.1, 0.2, 0.3), with_ids=True)
        assert (drawn.rgb == np.float32([0.1, 0.2, 0.3])).all()
        assert not drawn.alpha.any()
        assert not drawn.depth.any()
        assert (drawn.max_id == -1).all()


@pytest.mark.parametrize("isa", native.instruction_sets())
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38, -3e38])
@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh"])
def test_broken_numbers_are_left_out(
    field: str, value: float, isa: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing crashes, nothing is NaN, and NaN or infinity changes no pixel at all."""
    good, bad = scatter(200, seed=1), scatter(40, seed=2)
    arrays = {name: np.array(getattr(bad, name)) for name in ("means", "quats", "scales", "opacities", "sh")}
    flat = arrays[field].reshape(40, -1)
    flat[:, np.arange(40) % flat.shape[1]] = value
    broken = Gaussians(**arrays)
    context = native.Context()
    configure = context.configure
    monkeypatch.setattr(context, "configure", lambda threads=None: configure(threads, isa))
    monkeypatch.setattr(native, "scratch_context", lambda: context)
    drawn = render(concatenate([good, broken]), CAMERA, with_ids=True)
    assert all(np.isfinite(image).all() for image in (drawn.rgb, drawn.alpha, drawn.depth))
    if not np.isfinite(value):
        assert same(
            drawn, render(concatenate([good, broken.select(np.zeros(40, bool))]), CAMERA, with_ids=True)
        )


def test_enormous_and_vanishing_gaussians() -> None:
    for scale in (0.0, 1e-20, 1e3, 1e8):
        drawn = render(one(scale=scale), CAMERA)
        assert np.isfinite(drawn.rgb).all()


def test_a_camera_inside_the_cloud() -> None:
    pose = look_at([0.0, 0.0, 0.0], [1.0, 0.2, 0.1])
    drawn = render(scatter(2000), CAMERA.move(pose), with_ids=True)
    assert np.isfinite(drawn.rgb).all()
    assert drawn.alpha.max() <= 1


@pytest.mark.parametrize(
    "change", [{"width": 0}, {"width": 20000}, {"fx": 0.0}, {"fx": np.nan}, {"cx": np.inf}]
)
def test_impossible_cameras_are_refused(change: dict) -> None:
    fields = {
        name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height", "T_world_cam")
    }
    with pytest.raises(BackendError):
        render(one(), Camera(**(fields | change)))


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="features"):
        render(scatter(5), CAMERA, features=np.zeros((4, 2), np.float32))
    with pytest.raises(ValueError, match="masks"):
        contribution_weights(scatter(5), CAMERA, np.zeros((1, 7, 7), np.float32))


def test_unknown_instruction_set_is_refused() -> None:
    with pytest.raises(BackendError, match="instruction set"):
        native.Context(instruction_set="mmx")


def test_a_missing_library_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "LIBRARY_NAME", "libnothing.so")
    with pytest.raises(BackendError, match="cmake --build"):
        native.library.__wrapped__()


def _checksum(queue: "multiprocessing.Queue[float]") -> None:
    queue.put(float(render(scatter(), CAMERA, threads=2).rgb.sum()))


def test_a_forked_child_can_render() -> None:
    """The parent's worker threads do not exist in the child."""
    want = float(render(scatter(), CAMERA, threads=2).rgb.sum())
    fork = multiprocessing.get_context("fork")
    queue = fork.Queue()
    child = fork.Process(target=_checksum, args=(queue,))
    child.start()
    assert queue.get(timeout=20) == want
    child.join(timeout=20)
    assert child.exitcode == 0
