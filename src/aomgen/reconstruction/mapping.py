"""COLMAP through pycolmap: features, matches and incremental mapping in a scratch folder."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from aomgen.core.transforms import invert
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.reconstruction.consistency import Pair
from aomgen.reconstruction.resection import Links


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageSet:
    """Images of one camera.

    Attributes:
        group: Name of the set.
        images: Pairs of name and (H, W, 3) uint8, all of one size.
        intrinsics: [fx, fy, cx, cy] in px, or None to estimate one focal length.
    """

    group: str
    images: Iterator[tuple[str, NDArray[np.uint8]]]
    intrinsics: tuple[float, float, float, float] | None


@dataclass(frozen=True, kw_only=True)
class Mapped:
    """A model as the mapper left it.

    Attributes:
        Ts_recon_cam: Pose (4, 4) by image name.
        K: Intrinsics (3, 3) of the scan camera, [px].
        points_recon: (P, 3).
        colors_srgb: (P, 3) uint8.
        observations: (point index, image name).
        point_of_feature: For each image, point index of each feature (F,), -1 = none.
        error_px: Mean reprojection error.
    """

    Ts_recon_cam: dict[str, Array]
    K: Array
    points_recon: Array
    colors_srgb: NDArray[np.uint8]
    observations: list[tuple[int, str]]
    point_of_feature: dict[str, NDArray[np.int64]]
    error_px: float


@dataclass(kw_only=True)
class Workspace:
    """A scratch folder with COLMAP's database; the only mutable thing of this stage.

    Attributes:
        folder: Scratch folder, empty at the start.
        seed: Of RANSAC and of the mapper.
        threads: -1 = all cores.
    """

    folder: Path
    seed: int
    threads: int = -1
    _files: dict[str, dict[str, str]] = field(default_factory=dict)
    _known: dict[str, bool] = field(default_factory=dict)
    _model: pycolmap.Reconstruction | None = None

    def __post_init__(self) -> None:
        pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
        pycolmap.set_random_seed(self.seed)
        (self.folder / "images").mkdir(parents=True)

    @property
    def database(self) -> Path:
        """COLMAP's database file."""
        return self.folder / "database.db"

    def extract(self, images: ImageSet, max_features: int, peak_threshold: float) -> None:
        """Write SIFT features of a set into the database; the set becomes one camera.

        Raises:
            ReconstructionError: The images differ in size.
        """
        files, sizes = {}, set()
        for index, (name, image) in enumerate(images.images):
            file = f"{len(self._files):02d}-{index:05d}.png"
            Image.fromarray(image).save(self.folder / "images" / file, compress_level=1)
            files[name] = file
            sizes.add(image.shape[1::-1])
        if len(sizes) != 1:
            raise ReconstructionError(
                images.group, f"has images of {len(sizes)} sizes", "use one camera and one size"
            )
        options = pycolmap.FeatureExtractionOptions(num_threads=self.threads)
        options.sift.max_num_features = max_features
        options.sift.peak_threshold = peak_threshold
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE")
        if images.intrinsics is not None:
            reader.camera_model = "PINHOLE"
            reader.camera_params = ",".join(repr(float(value)) for value in images.intrinsics)
        pycolmap.extract_features(
            self.database,
            self.folder / "images",
            sorted(files.values()),
            pycolmap.CameraMode.SINGLE,
            reader,
            options,
        )
        self._files[images.group] = files
        self._known[images.group] = images.intrinsics is not None

    def match(self, exhaustive_limit: int) -> None:
        """Match and verify pairs: all of them, or neighbours and a coarse grid for long scans."""
        groups = [sorted(files.values()) for files in self._files.values()]
        pairs = [(groups[0][i], groups[0][j]) for i, j in choose_pairs(len(groups[0]), exhaustive_limit)]
        pairs += [(still, scan) for group in groups[1:] for still in group for scan in groups[0]]
        listing = self.folder / "pairs.txt"
        listing.write_text("".join(f"{a} {b}\n" for a, b in pairs), "utf-8")
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = self.seed
        pycolmap.match_image_pairs(
            self.database,
            pycolmap.FeatureMatchingOptions(num_threads=self.threads),
            pycolmap.ImportedPairingOptions(match_list_path=listing),
            verification,
        )

    def map(self, group: str) -> Mapped | None:
        """Incremental mapping of one set; the largest model, or None."""
        models = pycolmap.incremental_mapping(
            self.database, self.folder / "images", self.folder / "models", self._mapper_options(group)
        )
        if not models:
            return None
        self._model = max(models.values(), key=lambda model: model.num_reg_images())
        return self._mapped(group)

    def remap(self, mapped: Mapped, bad: set[str]) -> Mapped:
        """The model without some images: points triangulated again, poses adjusted again."""
        model = self._require_model()
        keep = [self._files["scan"][name] for name in mapped.Ts_recon_cam if name not in bad]
        for image in list(model.images.values()):
            if image.has_pose and image.name not in keep:
                model.deregister_frame(image.frame_id)
        options = self._mapper_options("scan")
        self._model = pycolmap.triangulate_points(
            model, self.database, self.folder / "images", self.folder / "remap", True, options
        )
        adjust = pycolmap.BundleAdjustmentOptions(print_summary=False)
        adjust.refine_focal_length = not self._known["scan"]
        adjust.refine_extra_params = False
        pycolmap.bundle_adjustment(self._model, adjust)
        self._model.update_point_3d_errors()
        return self._mapped("scan")

    def pairs(self, group: str) -> list[Pair]:
        """Verified matches between the images of a set, as pixels."""
        names = {file: name for name, file in self._files[group].items()}
        with pycolmap.Database.open(self.database) as database:
            images = {image.image_id: image.name for image in database.read_all_images()}
            pixels = {i: _pixels(database, i) for i, file in images.items() if file in names}
            result = []
            ids, geometries = database.read_two_view_geometries()
            for pair_id, geometry in zip(ids, geometries, strict=True):
                a, b = pycolmap.pair_id_to_image_pair(pair_id)
                matches = geometry.inlier_matches
                if a in pixels and b in pixels and len(matches):
                    result.append(
                        Pair(
                            a=names[images[a]],
                            b=names[images[b]],
                            pixels_a=pixels[a][matches[:, 0]],
                            pixels_b=pixels[b][matches[:, 1]],
                        )
                    )
        return result

    def links(self, group: str, still: str, mapped: Mapped) -> Links:
        """Pixels of a still and the scan's points they were matched to."""
        file = self._files[group][still]
        features, points = [], []
        with pycolmap.Database.open(self.database) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            pixels = _pixels(database, ids[file])
            for name, point_of_feature in mapped.point_of_feature.items():
                other = ids[self._files["scan"][name]]
                if not database.exists_two_view_geometry(ids[file], other):
                    continue
                matches = database.read_two_view_geometry(ids[file], other).inlier_matches
                if len(matches):
                    features.append(matches[:, 0])
                    points.append(point_of_feature[matches[:, 1]])
        feature = np.concatenate(features) if features else np.zeros(0, np.int64)
        point = np.concatenate(points) if points else np.zeros(0, np.int64)
        pairs = np.unique(np.stack([feature, point], 1)[point >= 0].astype(np.int64), axis=0)
        return Links(pixels=pixels[pairs[:, 0]], points_recon=mapped.points_recon[pairs[:, 1]])

    def _mapper_options(self, group: str) -> pycolmap.IncrementalPipelineOptions:
        options = pycolmap.IncrementalPipelineOptions(num_threads=self.threads, random_seed=self.seed)
        options.mapper.random_seed = self.seed
        options.mapper.num_threads = self.threads
        options.triangulation.random_seed = self.seed
        options.image_names = sorted(self._files[group].values())
        options.multiple_models = False
        options.ba_refine_focal_length = not self._known[group]
        options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = not self._known[group]
        options.mapper.abs_pose_refine_extra_params = False
        return options

    def _require_model(self) -> pycolmap.Reconstruction:
        if self._model is None:
            raise ReconstructionError("scan", "nothing was mapped yet", "map before changing the model")
        return self._model

    def _mapped(self, group: str) -> Mapped:
        model = self._require_model()
        names = {file: name for name, file in self._files[group].items()}
        rows = {point_id: row for row, point_id in enumerate(sorted(model.points3D))}
        points = [model.points3D[point_id] for point_id in sorted(model.points3D)]
        poses, features, observations = {}, {}, []
        for image in sorted(model.images.values(), key=lambda image: image.name):
            if not image.has_pose:
                continue
            name = names[image.name]
            T_cam_recon = np.eye(4)
            T_cam_recon[:3] = image.cam_from_world().matrix()
            poses[name] = invert(T_cam_recon)
            point_of = [rows[p.point3D_id] if p.has_point3D() else -1 for p in image.points2D]
            features[name] = np.array(point_of, np.int64)
            observations += [(row, name) for row in sorted({row for row in point_of if row >= 0})]
        camera = next(iter(model.cameras.values()))
        return Mapped(
            Ts_recon_cam=poses,
            K=np.asarray(camera.calibration_matrix(), np.float64),
            points_recon=np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
            colors_srgb=np.array([p.color for p in points], np.uint8).reshape(-1, 3),
            observations=observations,
            point_of_feature=features,
            error_px=float(model.compute_mean_reprojection_error()),
        )


def _pixels(database: pycolmap.Database, image_id: int) -> Array:
    return np.asarray(database.read_keypoints(image_id), np.float64)[:, :2]


def choose_pairs(count: int, exhaustive_limit: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of `count` images in recording order.

    All of them up to `exhaustive_limit` images; beyond, each image meets its ten successors,
    those at power-of-two distances, and every image of a coarse grid that closes loops.
    """
    if count <= exhaustive_limit:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    grid = set(range(0, count, max(1, count // 24)))
    steps = set(range(1, 11)) | {1 << k for k in range(4, 12)}
    pairs = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    pairs |= {(min(i, g), max(i, g)) for i in range(count) for g in grid if i != g}
    return sorted(pairs)
