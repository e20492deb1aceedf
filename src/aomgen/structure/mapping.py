"""COLMAP through pycolmap: features, matches and mapping in a scratch folder."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from aomgen.core.lens import Lens
from aomgen.core.recording import Intrinsics
from aomgen.core.transforms import invert
from aomgen.core.values import Array
from aomgen.errors import ReconstructionError
from aomgen.structure.sparse_model import Links, Pair, SparseModel, adjust, lens_of, read_model, set_camera

# SIFT contrast threshold; half of COLMAP's default, for plain surfaces.
PEAK_THRESHOLD = 0.0035
# Displacement by a lens from which on matches are verified again, [px]: twice the error that verified matches may have.
MAX_SHIFT_PX = 8.0


class Workspace:
    """A scratch folder with COLMAP's database, empty at the start; the only mutable object of this stage."""

    def __init__(self, folder: Path, seed: int, threads: int) -> None:
        self.folder, self.seed, self.threads = folder, seed, threads
        # By group of images: the file of each name, and the known intrinsics of the camera.
        self._files: dict[str, dict[str, str]] = {}
        self._focal_known: dict[str, bool] = {}
        self._lens_known: dict[str, bool] = {}
        self._model: pycolmap.Reconstruction | None = None
        pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
        pycolmap.set_random_seed(seed)
        (folder / "images").mkdir(parents=True)

    @property
    def database(self) -> Path:
        """COLMAP's database file."""
        return self.folder / "database.db"

    def extract(
        self,
        group: str,
        images: Iterable[tuple[str, NDArray[np.uint8]]],
        intrinsics: Intrinsics | None,
        max_features: int,
        first_octave: int = -1,
    ) -> None:
        """Write SIFT features of a group of images into the database; the group becomes one camera.

        Args:
            images: Pairs of name and (H, W, 3) uint8, all of one size.
            intrinsics: Known intrinsics, or None to estimate one focal length.
            max_features, first_octave: See `StructureParams`.

        Raises:
            ReconstructionError: The images differ in size.
        """
        files, sizes = {}, set()
        for index, (name, image) in enumerate(images):
            file = f"{len(self._files):02d}-{index:05d}.png"
            Image.fromarray(image).save(self.folder / "images" / file, compress_level=1)
            files[name] = file
            sizes.add(image.shape[1::-1])
        if len(sizes) != 1:
            raise ReconstructionError(
                group, f"has images of {len(sizes)} sizes", "use one camera and one size"
            )
        options = pycolmap.FeatureExtractionOptions(num_threads=self.threads)
        options.sift.max_num_features = max_features
        options.sift.peak_threshold = PEAK_THRESHOLD
        options.sift.first_octave = first_octave
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE")
        if intrinsics is not None:
            params = (
                intrinsics.fx,
                intrinsics.fy,
                intrinsics.cx,
                intrinsics.cy,
                *(intrinsics.distortion or ()),
            )
            reader.camera_model = "OPENCV" if intrinsics.distortion else "PINHOLE"
            reader.camera_params = ",".join(repr(float(value)) for value in params)
        pycolmap.extract_features(
            self.database,
            self.folder / "images",
            sorted(files.values()),
            pycolmap.CameraMode.SINGLE,
            reader,
            options,
        )
        self._files[group] = files
        self._focal_known[group] = intrinsics is not None
        self._lens_known[group] = intrinsics is not None and bool(intrinsics.distortion)

    def match(self, exhaustive_limit: int) -> None:
        """Match and verify pairs: all of them, or neighbours and a coarse grid for long scans."""
        groups = [sorted(files.values()) for files in self._files.values()]
        pairs = [(groups[0][i], groups[0][j]) for i, j in choose_pairs(len(groups[0]), exhaustive_limit)]
        pairs += [(still, scan) for group in groups[1:] for still in group for scan in groups[0]]
        self._listing.write_text("".join(f"{a} {b}\n" for a, b in pairs), "utf-8")
        pycolmap.match_image_pairs(
            self.database,
            pycolmap.FeatureMatchingOptions(num_threads=self.threads),
            pycolmap.ImportedPairingOptions(match_list_path=self._listing),
            self._verification(),
        )

    def set_lens(self, group: str, lens: Lens) -> bool:
        """Give a set's camera a known lens from now on.

        Returns: Whether all matches were verified again, because the distortion changed by more than the limit.
        """
        with pycolmap.Database.open(self.database) as database:
            camera = self._camera(database, group)
            again = abs(lens.largest_shift_px() - lens_of(camera).largest_shift_px()) > MAX_SHIFT_PX
            set_camera(camera, lens)
            camera.has_prior_focal_length = True
            database.update_camera(camera)
            if again:
                database.clear_two_view_geometries()
        self._focal_known[group] = self._lens_known[group] = True
        if again:
            pycolmap.verify_matches(self.database, self._listing, self._verification())
        return again

    def lens(self, group: str) -> Lens:
        """Return the optics with which a set's matches are verified."""
        with pycolmap.Database.open(self.database) as database:
            return lens_of(self._camera(database, group))

    def leave_out(self, group: str, names: set[str]) -> None:
        """Map a set without some of its images from now on."""
        self._files[group] = {name: file for name, file in self._files[group].items() if name not in names}

    def map(self, group: str) -> SparseModel | None:
        """Map one set incrementally; return the largest model, or None."""
        models = pycolmap.incremental_mapping(
            self.database, self.folder / "images", self.folder / "models", self._mapper_options(group)
        )
        return self._take_largest(models, group)

    def map_globally(self, group: str) -> SparseModel | None:
        """Map one set globally, first all rotations and then all positions; return the model, or None.

        Source: Pan et al., Global Structure-from-Motion Revisited (GLOMAP), 2024.
        """
        if not self._focal_known[group]:
            pycolmap.calibrate_view_graph(self.database)
        models = pycolmap.global_mapping(
            self.database, self.folder / "images", self.folder / "global", self._global_options(group)
        )
        for model in models.values():
            model.update_point_3d_errors()
        return self._take_largest(models, group)

    def _take_largest(self, models: dict[int, pycolmap.Reconstruction], group: str) -> SparseModel | None:
        if not models:
            return None
        self._model = max(models.values(), key=lambda model: model.num_reg_images())
        return self.read_model(group)

    @property
    def model(self) -> pycolmap.Reconstruction:
        """The current model.

        Raises:
            ReconstructionError: There is no mapped model yet.
        """
        if self._model is None:
            raise ReconstructionError("scan", "nothing was mapped yet", "map before using the model")
        return self._model

    def remap(self, mapped: SparseModel, bad: set[str]) -> SparseModel:
        """Remove some images from the model; triangulate the points and adjust the poses again."""
        model = self.model
        keep = [self._files["scan"][name] for name in mapped.Ts_recon_cam if name not in bad]
        for image in list(model.images.values()):
            if image.has_pose and image.name not in keep:
                model.deregister_frame(image.frame_id)
        self.triangulate(0.0)
        return self.read_model("scan")

    def place(self, group: str, Ts_recon_cam: dict[str, Array]) -> None:
        """Make a model of a set from known poses (4, 4) by image name, without points."""
        model = pycolmap.Reconstruction()
        files = {file: name for name, file in self._files[group].items()}
        with pycolmap.Database.open(self.database) as database:
            model.add_camera_with_trivial_rig(self._camera(database, group))
            for image in database.read_all_images():
                T_recon_cam = Ts_recon_cam.get(files.get(image.name, ""))
                if T_recon_cam is not None:
                    copy = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
                    cam_from_recon = pycolmap.Rigid3d(invert(T_recon_cam)[:3])
                    model.add_image_with_trivial_frame(copy, cam_from_recon)
        self._model = model

    def triangulate(self, pose_error_px: float) -> None:
        """Triangulate the points of the current model again, and adjust it.

        Args:
            pose_error_px: Reprojection error that inaccurate poses may add to the usual one, [px].
        """
        options = self._mapper_options("scan")
        options.mapper.filter_max_reproj_error += pose_error_px
        options.triangulation.complete_max_reproj_error += pose_error_px
        options.triangulation.merge_max_reproj_error += pose_error_px
        folders = self.folder / "images", self.folder / "remap"
        self._model = pycolmap.triangulate_points(self.model, self.database, *folders, True, options)
        adjust(self._model)

    def extend_model(self, group: str) -> SparseModel | None:
        """Register the images of a set that the current model lacks, incrementally."""
        if len(self.model.reg_image_ids()) == len(self._files[group]):
            return self.read_model(group)
        start = self.folder / "placed"
        start.mkdir(exist_ok=True)
        self.model.write(start)
        models = pycolmap.incremental_mapping(
            self.database,
            self.folder / "images",
            self.folder / "extended",
            self._mapper_options(group),
            input_path=start,
        )
        return self._take_largest(models, group)

    def pairs(self, group: str, lens: Lens) -> list[Pair]:
        """List every pair of a set that was matched, with its verified matches in undistorted pixels."""
        names = {file: name for name, file in self._files[group].items()}
        tried = [line.split() for line in self._listing.read_text("utf-8").splitlines()]
        result = []
        with pycolmap.Database.open(self.database) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            pixels = {file: lens.undistort(_pixels(database, ids[file])) for file in names}
            for a, b in tried:
                if a not in names or b not in names:
                    continue
                matches = np.zeros((0, 2), np.int64)
                if database.exists_two_view_geometry(ids[a], ids[b]):
                    matches = database.read_two_view_geometry(ids[a], ids[b]).inlier_matches
                result.append(
                    Pair(
                        a=names[a],
                        b=names[b],
                        pixels_a=pixels[a][matches[:, 0]],
                        pixels_b=pixels[b][matches[:, 1]],
                    )
                )
        return result

    def links(self, group: str, stills: tuple[str, ...], mapped: SparseModel) -> Links:
        """Match the stills of one camera to points of the scan; the pixels are those of the recorded images."""
        pixels: list[Array] = [np.zeros((0, 2))]
        points: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
        with pycolmap.Database.open(self.database) as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            for still in stills:
                own = ids[self._files[group][still]]
                pairs: list[NDArray[np.int64]] = [np.zeros((0, 2), np.int64)]
                for name, point_of_feature in mapped.point_of_feature.items():
                    other = ids[self._files["scan"][name]]
                    if database.exists_two_view_geometry(own, other):
                        matches = database.read_two_view_geometry(own, other).inlier_matches.astype(np.int64)
                        pairs.append(np.stack([matches[:, 0], point_of_feature[matches[:, 1]]], 1))
                known = np.concatenate(pairs)
                known = np.unique(known[known[:, 1] >= 0], axis=0)
                pixels.append(_pixels(database, own)[known[:, 0]])
                points.append(known[:, 1])
        return Links(pixels=np.concatenate(pixels), points_recon=mapped.points_recon[np.concatenate(points)])

    def _mapper_options(self, group: str) -> pycolmap.IncrementalPipelineOptions:
        options = pycolmap.IncrementalPipelineOptions(num_threads=self.threads, random_seed=self.seed)
        options.mapper.random_seed = self.seed
        options.mapper.num_threads = self.threads
        options.triangulation.random_seed = self.seed
        options.image_names = sorted(self._files[group].values())
        options.multiple_models = False
        options.ba_refine_focal_length = not self._focal_known[group]
        # A pinhole camera has no distortion parameters to refine.
        options.ba_refine_extra_params = not self._lens_known[group]
        # One image alone does not determine the camera that all of them share.
        options.mapper.abs_pose_refine_focal_length = not self._focal_known[group]
        options.mapper.abs_pose_refine_extra_params = False
        return options

    def _global_options(self, group: str) -> pycolmap.GlobalPipelineOptions:
        options = pycolmap.GlobalPipelineOptions(num_threads=self.threads, random_seed=self.seed)
        options.image_names = sorted(self._files[group].values())
        options.multiple_models = False
        mapper = options.mapper
        for part in (mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
            part.random_seed = self.seed
        mapper.num_threads = self.threads
        mapper.global_positioning.use_gpu = False
        mapper.bundle_adjustment.ceres.use_gpu = False
        mapper.bundle_adjustment.refine_focal_length = not self._focal_known[group]
        mapper.bundle_adjustment.refine_extra_params = not self._lens_known[group]
        return options

    def _camera(self, database: pycolmap.Database, group: str) -> pycolmap.Camera:
        files = set(self._files[group].values())
        camera_ids = {image.camera_id for image in database.read_all_images() if image.name in files}
        return database.read_camera(camera_ids.pop())

    def _verification(self) -> pycolmap.TwoViewGeometryOptions:
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = self.seed
        return verification

    @property
    def _listing(self) -> Path:
        return self.folder / "pairs.txt"

    def read_model(self, group: str) -> SparseModel:
        """Return the model of a set as values."""
        return read_model(self.model, {file: name for name, file in self._files[group].items()})


def _pixels(database: pycolmap.Database, image_id: int) -> Array:
    return np.asarray(database.read_keypoints(image_id), np.float64)[:, :2]


def choose_pairs(count: int, exhaustive_limit: int) -> list[tuple[int, int]]:
    """Choose pairs (i, j), i < j, of `count` images in recording order.

    These are all pairs up to `exhaustive_limit` images. Beyond it, each image is paired with its ten successors,
    with those at power-of-two distances, and with every image of a coarse grid that closes loops.
    """
    if count <= exhaustive_limit:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    grid = set(range(0, count, max(1, count // 24)))
    steps = set(range(1, 11)) | {1 << k for k in range(4, 12)}
    pairs = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    pairs |= {(min(i, g), max(i, g)) for i in range(count) for g in grid if i != g}
    return sorted(pairs)
