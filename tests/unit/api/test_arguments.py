"""Public functions refuse wrong arguments with typed errors that carry the values."""

import pickle
from pathlib import Path

import numpy as np
import pytest

import aomgen as ag
from aomgen.api.arguments import require_count, require_poses, require_times
from aomgen.api.asset import asset_source
from aomgen.errors import (
    ConfigError,
    NonFiniteError,
    OutdatedRunError,
    PoseError,
    ShapeError,
    UnknownNameError,
)

POSES, TIMES = np.tile(np.eye(4), (10, 1, 1)), np.arange(10.0)


def test_a_wrong_shape_names_both_shapes() -> None:
    with pytest.raises(ShapeError) as caught:
        ag.estimate_joint(POSES[:, :3], TIMES)
    assert caught.value.shape == (10, 3, 4)
    assert caught.value.required == "(N, 4, 4)"


@pytest.mark.parametrize("scale", [2.0, -1.0])
def test_a_matrix_that_is_no_rotation_is_named_by_its_index(scale: float) -> None:
    poses = POSES.copy()
    poses[3, 0, 0] = scale
    with pytest.raises(PoseError) as caught:
        ag.estimate_joint(poses, TIMES)
    assert caught.value.index == 3
    assert caught.value.determinant == pytest.approx(scale)


def test_a_pose_needs_its_last_row() -> None:
    poses = POSES.copy()
    poses[0, 3] = [1, 0, 0, 1]
    with pytest.raises(PoseError):
        require_poses("poses", poses)


def test_a_relative_file_becomes_absolute_in_a_project(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("aomgen.api.asset.load_asset", lambda spec: None)
    assert asset_source("box.usda") == asset_source(Path("box.usda")) == str(tmp_path.resolve() / "box.usda")
    assert asset_source("box.usda#lid") == str(tmp_path.resolve() / "box.usda#lid")
    assert asset_source("toolbox:1") == "toolbox:1"


def test_nan_is_named_by_its_place() -> None:
    poses = POSES.copy()
    poses[2, 1, 3] = np.nan
    with pytest.raises(NonFiniteError, match=r"\[2, 1, 3\]"):
        ag.estimate_joint(poses, TIMES)


@pytest.mark.parametrize("times", [TIMES[::-1], np.zeros(10)])
def test_times_must_increase(times: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="index 1"):
        require_times("times_s", times, 10)


def test_as_many_times_as_poses() -> None:
    with pytest.raises(ShapeError):
        ag.estimate_joint(POSES, TIMES[:5])


@pytest.mark.parametrize(
    "option", [{"grasp_sd_m": 0.0}, {"closing_ee": (1.0, 1.0, 0.0)}, {"grasp_ee": (0.0, 0.0)}]
)
def test_options_of_the_joint_estimate_are_checked(option: dict) -> None:
    with pytest.raises(ConfigError):
        ag.estimate_joint(POSES, TIMES, **option)


@pytest.mark.parametrize("value", [0, -1, 1.5, True, "3"])
def test_counts_are_whole_positive_numbers(value: object) -> None:
    with pytest.raises(ConfigError):
        require_count("n", value)  # type: ignore[arg-type]


def test_an_unknown_stage_is_answered_with_the_known_ones(tmp_path) -> None:
    from aomgen.cli.run import sample_capture

    with pytest.raises(UnknownNameError) as caught:
        ag.reconstruct(sample_capture(), tmp_path / "out", until="motoin")
    assert caught.value.name == "motoin"
    assert "motion" in caught.value.known
    assert "did you mean 'motion'" in str(caught.value)


def test_an_unknown_choice_of_a_project_is_refused(tmp_path) -> None:
    from aomgen.cli.run import sample_capture

    with pytest.raises(UnknownNameError):
        ag.reconstruct(sample_capture(), tmp_path / "out", iteration=10)
    with pytest.raises(ConfigError, match="iterations"):
        ag.reconstruct(sample_capture(), tmp_path / "out", iterations=1)
    assert not (tmp_path / "out").exists()


def test_a_folder_without_a_run_is_refused(tmp_path) -> None:
    with pytest.raises(ag.InputError):
        ag.Run.open(tmp_path / "nothing")
    with pytest.raises(ag.InputError):
        ag.Run.open(tmp_path)


def test_a_camera_that_looks_nowhere_is_refused() -> None:
    with pytest.raises(ConfigError):
        ag.look_at((0, 0, 1), (0, 0, 1))
    with pytest.raises(ConfigError):
        ag.look_at((0, 0, 1), (0, 0, 0))


def test_an_unknown_public_name_lists_the_known_ones() -> None:
    with pytest.raises(AttributeError, match="reconstruct"):
        _ = ag.reconstrct


@pytest.mark.parametrize(
    "error",
    [
        ShapeError("a", (3, 4), "(N, 3)"),
        PoseError("T", 2, -1.0, 0.5),
        UnknownNameError("--set", "moton", ["motion"]),
        OutdatedRunError("out", "twin", 11, 12),
        ConfigError("x", "is y", "do z"),
    ],
)
def test_errors_keep_their_values_when_they_come_from_a_worker(error: ag.AomgenError) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)
