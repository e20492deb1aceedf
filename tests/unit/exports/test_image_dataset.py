"""Labelled images without physics: what a shard holds, what is refused, and that an interrupted export continues."""

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pytest
from PIL import Image

from aomgen.assets.choice import make_asset
from aomgen.conventions import MOVING, PART_LABELS
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.camera import Camera
from aomgen.core.keypoints import KEYPOINTS, find_keypoints, move_keypoints
from aomgen.core.transforms import apply, similarity
from aomgen.core.values import Array
from aomgen.errors import ConfigError, UnknownNameError
from aomgen.executors import Done
from aomgen.exports import image_clutter, image_dataset, image_samples
from aomgen.exports.image_dataset import ImageSetRequest, export_images, open_room, read_shard
from aomgen.io.artifact import load_artifact, read_json, save_artifact
from aomgen.results import BACKGROUND_FOLDER
from aomgen.splatting.surfels import surfels_of
from aomgen.twin.twin import TwinModel
from toy_run import ToyResults, toy_run

REQUEST = ImageSetRequest(images=5, size=(64, 48), seed=3, per_object=3, categories=("drawer",))


class Inline:
    """An executor that works in this process, and stops before a unit."""

    def __init__(self, opener: Any, stop_at: int) -> None:
        self.slots, self._work, self._stop, self._units = 1, opener(), stop_at, []

    def submit(self, unit: int) -> None:
        if unit == self._stop:
            raise KeyboardInterrupt
        self._units.append(unit)

    def next_done(self) -> Done:
        unit = self._units.pop(0)
        return Done(unit=unit, value=self._work(unit))

    def __enter__(self) -> "Inline":
        return self

    def __exit__(self, *exception: object) -> None:
        pass


def cover_plainly(asset: ArticulatedAsset, rng: np.random.Generator) -> Any:
    links = tuple(surfels_of(link.meshes, 400, rng) for link in (asset.static, asset.moving))
    return links, links


@pytest.fixture(scope="module", autouse=True)
def plain() -> Iterator[None]:
    """Few discs in all light: the tests do not look at colors."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(image_samples, "cover_asset", cover_plainly)
        patch.setattr(image_clutter, "KINDS", 2)
        patch.setattr(image_clutter, "OBJECTS", 1)
        patch.setattr(image_clutter, "OBJECT_DISCS", 300)
        yield


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> ToyResults:
    """A toy run with the scene's twin without its object."""
    made = toy_run(tmp_path_factory.mktemp("toy") / "run")
    twin = load_artifact(made.asset_folder(0), "twin", TwinModel)
    home = made.folders["replacement"] / BACKGROUND_FOLDER
    home.mkdir()
    save_artifact(home, "twin", twin.select(twin.bodies == 0))
    return made


@pytest.fixture(scope="module")
def dataset(results: ToyResults, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose export was interrupted after its first shard."""
    folder = tmp_path_factory.mktemp("images") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(image_dataset, "require_stage", lambda *arguments: None)
        patch.setattr(image_dataset, "open_executor", lambda _, opener, timeout_s: Inline(opener, 1))
        with pytest.raises(KeyboardInterrupt):
            export_images(results, folder, REQUEST, lambda share, text: None)
        assert not (folder / "dataset.json").exists()
        first = (folder / "shard-000000.tar").stat().st_mtime_ns
        patch.setattr(image_dataset, "open_executor", lambda _, opener, timeout_s: Inline(opener, -1))
        export_images(results, folder, REQUEST, lambda share, text: None)
        assert (folder / "shard-000000.tar").stat().st_mtime_ns == first
        with pytest.raises(ConfigError, match="begun for something else"):
            export_images(results, folder, ImageSetRequest(images=9, categories=("drawer",)), print)
    return folder


def samples(folder: Path) -> Iterator[tuple[dict[str, Any], dict[str, Array]]]:
    for shard in sorted(folder.glob("*.tar")):
        for _, files in read_shard(shard):
            images = {
                name: np.array(Image.open(io.BytesIO(data))) for name, data in files.items() if name != "json"
            }
            yield json.loads(files["json"]), images


def test_the_set_says_what_it_holds(dataset: Path) -> None:
    described = read_json(dataset / "dataset.json")
    assert described["keypoints"] == list(KEYPOINTS)
    assert described["labels"] == PART_LABELS
    assert (described["images"], described["images_per_shard"], described["size"]) == (5, 3, [64, 48])
    assert [item["source"] for item in described["objects"]] == ["drawer:40000", "drawer:40001"]
    assert [item["images"] for item in described["objects"]] == [3, 2]
    assert [key for shard in sorted(dataset.glob("*.tar")) for key, _ in read_shard(shard)] == [
        f"{number:08d}" for number in range(5)
    ]


def test_a_deleted_shard_is_rendered_again_and_another_twin_is_refused(
    results: ToyResults, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered = list[int]()

    def open_writer(results: ToyResults, folder: Path, request: ImageSetRequest) -> Any:
        def write(shard: int) -> dict[str, str]:
            rendered.append(shard)
            (folder / f"shard-{shard:06d}.tar").touch()
            return {"asset": str(shard)}

        return write

    monkeypatch.setattr(image_dataset, "require_stage", lambda *arguments: None)
    monkeypatch.setattr(image_dataset, "open_executor", lambda _, opener, timeout_s: Inline(opener, -1))
    monkeypatch.setattr(image_dataset, "open_room", open_writer)
    export_images(results, tmp_path / "set", REQUEST, lambda share, text: None)
    (tmp_path / "set" / "shard-000001.tar").unlink()
    export_images(results, tmp_path / "set", REQUEST, lambda share, text: None)
    assert rendered == [0, 1, 1]
    other = copytree(results.folders["replacement"], tmp_path / "replacement")
    scene = other / "scene.json"
    scene.write_text(scene.read_text() + "\n")
    changed = replace(results, folders={**results.folders, "replacement": other})
    with pytest.raises(ConfigError, match="begun for something else"):
        export_images(changed, tmp_path / "set", REQUEST, lambda share, text: None)


def test_labels_agree_with_each_other(dataset: Path) -> None:
    for facts, images in samples(dataset):
        assert {name: image.shape for name, image in images.items()} == {
            "jpg": (48, 64, 3),
            "labels.png": (48, 64),
            "depth.png": (48, 64),
        }
        K, points = np.array(facts["K"]), np.array(facts["points_world"])
        camera = Camera(
            fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], width=64, height=48, T_world_cam=facts["T_world_cam"]
        )  # fmt: skip
        pixels, depths = camera.project(points)
        shown = np.array(facts["visible"], bool)
        np.testing.assert_allclose(np.array(facts["points_px"])[depths > 0], pixels[depths > 0], atol=1e-9)
        for k in np.flatnonzero(shown[:3]):
            u, v = pixels[k].astype(int)
            near = np.s_[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
            assert (images["labels.png"][near] == MOVING).any()
            assert np.abs(images["depth.png"][near] / 1000 - depths[k]).min() < 0.03
        asset = make_asset("drawer", int(facts["source"].partition(":")[2]), facts["style"])
        sized = asset.transform(similarity(facts["scale"], np.eye(3), np.zeros(3)))
        moved = move_keypoints(find_keypoints(sized), sized.joint, facts["theta"])[0]
        np.testing.assert_allclose(points, apply(facts["T_world_object"], moved), atol=1e-9)
    assert any(any(facts["visible"]) for facts, _ in samples(dataset))


def test_a_shard_depends_on_seed_and_number_alone(results: ToyResults, dataset: Path, tmp_path: Path) -> None:
    open_room(results, tmp_path, REQUEST)(1)
    assert (tmp_path / "shard-000001.tar").read_bytes() == (dataset / "shard-000001.tar").read_bytes()


def test_named_objects_and_categories_take_turns() -> None:
    request = ImageSetRequest(images=4, per_object=1, categories=("microwave",), assets=("drawer:7",), seed=1)
    request.check()
    opened = [request.open_object(shard) for shard in range(4)]
    assert [origin["source"] for _, origin in opened] == [
        "microwave:20000", "drawer:7", "microwave:20001", "drawer:7",
    ]  # fmt: skip
    assert [origin["style"] for _, origin in opened] == ["classic", "classic", "compact", "classic"]
    only = ImageSetRequest(images=2, per_object=1, categories=("microwave",), styles=("wide",))
    assert [only.open_object(shard)[1]["style"] for shard in range(2)] == ["wide", "wide"]


@pytest.mark.parametrize(
    ("changes", "error", "said"),
    [
        ({}, ConfigError, "--category: is missing"),
        ({"images": 0, "categories": ("drawer",)}, ConfigError, "--n"),
        ({"per_object": 0, "categories": ("drawer",)}, ConfigError, "--per-object"),
        ({"categories": ("spoon",)}, ConfigError, "cannot be made"),
        ({"categories": ("drawer",), "styles": ("rounded",)}, UnknownNameError, "rounded"),
        ({"categories": ("drawer", "cabinet"), "styles": ("kitchen",)}, ConfigError, "no style of 'cabinet'"),
        ({"assets": ("spoon",)}, ConfigError, "neither category:seed nor a USD file"),
    ],
)
def test_refused_before_work_starts(changes: dict[str, Any], error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        ImageSetRequest(**{"images": 1, **changes}).check()


def test_a_foreign_folder_is_not_touched(results: ToyResults, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(image_dataset, "require_stage", lambda *arguments: None)
    (tmp_path / "holiday.jpg").touch()
    with pytest.raises(ConfigError, match="holds no labelled images"):
        export_images(results, tmp_path, REQUEST, lambda share, text: None)
    with pytest.raises(ConfigError, match="holds no labelled images"):
        export_images(results, tmp_path / "holiday.jpg", REQUEST, lambda share, text: None)
    assert [path.name for path in tmp_path.iterdir()] == ["holiday.jpg"]
