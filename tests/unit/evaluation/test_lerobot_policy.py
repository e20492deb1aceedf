"""Which policies of LeRobot are taken; that a real one acts is tested in tests/readers/test_policy.py."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import pytest

from aomgen.errors import BackendError, ConfigError, MissingFileError
from aomgen.evaluation.lerobot_policy import (
    LAST,
    LerobotPolicy,
    checkpoint_digest,
    checkpoint_folder,
    require_fit,
)
from aomgen.evaluation.suite import Suite
from aomgen.io.atomic import write_json


def weights_in(folder: Path, content: bytes = b"weights") -> Path:
    folder.mkdir(parents=True)
    (folder / "model.safetensors").write_bytes(content)
    (folder / "config.json").write_text("{}")
    return folder


def config_for(suite: Suite, **changed: tuple[int, ...]) -> SimpleNamespace:
    shapes = {name: (3, camera.height, camera.width) for name, camera in suite.cameras.items()} | changed
    features = {f"observation.images.{name}": SimpleNamespace(shape=shape) for name, shape in shapes.items()}
    state = SimpleNamespace(shape=(len(suite.joint_names) + 1,))
    return SimpleNamespace(image_features=features, robot_state_feature=state, env_state_feature=None)


def test_weights_are_found_by_themselves_and_below_their_training(tmp_path: Path) -> None:
    weights = weights_in(tmp_path / "training" / LAST)
    assert checkpoint_folder(weights) == checkpoint_folder(tmp_path / "training") == weights
    with pytest.raises(MissingFileError, match=r"holds no model\.safetensors"):
        checkpoint_folder(tmp_path)


def test_other_weights_or_settings_are_another_policy(tmp_path: Path) -> None:
    one, other = (weights_in(tmp_path / name, name.encode()) for name in ("one", "other"))
    assert checkpoint_digest(one) != checkpoint_digest(other)
    (other / "model.safetensors").write_bytes(b"one")
    assert checkpoint_digest(one) == checkpoint_digest(other)
    (other / "config.json").write_text('{"library": "other"}')
    assert checkpoint_digest(one) != checkpoint_digest(other)


def test_where_lerobot_is_not_installed_its_environment_is_named(suite: Suite, tmp_path: Path) -> None:
    if importlib.util.find_spec("lerobot") is not None:
        pytest.skip("lerobot is installed")
    with pytest.raises(BackendError, match="make policy-env"):
        LerobotPolicy(weights_in(tmp_path / "weights"), suite)


def test_a_policy_that_fits_is_taken(suite: Suite, tmp_path: Path) -> None:
    require_fit(config_for(suite), suite, tmp_path)


def test_a_policy_that_observes_keypoints_is_refused(suite: Suite, tmp_path: Path) -> None:
    config = config_for(suite)
    config.env_state_feature = SimpleNamespace(shape=(7,))
    require_fit(config, suite, tmp_path)
    config.env_state_feature = SimpleNamespace(shape=(15,))
    with pytest.raises(ConfigError, match=r"environment state is \(15,\), the object's pose has \(7,\)"):
        require_fit(config, suite, tmp_path)


def test_every_difference_is_named(suite: Suite, tmp_path: Path) -> None:
    camera = next(iter(suite.cameras))
    dataset, weights = tmp_path / "dataset", tmp_path / "weights"
    write_json(dataset / "meta" / "info.json", {"fps": suite.fps + 5})
    write_json(dataset / "aomgen.json", {"choices": {"actions": "ee_delta"}})
    write_json(weights / "train_config.json", {"dataset": {"root": str(dataset)}})
    config = config_for(suite, **{camera: (3, 7, 9), "nowhere": (3, 8, 8)})
    config.robot_state_feature = SimpleNamespace(shape=(3,))
    with pytest.raises(ConfigError) as caught:
        require_fit(config, suite, weights)
    said = str(caught.value)
    for words in (f"camera {camera} is (3, 7, 9)", "camera nowhere", "state is (3,)", "rate is", "ee_delta"):
        assert words in said
