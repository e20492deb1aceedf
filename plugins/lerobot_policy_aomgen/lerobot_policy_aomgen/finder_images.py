"""Reader of labeled images from `aomgen export --format images`, which are held in memory as JPEG."""

import io
import json
import tarfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from aomgen.core.keypoints import KEYPOINTS
from aomgen.core.transforms import apply, invert
from aomgen.core.values import Array
from aomgen.errors import ConfigError, MalformedFileError
from aomgen.exports.image_dataset import DATASET_FILE, read_shard
from aomgen.io.artifact import read_json

# Points of less than this depth are not in the image, [m].
NEAR_M: Final = 0.02
REMEDY: Final = "export it again with `aomgen export --format images`"


@dataclass(frozen=True, kw_only=True)
class LabelledImages:
    """Images of one size with the projections of the keypoints.

    Attributes:
        jpegs: N encoded images.
        cameras, assets: Names of camera and asset of each image.
        focal_px: Focal lengths fx and fy (N, 2), [px].
        points_px: Projected points (N, P, 2), x and y, pixel centers at +0.5, [px]; NaN for depths below `NEAR_M`.
        depths: Depths of the points (N, P), [m].
        visible: Whether each point is unoccluded (N, P).
        size: Width and height of the images, [px].
    """

    jpegs: tuple[bytes, ...]
    cameras: tuple[str, ...]
    assets: tuple[str, ...]
    focal_px: Array
    points_px: Array
    depths: Array
    visible: NDArray[np.bool_]
    size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.jpegs)

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Mask (N, P) of the points inside their image, visible or occluded."""
        return ((self.points_px >= 0) & (self.points_px < self.size)).all(-1)

    def __add__(self, other: "LabelledImages") -> "LabelledImages":
        """Return the images of both.

        Raises:
            ConfigError: They have different sizes.
        """
        if self.size != other.size:
            what = f"have {self.size} and {other.size} px"
            raise ConfigError("images", what, "export all of them with the same --size")
        return LabelledImages(
            jpegs=self.jpegs + other.jpegs,
            cameras=self.cameras + other.cameras,
            assets=self.assets + other.assets,
            focal_px=np.concatenate([self.focal_px, other.focal_px]),
            points_px=np.concatenate([self.points_px, other.points_px]),
            depths=np.concatenate([self.depths, other.depths]),
            visible=np.concatenate([self.visible, other.visible]),
            size=self.size,
        )

    def decode(self, rows: Sequence[int] | NDArray[np.int64]) -> NDArray[np.uint8]:
        """Decode the images (M, H, W, 3) uint8 of some rows."""
        return np.stack([np.asarray(Image.open(io.BytesIO(self.jpegs[row])).convert("RGB")) for row in rows])


def read_images(folder: Path, limit: int | None = None) -> LabelledImages:
    """Read a dataset of labeled images, or its first `limit` images.

    Raises:
        MissingFileError: There is no dataset.
        MalformedFileError: A shard is damaged, there are no images, or the labels are other points than `KEYPOINTS`.
    """
    described = read_json(folder / DATASET_FILE)
    if tuple(described.get("keypoints", ())) != KEYPOINTS:
        raise MalformedFileError(
            folder / DATASET_FILE, f"labels {described.get('keypoints')}, expected {KEYPOINTS}", REMEDY
        )
    jpegs, labels = list[bytes](), list[dict[str, Any]]()
    for shard in sorted(folder.glob("shard-*.tar")):
        if limit is not None and len(jpegs) >= limit:
            break
        try:
            for _, files in read_shard(shard):
                jpegs.append(files["jpg"])
                labels.append(json.loads(files["json"]))
        except (tarfile.TarError, KeyError, ValueError) as error:
            raise MalformedFileError(shard, f"is no shard of labelled images ({error})", REMEDY) from error
    if not jpegs:
        raise MalformedFileError(folder, "holds no images", REMEDY)
    jpegs, labels = jpegs[:limit], labels[:limit]
    K = np.array([label["K"] for label in labels])
    points_cam = np.stack(
        [apply(invert(np.array(label["T_world_cam"])), np.array(label["points_world"])) for label in labels]
    )
    depths = points_cam[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        projected = np.einsum("nij,npj->npi", K, points_cam)[..., :2] / depths[..., None]
    projected[depths < NEAR_M] = np.nan
    with Image.open(io.BytesIO(jpegs[0])) as first:
        size = first.size
    return LabelledImages(
        jpegs=tuple(jpegs),
        cameras=tuple(label["camera"] for label in labels),
        assets=tuple(label["asset"] for label in labels),
        focal_px=K[:, [0, 1], [0, 1]],
        points_px=projected,
        depths=depths,
        visible=np.array([label["visible"] for label in labels], bool),
        size=size,
    )
