"""Errors of the finder of `handle_act` in labelled images: of its training, of other scenes, and of other objects."""

from dataclasses import replace
from pathlib import Path
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
# Steps of 32 images.
STEPS: Final = 3000


def measure_finder(data: PolicyData) -> dict[str, Any]:
    """Train a finder on images of made microwaves and measure its lateral errors; images and finder are kept.

    Returns:
        For images of the training, of the same objects in other scenes, of other objects and of the user's assets: the table of
        `lerobot_policy_aomgen.finder_errors`.

    Raises:
        BackendError: The plug-in is not installed here.
        AomgenError: Any error of the run, the images or the training.
    """
    try:
        from lerobot_policy_aomgen.finder import load_finder  # pyright: ignore[reportMissingImports]
        from lerobot_policy_aomgen.finder_errors import make_table, measure_errors  # pyright: ignore[reportMissingImports]
        from lerobot_policy_aomgen.finder_images import read_images  # pyright: ignore[reportMissingImports]
        from lerobot_policy_aomgen.train_finder import main  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise BackendError(
            "lerobot_policy_aomgen",
            f"cannot be imported ({error})",
            "make policy-env; .venv-policy/bin/python -m benchmarks policy ...",
        ) from error
    learned = _export(data, "learned", [f"microwave:{seed}" for seed in LEARNED], 0)
    tests = {
        "other_scenes": _export(data, "scenes", [f"microwave:{seed}" for seed in TESTED], 1),
        "other_objects": _export(data, "objects", [f"microwave:{seed}" for seed in OTHERS], 2),
    }
    if data.assets:
        tests["imported"] = _export(data, "imported", list(data.assets), 3)
    home = data.folder / "finder"
    if not (home / "finder.safetensors").is_file():
        words = [str(learned), str(home), "--validation", str(tests["other_objects"]), f"--steps={STEPS}"]
        if main(words):
            raise BackendError("train_finder", "failed", "see its message above")
    finder, _ = load_finder(home / "finder.safetensors")
    images = {"training": read_images(learned, len(TESTED) * PER_OBJECT)}
    images |= {name: read_images(folder) for name, folder in tests.items()}
    return {name: make_table(measure_errors(finder, found), found) for name, found in images.items()}


def _export(data: PolicyData, name: str, assets: list[str], seed: int) -> Path:
    """Return the folder of labelled images of some objects."""
    folder = data.folder / "images" / name
    if not (folder / DATASET_FILE).is_file():
        results = replace(open_results(data.run("microwave")), workers=data.workers)
        request = ImageSetRequest(
            images=PER_OBJECT * len(assets), seed=seed, per_object=PER_OBJECT, assets=tuple(assets)
        )
        data.tell(f"images {name}")
        export_images(results, folder, request, lambda share, text: data.tell(text))
    return folder
