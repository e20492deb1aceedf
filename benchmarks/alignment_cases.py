"""Good and bad starts for the alignment: one finished structure with known disturbances."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter

from aomgen.alignment.contours import AlignmentImage
from aomgen.alignment.starting_poses import RobotBox
from aomgen.alignment.uncertainty import CameraErrors
from aomgen.core.camera import Camera, camera_in_world
from aomgen.core.transforms import apply, matrix_from_rotvec, similarity, similarity_parts
from aomgen.core.values import Array
from aomgen.robots.robot import RobotConfiguration
from aomgen.robots.silhouette import SilhouetteRenderer
from benchmarks.alignment_solvable import is_solvable

SCALES = (0.05, 20.0)
# Kinds without a solution, by their difference from a solvable case.
UNSOLVABLE = ("absent", "elsewhere", "joints", "mirrored")
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A structure with its images, and the true solution.

    Attributes:
        name: Name of the capture.
        views: Images for the alignment.
        robot_boxes, other_boxes: Prompted boxes on the robot, and on the object's parts.
        points_recon: Sparse points (P, 3).
        configuration: The robot during the scan.
        S_world_recon: The true similarity (4, 4).
        errors: Standard deviations that the structure reports for its cameras.
    """

    name: str
    views: list[AlignmentImage]
    robot_boxes: list[RobotBox]
    other_boxes: list[RobotBox]
    points_recon: Array
    configuration: RobotConfiguration
    S_world_recon: Array
    errors: CameraErrors | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One start: a disturbed scene, and the disturbances.

    Attributes:
        kind: "solvable" or one of `UNSOLVABLE`.
        done: The disturbances in words.
        scene: Input of the alignment; `S_world_recon` is the solution where there is one.
    """

    kind: str
    done: tuple[str, ...]
    scene: Scene


def make_case(scene: Scene, bare: Scene, kind: str, rng: np.random.Generator) -> Case:
    """Make a case of one kind: a random similarity of the recon frame, and the disturbances of the kind.

    Args:
        scene: Scene with the robot.
        bare: The same scene from `without_robot`.
        kind: "solvable" or one of `UNSOLVABLE`.
        rng: Chooses the disturbances.
    """
    done: list[str] = []
    if kind == "absent":
        scene = bare
    elif kind == "elsewhere":
        scene = replace(bare, robot_boxes=scene.other_boxes)
    elif kind == "mirrored":
        scene = mirrored(scene)
    elif kind == "joints":
        scene, said = _wrong_joints(scene, rng)
        done.append(said)
    elif kind == "solvable":
        scene, said = _solvable(scene, rng)
        done += said
    scale = float(np.exp(rng.uniform(*np.log(SCALES))))
    scene = resimilated(scene, scale, matrix_from_rotvec(_direction(rng) * rng.uniform(0, np.pi)), rng)
    return Case(kind=kind, done=(*done, f"scale {scale:.2g}"), scene=scene)


def resimilated(scene: Scene, scale: float, R: Array, rng: np.random.Generator) -> Scene:
    """Transform the scene to another recon frame."""
    S_new_recon = similarity(scale, R, scale * rng.normal(0, 3, 3))
    return replace(
        scene,
        views=[_moved_view(view, S_new_recon) for view in scene.views],
        robot_boxes=[_moved_box(box, S_new_recon) for box in scene.robot_boxes],
        other_boxes=[_moved_box(box, S_new_recon) for box in scene.other_boxes],
        points_recon=apply(S_new_recon, scene.points_recon),
        S_world_recon=scene.S_world_recon @ np.linalg.inv(S_new_recon),
        errors=scene.errors and scene.errors.view_from(S_new_recon),
    )


def without_robot(scene: Scene) -> Scene:
    """Replace the robot in the images by its surroundings."""
    with _renderer(scene) as renderer:
        views = [
            replace(view, image_srgb=_painted_over(view.image_srgb, _robot_mask(scene, view, renderer)))
            for view in scene.views
        ]
    return replace(scene, views=views)


def mirrored(scene: Scene) -> Scene:
    """Mirror the whole scene: it is consistent in itself, but no robot is built that way."""
    views = [
        replace(
            view,
            image_srgb=np.ascontiguousarray(view.image_srgb[:, ::-1]),
            camera_recon=_mirrored_camera(view.camera_recon),
        )
        for view in scene.views
    ]
    return replace(
        scene,
        views=views,
        robot_boxes=[_mirrored_box(box) for box in scene.robot_boxes],
        other_boxes=[_mirrored_box(box) for box in scene.other_boxes],
        points_recon=scene.points_recon * [-1.0, 1.0, 1.0],
    )


def _solvable(scene: Scene, rng: np.random.Generator) -> tuple[Scene, list[str]]:
    """Apply half of all disturbances, drawn again until the scene still `is_solvable`."""
    while True:
        disturbed, done = scene, []
        for name, disturb in _DISTURBANCES.items():
            if rng.random() < 0.5:
                disturbed = disturb(disturbed, rng)
                done.append(name)
        if is_solvable(
            disturbed.views, disturbed.robot_boxes, disturbed.configuration, disturbed.S_world_recon
        ):
            return disturbed, done


def _wrong_joints(scene: Scene, rng: np.random.Generator) -> tuple[Scene, str]:
    """Change one to three joints by 10 to 40 degrees.

    The first joint is not changed: it only rotates the arm relative to its round base, which is
    equivalent to a rotation of the world.
    """
    joints = scene.configuration.joints.copy()
    chosen = rng.choice(np.arange(1, len(joints)), int(rng.integers(1, 4)), replace=False)
    offsets_deg = rng.uniform(10, 40, len(chosen)) * rng.choice([-1, 1], len(chosen))
    joints[chosen] += np.radians(offsets_deg)
    said = " ".join(f"q{j}{angle:+.0f}" for j, angle in sorted(zip(chosen, offsets_deg, strict=True)))
    return replace(scene, configuration=replace(scene.configuration, joints=joints)), said


def _disturb_boxes(scene: Scene, rng: np.random.Generator) -> Scene:
    """Move sides by 10 to 20 % of the box's size: larger, smaller or shifted boxes."""
    boxes = []
    for box in scene.robot_boxes:
        size = np.tile(box.box_px[2:] - box.box_px[:2], 2)
        share = rng.uniform(0.1, 0.2)
        signs = {
            "grow": [-1, -1, 1, 1],
            "shrink": [1, 1, -1, -1],
            "shift": np.tile(rng.choice([-1, 1], 2), 2),
        }
        moved = box.box_px + share * size * np.array(signs[str(rng.choice(list(signs)))]) / 2
        limits = np.tile([box.camera_recon.width, box.camera_recon.height], 2)
        boxes.append(replace(box, box_px=np.clip(moved, 0, limits)))
    return replace(scene, robot_boxes=boxes)


def _remove_box(scene: Scene, rng: np.random.Generator) -> Scene:
    if len(scene.robot_boxes) < 2:
        return scene
    kept = int(rng.integers(len(scene.robot_boxes)))
    return replace(scene, robot_boxes=[scene.robot_boxes[kept]])


def _cut_images(scene: Scene, rng: np.random.Generator) -> Scene:
    """Cut a strip off images with boxes, so that the border removes a tenth to a quarter of the robot."""
    centers = {tuple(view.camera_recon.center): index for index, view in enumerate(scene.views)}
    views, boxes = list(scene.views), []
    for box in scene.robot_boxes:
        x0, y0, x1, y1 = box.box_px
        left = bool(rng.random() < 0.5)
        strip = rng.uniform(0.1, 0.25) * (x1 - x0)
        low = int(x0 + strip) if left else 0
        high = box.camera_recon.width if left else int(x1 - strip)
        camera = replace(box.camera_recon, cx=box.camera_recon.cx - low, width=high - low)
        index = centers.get(tuple(box.camera_recon.center))
        if index is not None:
            image = np.ascontiguousarray(views[index].image_srgb[:, low:high])
            views[index] = replace(views[index], image_srgb=image, camera_recon=camera)
        cut = np.array([max(x0, low) - low, y0, min(x1, high) - low, y1])
        boxes.append(replace(box, box_px=cut, camera_recon=camera))
    return replace(scene, views=views, robot_boxes=boxes)


def _shake_cameras(scene: Scene, rng: np.random.Generator) -> Scene:
    """Displace every camera by about 2 mm and 0.05 degrees, in addition to the structure's own errors."""
    scale, _, _ = similarity_parts(scene.S_world_recon)
    shaken: dict[bytes, Camera] = {}

    def shake(camera: Camera) -> Camera:
        key = camera.T_world_cam.tobytes()
        if key not in shaken:
            T = camera.T_world_cam.copy()
            T[:3, :3] = matrix_from_rotvec(rng.normal(0, np.radians(0.05), 3)) @ T[:3, :3]
            T[:3, 3] += rng.normal(0, 0.0012 / scale, 3)
            shaken[key] = camera.move(T)
        return camera.move(shaken[key].T_world_cam)

    return replace(
        scene,
        views=[replace(view, camera_recon=shake(view.camera_recon)) for view in scene.views],
        robot_boxes=[replace(box, camera_recon=shake(box.camera_recon)) for box in scene.robot_boxes],
    )


def _fewer_views(scene: Scene, rng: np.random.Generator) -> Scene:
    """Keep a third to two thirds of the images, in order."""
    count = int(len(scene.views) * rng.uniform(1 / 3, 2 / 3))
    kept = np.sort(rng.choice(len(scene.views), max(8, count), replace=False))
    return replace(scene, views=[scene.views[index] for index in kept])


_DISTURBANCES = {
    "boxes off": _disturb_boxes,
    "one box": _remove_box,
    "cut images": _cut_images,
    "shaken cameras": _shake_cameras,
    "fewer views": _fewer_views,
}


def _renderer(scene: Scene) -> SilhouetteRenderer:
    width = max(view.camera_recon.width for view in scene.views)
    height = max(view.camera_recon.height for view in scene.views)
    return SilhouetteRenderer(scene.configuration.robot, max_width=width, max_height=height)


def _robot_mask(scene: Scene, view: AlignmentImage, renderer: SilhouetteRenderer) -> NDArray[np.bool_]:
    """Render the pixels (H, W) of the robot at its true pose, with a margin."""
    camera = camera_in_world(scene.S_world_recon, view.camera_recon)
    bodies, _ = renderer.draw(camera, scene.configuration.joints, scene.configuration.gripper)
    return binary_dilation(bodies >= 0, iterations=max(3, round(0.012 * camera.width)))


def _painted_over(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Fill masked pixels with the nearest unmasked ones, smoothed."""
    if not mask.any() or mask.all():
        return image
    nearest = np.empty((2, *mask.shape), np.int32)
    distance_transform_edt(mask, return_distances=False, return_indices=True, indices=nearest)
    filled = image[nearest[0], nearest[1]].astype(np.float32)
    soft = gaussian_filter(filled, (6, 6, 0))
    return np.where(mask[..., None], soft, image).round().astype(np.uint8)


def _moved_view(view: AlignmentImage, S_new_recon: Array) -> AlignmentImage:
    return replace(view, camera_recon=camera_in_world(S_new_recon, view.camera_recon))


def _moved_box(box: RobotBox, S_new_recon: Array) -> RobotBox:
    return replace(box, camera_recon=camera_in_world(S_new_recon, box.camera_recon))


def _mirrored_camera(camera: Camera) -> Camera:
    return replace(camera, cx=camera.width - camera.cx, T_world_cam=MIRROR @ camera.T_world_cam @ MIRROR)


def _mirrored_box(box: RobotBox) -> RobotBox:
    x0, y0, x1, y1 = box.box_px
    width = box.camera_recon.width
    return replace(
        box,
        box_px=np.array([width - x1, y0, width - x0, y1]),
        camera_recon=_mirrored_camera(box.camera_recon),
    )


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
