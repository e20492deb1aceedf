"""Loading of robots, by their robot.toml or by a proposal of it, as one model for kinematics and physics.

Robots are also stored with results, so that the results can be used without the capture.
"""

import functools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.recording import RobotChoice
from aomgen.core.transforms import apply, matrix_from_quat, transform
from aomgen.errors import ConfigError, MalformedFileError
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.io.atomic import write_bytes, write_text
from aomgen.io.geom_surface import find_colliding_geoms
from aomgen.io.mujoco_model import compile_model
from aomgen.io.paths import resolve_inside
from aomgen.robots.actuation import add_actuation, drop_visual, sort_shapes
from aomgen.robots.description import (
    FILE_NAME,
    ActuatorSection,
    EndEffectorSection,
    MountSection,
    PadSection,
    RobotDescription,
    RobotFiles,
    description_toml,
    find_description,
    find_known_description,
    read_description,
    read_models,
)
from aomgen.robots.gripper import MIN_TRAVEL_M, GripperTable, no_fingers, settle_fingers
from aomgen.robots.propose import propose_description
from aomgen.robots.reading import ancestors, arm_chain, read_finished_spec, read_robot_spec
from aomgen.robots.robot import FingerPad, HandDrive, RobotModel, body_poses, site_poses, visual_meshes

HEADER = "robot"
FILES = "robot"
GRASP_SITE = "grasp_point"
# Smallest cosine of the angle between the end effector's y axis and the line from the left to the right pad (25 degrees).
MIN_COSINE = 0.9


def load_robot(
    model: str | Path,
    base_frame: str = "base_link",
    *,
    joints: Sequence[str] = (),
    root: Path | None = None,
) -> RobotModel:
    """Load a robot known by name, or a URDF or MJCF file.

    The roles of its parts are read from the robot.toml in the folder of the file; without this file they are estimated.

    Args:
        model: Name such as "ur5e_2f85", or path of a file.
        base_frame: World frame: "base_link", or "ur_base", which is rotated by 180 degrees about z.
        joints: Arm joints in the requested order; empty keeps the order of the description.
        root: Folder that the references of the file must not leave; None uses the folder of the file.

    Raises:
        ConfigError: A name, base frame or joint is unknown, or the package with the model is missing.
        InputError: A file is missing, malformed or otherwise cannot be used.

    Example:
        >>> robot = ag.load_robot("ur5e_2f85")
        >>> robot.ee_poses(np.zeros((1, 6))).shape
        (1, 4, 4)
    """
    if base_frame not in ("base_link", "ur_base"):
        raise ConfigError("robot.base_frame", f"'{base_frame}' is unknown", "use base_link or ur_base")
    if isinstance(model, str) and not Path(model).suffix:
        return _load_known(model, tuple(joints), turned=base_frame == "ur_base")
    file = Path(model)
    root = root or file.parent
    described = find_description(file)
    path = described or file.parent / FILE_NAME
    description = read_description(path) if described else propose_description(file, root, joints)
    return _load_described(description, joints, path, root, turned=base_frame == "ur_base")


# Loading takes seconds, and a process uses few robots.
@functools.lru_cache(maxsize=4)
def _load_known(name: str, joints: tuple[str, ...], *, turned: bool) -> RobotModel:
    path = find_known_description(name)
    return _load_described(read_description(path), joints, path, path.parent, turned=turned)


def _load_described(
    description: RobotDescription, joints: Sequence[str], path: Path, root: Path, *, turned: bool
) -> RobotModel:
    """Check the names of the requested joints, and assemble the model."""
    if joints and sorted(joints) != sorted(description.joints):
        raise ConfigError(
            "robot.joints",
            f"do not name the joints of {description.name}",
            f"list these: {', '.join(description.joints)}",
        )
    return _assemble(
        description.model_copy(update={"joints": tuple(joints) or description.joints}),
        read_models(description, path, root),
        path,
        turned=turned,
    )


def choose_robot(choice: RobotChoice) -> RobotModel:
    """Load the robot of a capture, in the world frame and joint order of the capture; raises the errors of `load_robot`."""
    model = choice.model_file or choice.model
    return load_robot(model, choice.base_frame, joints=choice.joints, root=choice.root)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredRobot:
    """A robot that is stored with results.

    Attributes:
        model: Name of a known robot; not used if `file` is given.
        file: Model file relative to the folder of the results; empty for a known robot.
        base_frame: World frame; see `load_robot`.
        joints: Arm joints in the order of the joint log.
    """

    model: str
    file: str
    base_frame: str
    joints: tuple[str, ...]


def save_robot(folder: Path, choice: RobotChoice) -> None:
    """Store the robot of a capture in an existing folder: its name, or its files and robot.toml.

    Raises:
        InputError: A file of the robot cannot be used.
        StorageError: Writing to the disk failed.
    """
    file = ""
    if choice.model_file:
        copied = copy_robot_files(choice.model_file, choice.references, folder / FILES)
        file = copied.relative_to(folder).as_posix()
        if find_description(choice.model_file) is None:
            guess = propose_description(choice.model_file, choice.root, choice.joints)
            write_text(copied.parent / FILE_NAME, description_toml(guess))
    stored = StoredRobot(model=choice.model, file=file, base_frame=choice.base_frame, joints=choice.joints)
    save_artifact(folder, HEADER, stored)


def load_stored_robot(folder: Path) -> RobotModel:
    """Load the robot that `save_robot` stored in a folder.

    Raises:
        ConfigError: The package with the model of a known robot is missing.
        InputError: A file is missing or damaged.
    """
    stored = load_artifact(folder, HEADER, StoredRobot)
    model = stored.model
    if stored.file:
        model = resolve_inside(folder, stored.file, named_by=folder / f"{HEADER}.json")
    return load_robot(model, stored.base_frame, joints=stored.joints, root=(folder / FILES).resolve())


def copy_robot_files(model_file: Path, references: tuple[Path, ...], folder: Path) -> Path:
    """Copy a URDF or MJCF and all files that it refers to, with their relative locations; return the copied model file."""
    files = [model_file.resolve(), *(file.resolve() for file in references)]
    top = Path(os.path.commonpath([file.parent for file in files]))
    for file in files:
        write_bytes(folder / file.relative_to(top), file.read_bytes())
    return folder / files[0].relative_to(top)


def _assemble(description: RobotDescription, files: RobotFiles, path: Path, *, turned: bool) -> RobotModel:
    gripper = description.gripper
    own = gripper.actuator if gripper is not None else None
    spec, bare = (
        read_finished_spec(files, turned=turned) if own else read_robot_spec(files, turned=turned)[0]
        for _ in range(2)
    )
    model = compile_model(spec, files.arm.path)
    chain = arm_chain(model, description.joints, files.arm.path)
    _check_names(description, model, path)
    ee_site = description.end_effector.site
    for item in (spec, bare):
        if own is None:
            sort_shapes(item, model)
        if not description.end_effector.site:
            ee_site = _add_end_effector(item, description.end_effector)
    drop_visual(bare)
    table, pads, way_m = no_fingers(), (), 0.0
    pad_geoms: dict[str, tuple[str, ...]] = {}
    if gripper is not None:
        table = settle_fingers(bare, chain, gripper.strokes, path)
        pads = tuple(_finger_pad(model, side, pad) for side, pad in gripper.pads.items())
        pad_geoms = {pad.finger: _colliders(model, pad.body + 1) for pad in pads}
        way_m = _closing_way(compile_model(bare.copy(), path), ee_site, table, pads, path)
    actuator = own
    if own is None:
        actuator = add_actuation((spec, bare), chain, ee_site, gripper, way_m, path)
        pad_geoms = {side: (f"pad_{side}", *geoms) for side, geoms in pad_geoms.items()}
    compiled = compile_model(spec.copy(), path)
    joints = [compiled.joint(name) for name in chain.joints]
    return RobotModel(
        name=description.name,
        joint_names=chain.joints,
        body_names=tuple(compiled.body(b).name for b in range(1, compiled.nbody)),
        joint_limits=np.array([item.range if item.limited[0] else (-np.inf, np.inf) for item in joints]),
        slides=np.array([int(item.type[0]) == mujoco.mjtJoint.mjJNT_SLIDE for item in joints]),
        gripper_table=table,
        meshes=visual_meshes(compiled),
        pads=pads,
        pad_geoms=pad_geoms,
        drive=None if gripper is None or actuator is None else _hand_drive(gripper.strokes, actuator),
        hand_bodies=tuple(compiled.body(b).name for b in chain.hand_bodies),
        ee_site=ee_site,
        cameras={item.name: _robot_camera(model, item) for item in description.camera},
        _model=compiled,
        _full=spec,
        _bare=bare,
    )


def _check_names(description: RobotDescription, model: mujoco.MjModel, path: Path) -> None:
    """Check that the model has the bodies, joints, sites and actuators of the description."""
    end, gripper = description.end_effector, description.gripper
    wanted = [("site", end.site, "end_effector.site"), ("body", end.body, "end_effector.body")]
    wanted += [("body", camera.body, "camera.body") for camera in description.camera]
    if gripper is not None:
        wanted += [("body", pad.body, f"gripper.{side}.body") for side, pad in gripper.pads.items()]
        wanted += [("joint", name, "gripper.open") for name in gripper.open]
        if gripper.actuator is not None:
            wanted.append(("actuator", gripper.actuator.name, "gripper.actuator.name"))
    counts = {"site": model.nsite, "body": model.nbody, "joint": model.njnt, "actuator": model.nu}
    for kind, name, key in wanted:
        known = [getattr(model, kind)(number).name for number in range(counts[kind])]
        if name and name not in known:
            raise MalformedFileError(
                path,
                f"names {kind} '{name}' as {key}, which the model does not have",
                f"known: {', '.join(known) or 'none'}",
            )


def _add_end_effector(spec: mujoco.MjSpec, end: EndEffectorSection) -> str:
    name, taken = GRASP_SITE, [site.name for site in spec.sites]
    while name in taken:
        name += "_"
    spec.body(end.body).add_site(name=name, pos=end.position, quat=end.quat_wxyz)
    return name


def _finger_pad(model: mujoco.MjModel, side: str, pad: PadSection) -> FingerPad:
    return FingerPad(
        finger=side,
        body=model.body(pad.body).id - 1,
        T_body_pad=transform(matrix_from_quat(pad.quat_wxyz), pad.center),
        half_extents=np.array(pad.half_extents),
    )


def _robot_camera(model: mujoco.MjModel, item: MountSection) -> tuple[int, Camera]:
    focal = item.height / 2 / np.tan(np.radians(item.fov_deg) / 2)
    T_body_cam = transform(matrix_from_quat(item.quat_wxyz), item.position)
    view = Camera(
        fx=focal, fy=focal, cx=item.width / 2, cy=item.height / 2, width=item.width, height=item.height, T_world_cam=T_body_cam
    )  # fmt: skip
    return model.body(item.body).id - 1, view


def _colliders(model: mujoco.MjModel, body: int) -> tuple[str, ...]:
    """List the names of the colliding geoms of a body and of the bodies that are rigidly attached to it."""
    rigid = [
        number
        for number in range(body, model.nbody)
        if body in (number, *ancestors(model, number))
        and model.body_weldid[number] == model.body_weldid[body]
    ]
    mine = find_colliding_geoms(model) & np.isin(model.geom_bodyid, rigid)
    return tuple(model.geom(int(geom)).name for geom in np.flatnonzero(mine))


def _closing_way(
    model: mujoco.MjModel, ee_site: str, table: GripperTable, pads: tuple[FingerPad, ...], path: Path
) -> float:
    """Compute the distance by which the pads approach each other from open to closed, [m].

    Raises:
        MalformedFileError: The distance is too small, or the pads are not on a line along the end effector's y axis.
    """
    gaps = []
    states = np.repeat(model.qpos0[None], 2, 0)
    states[:, [model.joint(name).qposadr[0] for name in table.joint_names]] = table.positions[[0, -1]]
    for Ts, T_world_ee in zip(body_poses(model, states), site_poses(model, states, ee_site), strict=True):
        left, right = (apply(Ts[pad.body + 1], pad.face_body) for pad in pads)
        gaps.append(T_world_ee[:3, :3].T @ (right - left))
    way_m = float(np.linalg.norm(gaps[0]) - np.linalg.norm(gaps[1]))
    if not way_m >= MIN_TRAVEL_M:
        raise MalformedFileError(
            path,
            f"decreases the distance of the pads by {1000 * way_m:.1f} mm from open to closed, at least "
            f"{1000 * MIN_TRAVEL_M:.0f} mm are needed",
            "exchange gripper.open and .closed, or correct the pads",
        )
    if not gaps[0][1] >= MIN_COSINE * np.linalg.norm(gaps[0]):
        raise MalformedFileError(
            path,
            "has an end effector whose y axis does not point from the left to the right pad",
            "turn end_effector.quat_wxyz, or exchange left and right",
        )
    return way_m


def _hand_drive(strokes: Mapping[str, tuple[float, float]], actuator: ActuatorSection) -> HandDrive:
    (driver, ends), *_ = strokes.items()
    controls = actuator.open, actuator.closed
    return HandDrive(driver=driver, driver_range=ends, actuator=actuator.name, control_range=controls)
