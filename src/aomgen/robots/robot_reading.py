"""A user's URDF or MJCF as an editable model that holds the robot and nothing else."""

import mujoco
import numpy as np

from aomgen.errors import MalformedFileError
from aomgen.io.robot_xml import RobotXml
from aomgen.robots.robot_files import set_options

# Every name of the file carries this while it is taken over, then loses it again.
TAKEOVER = "file/"
# What links without mass get: less than any real link, enough for the solver, [kg] and [kg m^2].
LEAST_MASS, LEAST_INERTIA = 1e-3, 1e-6
# The file's scene may have set others.
TIMESTEP_S, GRAVITY = 0.002, (0.0, 0.0, -9.81)
SCENE_SIZES = ("nuser_actuator", "nuser_body", "nuser_cam", "nuser_geom", "nuser_jnt", "nuser_sensor",
               "nuser_site", "nuser_tendon", "njmax", "nconmax")  # fmt: skip
BASE_BODY = "robot_base"


def read_robot_spec(xml: RobotXml, turned: bool) -> tuple[mujoco.MjSpec, tuple[str, ...]]:
    """The robot of a file in radians, with named bodies, without actuators, sensors, lights and floor.

    Only the tree of bodies that holds most joints is kept; whatever else the file's scene has
    (tables, objects, mocap targets) goes. Shapes that stand in the world itself, floors left out,
    become the body "robot_base".

    Args:
        xml: With its references checked.
        turned: World is turned by 180 degrees about z against the file's root frame.

    Returns:
        The description, and the joints that the file's actuators drove.

    Raises:
        MalformedFileError: MuJoCo cannot read the file, or it holds no hinge or slide joint.
    """
    source = _parsed(xml)
    actuated = _actuated_joints(source, xml)
    for kind in ("keys", "lights", "cameras", "sensors", "actuators", "tendons", "pairs"):
        for item in list(getattr(source, kind)):
            source.delete(item)
    for equality in list(source.equalities):
        if equality.type in (mujoco.mjtEq.mjEQ_TENDON, mujoco.mjtEq.mjEQ_FLEX):
            source.delete(equality)
    _keep_robot_tree(source, xml)
    spec = mujoco.MjSpec()
    for compiler in (spec.compiler, source.compiler):
        compiler.boundmass, compiler.boundinertia = LEAST_MASS, LEAST_INERTIA
        compiler.balanceinertia = True
    # What the file's scene chose for the solver is not the robot's; MuJoCo tells of each difference.
    for name in SCENE_SIZES:
        setattr(source, name, getattr(spec, name))
    for name in dir(spec.option):
        if not name.startswith("_"):
            setattr(source.option, name, getattr(spec.option, name))
    spec.compiler.degree = False
    spec.compiler.conflict = mujoco.mjtConflict.mjCONFLICT_MERGE
    home = spec.worldbody
    if source.worldbody.geoms or source.worldbody.sites:
        home = home.add_body(name=BASE_BODY)
    turn = [0.0, 0.0, 0.0, 1.0] if turned else [1.0, 0.0, 0.0, 0.0]
    spec.attach(source, prefix=TAKEOVER, frame=home.add_frame(quat=turn))
    _rename(spec)
    set_options(spec)
    spec.option.timestep, spec.option.gravity = TIMESTEP_S, GRAVITY
    return spec, actuated


def _parsed(xml: RobotXml) -> mujoco.MjSpec:
    try:
        if xml.kind == "mjcf":
            return mujoco.MjSpec.from_file(str(xml.path))
        meshes = {name: file.read_bytes() for name, file in xml.meshes.items()}
        spec = mujoco.MjSpec.from_string(xml.text, assets=meshes)
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(xml.path, f"cannot be read by MuJoCo ({error})", "correct it") from error
    return spec


def compile_model(spec: mujoco.MjSpec, xml: RobotXml) -> mujoco.MjModel:
    """The compiled model.

    Raises:
        MalformedFileError: MuJoCo refuses it.
    """
    try:
        return spec.compile()
    except (ValueError, RuntimeError) as error:
        raise MalformedFileError(xml.path, f"cannot be used by MuJoCo ({error})", "correct it") from error


def _actuated_joints(spec: mujoco.MjSpec, xml: RobotXml) -> tuple[str, ...]:
    names = [actuator.target for actuator in spec.actuators if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT]
    pulled = [
        actuator.target for actuator in spec.actuators if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON
    ]
    if pulled:
        model = compile_model(spec.copy(), xml)
        for tendon in pulled:
            number = model.tendon(tendon).id
            start, count = model.tendon_adr[number], model.tendon_num[number]
            wraps = range(start, start + count)
            joints = [w for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT]
            names += [model.joint(model.wrap_objid[w]).name for w in joints]
    return tuple(dict.fromkeys(names))


def _keep_robot_tree(spec: mujoco.MjSpec, xml: RobotXml) -> None:
    moving = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)

    def joints(root: mujoco.MjsBody) -> int:
        found = root.find_all("joint")
        if any(joint.type not in moving for joint in found):
            return 0
        return len(found)

    roots = list(spec.worldbody.bodies)
    counts = [joints(root) for root in roots]
    if not max(counts, default=0) > 0:
        raise MalformedFileError(
            xml.path, "holds no robot (no body with hinge or slide joints)", "give the file of the arm"
        )
    robot = int(np.argmax(counts))
    for number, root in enumerate(roots):
        if number != robot:
            _delete_references(spec, root)
            spec.delete(root)
    for geom in list(spec.worldbody.geoms):
        if geom.type in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD):
            spec.delete(geom)


def _delete_references(spec: mujoco.MjSpec, root: mujoco.MjsBody) -> None:
    """Drop what names a body or joint of a tree that goes."""
    gone = {root.name, *(body.name for body in root.find_all("body"))}
    gone |= {joint.name for joint in root.find_all("joint")}
    for equality in list(spec.equalities):
        if equality.name1 in gone or equality.name2 in gone:
            spec.delete(equality)
    for exclude in list(spec.excludes):
        if exclude.bodyname1 in gone or exclude.bodyname2 in gone:
            spec.delete(exclude)


def _rename(spec: mujoco.MjSpec) -> None:
    """Give bodies, joints, sites and geoms their own names back, and names to those without."""
    for kind, label in (
        (spec.bodies, "body"),
        (spec.joints, "joint"),
        (spec.sites, "site"),
        (spec.geoms, "geom"),
    ):
        taken = {item.name.removeprefix(TAKEOVER) for item in kind}
        for number, item in enumerate(kind):
            name = item.name.removeprefix(TAKEOVER)
            if not name:
                name = f"{label}_{number}"
                while name in taken:
                    name += "_"
            if item.name != name:
                item.name = name
    for equality in spec.equalities:
        equality.name1 = equality.name1.removeprefix(TAKEOVER)
        equality.name2 = equality.name2.removeprefix(TAKEOVER)
    for exclude in spec.excludes:
        exclude.bodyname1 = exclude.bodyname1.removeprefix(TAKEOVER)
        exclude.bodyname2 = exclude.bodyname2.removeprefix(TAKEOVER)
