"""Errors of the finder of `handle_act` in labelled images: of its training, of other scenes, and of other objects."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from aomgen.errors import BackendError
from aomgen.evaluation.suite import open_results
from aomgen.exports.image_dataset import DATASET_FILE, ImageSetRequest, export_images
from benchmarks.policy_data import PolicyData

# Made microwaves in the training images, and others; none of them is an object of the tables of policies.
LEARNED, OTHERS = range(1001, 1301), range(2001, 2031)
# Images of each object in the training; as many of every tenth object, and of all others, are tested.
PER_OBJECT: Final = 20
TESTED: Final = LEARNED[::10]
# Objects and random seed of each set of images.
IMAGE_SETS: Final = {"learned": (LEARNED, 0), "scenes": (TESTED, 1), "objects": (OTHERS, 2)}
# Steps of 32 images, and sides of the crops of the second and the third look, [px].
STEPS: Final = 4000
CROPS: Final = (96, 40)


# Name of the trained finder.
WEIGHTS: Final = "finder.safetensors"


def train_finder(data: PolicyData) -> Path:
    """Train a finder on images of generated microwaves and return its file; an existing one is kept.

    Raises:
        BackendError: The plug-in is not installed here.
        AomgenError: Any error of the run, the images or the training.
    """
    home = data.folder / "finder"
    if not (home / WEIGHTS).is_file():
        main = import_plugin("train_finder").main
        learned = _export_set(data, "learned")
        data.notify("training finder")
        words = [
            str(learned),
            str(home),
            "--validation",
            str(_export_set(data, "objects")),
            f"--steps={STEPS}",
            "--crop",
            *map(str, CROPS),
        ]
        if main(words):
            raise BackendError("train_finder", "failed", "see its message above")
    return home / WEIGHTS


def measure_finder(data: PolicyData) -> dict[str, Any]:
    """Measure the lateral errors of a finder; images and finder are kept.

    Returns:
        For images of the training, of the same objects in other scenes, of other objects and of the user's assets: the table of
        `lerobot_policy_aomgen.finder_errors`.

    Raises:
        BackendError: The plug-in is not installed here.
        AomgenError: Any error of the run, the images or the training.
    """
    errors, read_images = import_plugin("finder_errors"), import_plugin("finder_images").read_images
    finder, _ = import_plugin("finder").load_finder(train_finder(data))
    learned = _export_set(data, "learned")
    images = {
        "training": read_images(learned, len(TESTED) * PER_OBJECT),
        "other_scenes": read_images(_export_set(data, "scenes")),
        "other_objects": read_images(_export_set(data, "objects")),
    }
    if data.assets:
        images["imported"] = read_images(_export(data, "imported", list(data.assets), 3))
    return {
        name: errors.make_table(errors.measure_errors(finder, found), found) for name, found in images.items()
    }


def import_plugin(module: str) -> ModuleType:
    """Import a module of the plug-in, which needs LeRobot.

    Raises:
        BackendError: The plug-in is not installed here.
    """
    try:
        return import_module(f"lerobot_policy_aomgen.{module}")
    except ImportError as error:
        raise BackendError(
            "lerobot_policy_aomgen",
            f"cannot be imported ({error})",
            "make policy-env; .venv-policy/bin/python -m benchmarks policy ...",
        ) from error


def _export_set(data: PolicyData, name: str) -> Path:
    seeds, seed = IMAGE_SETS[name]
    return _export(data, name, [f"microwave:{number}" for number in seeds], seed)


def _export(data: PolicyData, name: str, assets: list[str], seed: int) -> Path:
    """Return the folder of labelled images of some objects."""
    folder = data.folder / "images" / name
    if not (folder / DATASET_FILE).is_file():
        results = replace(open_results(data.run("microwave")), workers=data.workers)
        request = ImageSetRequest(
            images=PER_OBJECT * len(assets), seed=seed, per_object=PER_OBJECT, assets=tuple(assets)
        )
        data.notify(f"images {name}")
        export_images(results, folder, request, lambda share, text: data.notify(text))
    return folder
