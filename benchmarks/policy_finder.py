"""Errors of a finder in labelled images: of its training, of other scenes, and of other objects."""

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from aomgen.errors import BackendError
from aomgen.evaluation.suite import open_results
from aomgen.exports.image_dataset import DATASET_FILE, ImageSetRequest, export_images
from benchmarks.policy_data import PolicyData
from benchmarks.policy_tables import Variant

# Seeds of generated objects in the training images, and of others; none of them is an object of the tables of policies.
LEARNED, OTHERS = range(1001, 1301), range(2001, 2031)
# Images of each object in the training; as many of every tenth object, and of all others, are tested.
PER_OBJECT: Final = 20
TESTED: Final = LEARNED[::10]
# Seeds of the objects, and random seed of the scenes, of each set of images.
IMAGE_SETS: Final = {"learned": (LEARNED, 0), "scenes": (TESTED, 1), "objects": (OTHERS, 2)}
# Steps of 32 images.
STEPS: Final = 4000
# Options of the training: the usual one with the sides of the crops of the second and the third look, [px], and the ablations.
CROPS: Final = ("--crop", "96", "40")
VARIANTS: Final[Mapping[Variant, tuple[str, ...]]] = {
    "usual": CROPS,
    "one_look": ("--crop",),
    "from_scratch": (*CROPS, "--from-scratch"),
}
# Name of the trained finder.
WEIGHTS: Final = "finder.safetensors"


def train_finder(data: PolicyData, category: str, seed: int = 0, variant: Variant = "usual") -> Path:
    """Train a finder on images of generated objects of a category and return its file; an existing one is kept.

    Args:
        data: Folder of runs, images and finders.
        category: Category of the objects.
        seed: Seed of the finder's weights and samples.
        variant: Options of the training.

    Raises:
        BackendError: The plug-in is not installed here.
        AomgenError: Any error of the run, the images or the training.
    """
    name = category if (seed, variant) == (0, "usual") else f"{category}-{seed}-{variant}"
    home = data.folder / "finders" / name
    if not (home / WEIGHTS).is_file():
        main = import_plugin("train_finder").main
        learned, others = (str(_export_set(data, category, images)) for images in ("learned", "objects"))
        data.notify(f"training finder {name}")
        words = [learned, str(home), "--validation", others, f"--threads={data.workers}"]
        words += [f"--steps={STEPS}", f"--seed={seed}", *VARIANTS[variant]]
        if main(words):
            raise BackendError("train_finder", "failed", "see its message above")
    return home / WEIGHTS


def measure_finder(data: PolicyData, category: str) -> dict[str, Any]:
    """Measure the lateral errors of the finder of a category; images and finder are kept.

    Returns:
        For images of the training, of the same objects in other scenes, of other objects and of the user's assets: the table of
        `lerobot_policy_aomgen.finder_errors`.

    Raises:
        BackendError: The plug-in is not installed here.
        AomgenError: Any error of the run, the images or the training.
    """
    errors, read_images = import_plugin("finder_errors"), import_plugin("finder_images").read_images
    finder, _ = import_plugin("finder").load_finder(train_finder(data, category))
    learned = _export_set(data, category, "learned")
    images = {
        "training": read_images(learned, len(TESTED) * PER_OBJECT),
        "other_scenes": read_images(_export_set(data, category, "scenes")),
        "other_objects": read_images(_export_set(data, category, "objects")),
    }
    if assets := data.user_assets(category):
        images["imported"] = read_images(_export(data, category, "imported", assets, 3))
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


def _export_set(data: PolicyData, category: str, name: str) -> Path:
    """Return the folder of a set of images of generated objects."""
    seeds, seed = IMAGE_SETS[name]
    return _export(data, category, name, [f"{category}:{number}" for number in seeds], seed)


def _export(data: PolicyData, category: str, name: str, assets: list[str], seed: int) -> Path:
    """Return the folder of labelled images of some objects, in the scene where the category was recorded."""
    folder = data.folder / "images" / category / name
    if not (folder / DATASET_FILE).is_file():
        results = replace(open_results(data.run(category, until="replacement")), workers=data.workers)
        request = ImageSetRequest(
            images=PER_OBJECT * len(assets), seed=seed, per_object=PER_OBJECT, assets=tuple(assets)
        )
        data.notify(f"images {category} {name}")
        export_images(results, folder, request, lambda share, text: data.notify(text))
    return folder
