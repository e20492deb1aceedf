"""Export of labeled images without physics as a WebDataset; each shard contains the images of one object.

`FOLDER/shard-000000.tar` contains KEY.jpg, KEY.labels.png (part labels), KEY.depth.png (16 bit, [mm]) and KEY.json of
each image. `FOLDER/dataset.json` describes the dataset and is written last. `FOLDER/objects/` lists the finished
shards.
"""

import io
import tarfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from aomgen.assets.choice import (
    asset_file,
    is_made,
    list_styles,
    make_asset,
    open_asset,
    require_usable,
    style_of_seed,
    suggest_category,
)
from aomgen.conventions import PART_LABELS
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.keypoints import KEYPOINTS
from aomgen.core.progress import Progress
from aomgen.episodes.stage import open_executor
from aomgen.errors import ConfigError, UnknownNameError
from aomgen.exports.image_samples import ImageRoom
from aomgen.io.atomic import is_vacant, write_bytes, write_json
from aomgen.pipeline.manifest import files_digest
from aomgen.pipeline.stages import require_stage
from aomgen.results import BACKGROUND_FOLDER, FITTED, Results
from aomgen.saved_units import REQUEST_FILE, SavedUnits, unit_name

# Version of the file layout.
VERSION: Final = 1
DATASET_FILE: Final = "dataset.json"
SHARD: Final = "shard-{:06d}.tar"
OBJECTS: Final = "objects"
# The seeds of an export's procedural objects begin at this number times (its seed + 1); projects use smaller seeds.
SEEDS: Final = 10_000
# Time limit of one shard, [s].
TIMEOUT_S: Final = 3600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageSetRequest:
    """Request for labeled images.

    Attributes:
        images: Number of images.
        size: Width and height, [px].
        seed: Random seed of objects and scenes.
        per_object: Number of images of each object, which form one shard.
        categories: Categories of procedural objects; each shard contains a different object.
        assets: Objects by name, as in a project; shards alternate between these and the categories.
        styles: Styles of procedural objects; empty for all.
    """

    images: int
    size: tuple[int, int] = (256, 256)
    seed: int = 0
    per_object: int = 100
    categories: tuple[str, ...] = ()
    assets: tuple[str, ...] = ()
    styles: tuple[str, ...] = ()

    @property
    def shards(self) -> int:
        """Return the number of shards."""
        return -(-self.images // self.per_object)

    def check(self) -> None:
        """Refuse an invalid request.

        Raises:
            ConfigError, UnknownNameError: A number is too small, or a category or a style is unknown.
            AssetError, InputError: An asset cannot be used.
        """
        if not (self.categories or self.assets):
            raise ConfigError("--category", "is missing", "name the category of the objects, or objects")
        for name, value in (("--n", self.images), ("--per-object", self.per_object)):
            if not value >= 1:
                raise ConfigError(name, f"is {value}", "use 1 or more")
        for category in self.categories:
            if not is_made(category):
                raise ConfigError("--category", f"'{category}' cannot be made", suggest_category(category))
        known = [style for category in self.categories for style in list_styles(category)]
        for style in self.styles:
            if style not in known:
                raise UnknownNameError("--style", style, known)
        for category in self.categories if self.styles else ():
            if not set(self.styles) & set(list_styles(category)):
                raise ConfigError("--style", f"leaves no style of '{category}'", "name one of its styles")
        for spec in self.assets:
            open_asset(spec)

    def open_object(self, shard: int) -> tuple[ArticulatedAsset, dict[str, Any]]:
        """Open the object of a shard, and return it with a description of its source."""
        sources = [*self.categories, *self.assets]
        source = sources[shard % len(sources)]
        if source not in self.categories:
            asset = open_asset(source)
            made = "" if asset_file(source) else source.rpartition(":")[2]
            style = style_of_seed(asset.category, int(made)) if made else ""
            return asset, {"source": source, "style": style}
        styles = [style for style in list_styles(source) if not self.styles or style in self.styles]
        seed = SEEDS * (1 + self.seed) + shard // len(sources)
        style = styles[shard // len(sources) % len(styles)]
        asset = require_usable(make_asset(source, seed, style))
        return asset, {"source": f"{source}:{seed}", "style": style}


def export_images(
    results: Results, folder: Path, request: ImageSetRequest, progress: Progress
) -> list[dict[str, Any]]:
    """Render labeled images into a folder; an interrupted export is continued.

    Args:
        results: Results of a run; defines the number of workers or the Ray cluster.
        folder: Folder of the dataset.
        request: Requested images; without categories and assets, the categories of the run's objects.
        progress: Called after each shard.

    Returns:
        The objects by shard.

    Raises:
        ConfigError: The request is invalid, the folder has other content, or an object does not fit on the table.
        MissingFileError: The run has no result of the stage "replacement".
        AomgenError: Any error of the rendering.
    """
    require_stage(results, "replacement")
    if not (request.categories or request.assets):
        own = dict.fromkeys(fitted.asset.category for fitted in results.fitted_assets)
        request = replace(request, categories=tuple(filter(is_made, own)))
    request.check()
    if not is_vacant(folder) and not (folder / OBJECTS / REQUEST_FILE).is_file():
        raise ConfigError(folder, "is there and holds no labelled images", "choose another folder")
    identity = {"version": VERSION, "run": str(results.out), "twin": _scene_digest(results)}
    units = SavedUnits(folder / OBJECTS, identity | asdict(request), dict)
    for shard in range(request.shards):
        if not (folder / SHARD.format(shard)).is_file():
            (units.folder / f"{unit_name(shard)}.json").unlink(missing_ok=True)
    opener = partial(open_room, replace(results), folder, request)
    objects = units.make(range(request.shards), open_executor(results, opener, TIMEOUT_S), progress)
    write_json(folder / DATASET_FILE, _describe(results, request, objects))
    return objects


def _scene_digest(results: Results) -> str:
    """Compute the digest of the scene, of its twin without an object, and of the first object, which places the others."""
    folder, first = results.folders["replacement"], results.asset_folder(0)
    files = [folder / "scene.json"]
    files += [folder / BACKGROUND_FOLDER / f"twin.{suffix}" for suffix in ("json", "npz")]
    files += [first / f"{FITTED}.{suffix}" for suffix in ("json", "npz")]
    return files_digest([file for file in files if file.is_file()])


def open_room(results: Results, folder: Path, request: ImageSetRequest) -> Callable[[int], dict[str, Any]]:
    """Return a worker function that renders a shard."""
    room = ImageRoom(results, request.size, request.seed)
    return lambda shard: write_shard(room, folder, request, shard)


def write_shard(room: ImageRoom, folder: Path, request: ImageSetRequest, shard: int) -> dict[str, Any]:
    """Render the images of a shard and write it; returns a description of its object."""
    asset, origin = request.open_object(shard)
    facts = {"asset": asset.name, "category": asset.category, **origin, "seed": request.seed, "shard": shard}
    rng = np.random.default_rng([request.seed, shard])
    # The last shard may be smaller.
    count = min(request.per_object, request.images - shard * request.per_object)
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for number, files in enumerate(room.render(asset, facts, count, rng)):
            key = f"{shard * request.per_object + number:08d}"
            for suffix, content in files.items():
                entry = tarfile.TarInfo(f"{key}.{suffix}")
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
    write_bytes(folder / SHARD.format(shard), data.getvalue())
    return {**facts, "images": count, "joint_type": asset.joint.type}


def read_shard(path: Path) -> Iterator[tuple[str, Mapping[str, bytes]]]:
    """Yield key and files by suffix of each image of a shard."""
    files: dict[str, bytes] = {}
    key = ""
    with tarfile.open(path) as tar:
        for entry in tar:
            found, _, suffix = entry.name.partition(".")
            if files and found != key:
                yield key, files
                files = {}
            key, content = found, tar.extractfile(entry)
            files[suffix] = content.read() if content else b""
    if files:
        yield key, files


def _describe(
    results: Results, request: ImageSetRequest, objects: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    cameras = [*results.episode_scene.cameras, *results.robot.cameras]
    return {
        "version": VERSION,
        "keypoints": list(KEYPOINTS),
        "labels": PART_LABELS,
        "cameras": cameras,
        "images": request.images,
        "images_per_shard": request.per_object,
        "size": list(request.size),
        "seed": request.seed,
        "categories": list(request.categories),
        "styles": list(request.styles),
        "shards": request.shards,
        "objects": list(objects),
    }
