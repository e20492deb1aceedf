"""Line overlays of the twin: colliders, scan cameras, contacts, and the joint axis with its 95 % region."""

from collections.abc import Callable, Collection, Mapping
from typing import Final, NamedTuple

import mujoco
import numpy as np

from aomgen.core.camera import Camera
from aomgen.core.episode import Episode
from aomgen.core.motion import MotionEstimate
from aomgen.core.transforms import apply
from aomgen.core.values import Array
from aomgen.report.images import axis_space
from aomgen.twin.twin import TwinState
from aomgen.viewing.lines import join_points, outline_camera, outline_geoms, project_segments

# Length of a contact arrow without a measured force, [m], and length per force, [m/N].
ARROW_M, ARROW_M_N = 0.05, 0.004
# Largest length of an arrow, [m].
ARROW_MAX_M: Final = 0.2


class Moment(NamedTuple):
    """State and time [s] of a motion for which an overlay is drawn, and the camera of the view."""

    state: TwinState
    time_s: float
    camera: Camera


# Function that returns segments (N, 2, 3), world frame, by class name.
Overlay = Callable[[Moment], Mapping[str, Array]]


def outline_colliders(
    model: mujoco.MjModel, find_qpos: Callable[[TwinState], Array], pair: Collection[str] = ()
) -> Overlay:
    """Outline the collision shapes; the shapes of a colliding pair have a separate class name.

    Args:
        model: Bodies and shapes.
        find_qpos: Converts a state to generalized positions (nq,).
        pair: Names of colliding bodies or shapes.
    """
    data, outlines = mujoco.MjData(model), outline_geoms(model)
    names = {geom: {model.geom(geom).name, model.body(model.geom_bodyid[geom]).name} for geom, _ in outlines}
    in_pair = {geom for geom, known in names.items() if known & set(pair)}

    def draw(moment: Moment) -> Mapping[str, Array]:
        data.qpos[:] = find_qpos(moment.state)
        mujoco.mj_kinematics(model, data)
        drawn: dict[str, list[Array]] = {"collider": [], "pair": []}
        for geom, segments in outlines:
            placed = segments @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            drawn["pair" if geom in in_pair else "collider"].append(placed)
        return {name: np.concatenate(found) for name, found in drawn.items() if found}

    return draw


def outline_cameras(scan: Mapping[str, Camera], fixed: Mapping[str, Camera], size: float) -> Overlay:
    """Outline scan cameras and fixed cameras as pyramids of depth `size`, except the camera of the view."""

    def draw(moment: Moment) -> Mapping[str, Array]:
        drawn = {}
        for name, cameras in (("scan", scan.values()), ("fixed", fixed.values())):
            others = (item for item in cameras if np.linalg.norm(item.center - moment.camera.center) > size)
            drawn[name] = np.concatenate(
                [np.zeros((0, 2, 3)), *(outline_camera(item, size) for item in others)]
            )
        return drawn

    return draw


def outline_axis(motion: MotionEstimate, held_world: Array) -> Overlay:
    """Outline the axis, and its 95 % region by circles and lines."""
    centers, circles = axis_space(motion, held_world)
    rings = [join_points(ring, closed=True) for ring in circles]
    along = [join_points(line) for line in circles[:, ::2].swapaxes(0, 1)]
    drawn = {"region": np.concatenate([*rings, *along]), "axis": join_points(centers)}
    return lambda moment: drawn


def outline_episode_axis(episode: Episode) -> Overlay:
    """Outline the axis of an episode's object, which is known exactly."""
    joint = episode.joint
    drawn = {"axis": joint.origin + 0.25 * joint.axis * np.array([[[-1.0], [1.0]]])}
    return lambda moment: drawn


def outline_patches(motion: MotionEstimate) -> Overlay:
    """Draw arrows of the estimated contacts, which move with the part, while the part moves."""

    def draw(moment: Moment) -> Mapping[str, Array]:
        arrows = [(item.point, item.point + ARROW_M * item.normal) for item in motion.contacts]
        segments = np.array(arrows, np.float64).reshape(-1, 2, 3)
        touching = motion.start_s <= moment.time_s <= motion.end_s
        T = motion.joint.motion(moment.state.theta - float(motion.theta_at([motion.start_s])[0]))
        moved = apply(T, segments.reshape(-1, 3)).reshape(-1, 2, 3)
        return {"contact": moved if touching else segments[:0]}

    return draw


def outline_contacts(episode: Episode) -> Overlay:
    """Draw arrows of an episode's contacts at a time, with lengths proportional to their normal forces."""
    log = episode.contacts

    def draw(moment: Moment) -> Mapping[str, Array]:
        now = log.frames == int(np.argmin(np.abs(episode.times_s - moment.time_s)))
        lengths = np.minimum(ARROW_M_N * log.forces[now], ARROW_MAX_M)[:, None]
        starts = log.points_world[now]
        return {"contact": np.stack([starts, starts + lengths * log.normals_world[now]], 1)}

    return draw


def project_overlay(overlay: Overlay, moment: Moment) -> dict[str, list[list[float]]]:
    """Project an overlay's segments to pixels x0, y0, x1, y1 by class name."""
    return {
        name: project_segments(moment.camera, segments).round(1).tolist()
        for name, segments in overlay(moment).items()
    }
