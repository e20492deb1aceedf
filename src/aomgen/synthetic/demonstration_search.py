"""A demonstration that succeeded: drawn, planned, simulated and judged until one does."""

from dataclasses import dataclass

import numpy as np

from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import Joint
from aomgen.core.values import Array
from aomgen.errors import ConfigError
from aomgen.robots.robot import RobotModel
from aomgen.synthetic.commanded_trajectory import CommandedTrajectory
from aomgen.synthetic.demonstration_planning import plan
from aomgen.synthetic.grasp_selection import list_grasp_types
from aomgen.synthetic.layout import SceneLayout, build_world, draw_layout
from aomgen.synthetic.simulated_demonstration import SimulatedDemonstration, simulate
from aomgen.synthetic.style import MOVED, DemonstrationStyle

# Layouts that are tried before a seed is given up.
MAX_TRIES = 80
# Damping that holds a locked part, [N m s/rad] or [N s/m].
LOCKED_DAMPING = 1e6
# A part that is pushed may coast beyond the end of the push, up to this many times its travel.
COAST = 1.3
# Force that counts as a touch, [N].
FELT_N = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Performance:
    """A demonstration that succeeded, in its setting and style."""

    layout: SceneLayout
    style: DemonstrationStyle
    script: CommandedTrajectory
    demonstration: SimulatedDemonstration

    @property
    def joint(self) -> Joint:
        """The joint as demonstrated, world frame: axis in the demonstrated direction, 0 = scanned state."""
        joint, style = self.layout.joint_world, self.style
        return orient_joint(joint, style.start, style.sign)

    @property
    def theta(self) -> Array:
        """Demonstrated joint value at each step (T,), [rad] or [m]."""
        return self.style.sign * (self.demonstration.theta - self.style.start)


def orient_joint(joint: Joint, start: float, sign: float) -> Joint:
    """A joint whose value counts from `start`, in the direction of `sign`."""
    ends = sorted((sign * (joint.lower - start), sign * (joint.upper - start)))
    return Joint(type=joint.type, axis=sign * joint.axis, origin=joint.origin, lower=ends[0], upper=ends[1])


def find_demonstration(
    robot: RobotModel,
    asset: ArticulatedAsset,
    rng: np.random.Generator,
    style: DemonstrationStyle | None = None,
) -> Performance:
    """Draw layouts until one demonstration moves the object by contact with the handle alone.

    Args:
        style: How it is done; a random pinch that opens the object when None.

    Raises:
        ConfigError: None of MAX_TRIES does, or the object cannot be touched in this style.
    """
    if style is not None and style.touch not in (known := list_grasp_types(asset, style.direction)):
        what = f"cannot be moved by a {style.touch} when {style.direction}"
        raise ConfigError(asset.name, what, f"choose {' or '.join(known)}")
    for _ in range(MAX_TRIES):
        layout = draw_layout(asset, rng)
        scene = build_world(robot, layout, visual=False)
        planned = plan(scene, layout, rng, style)
        if planned is None:
            continue
        if planned[0].outcome == "locked":
            scene.model.dof_damping[scene.object_dof] = LOCKED_DAMPING
        shown = simulate(scene, planned[1])
        performance = Performance(layout=layout, style=planned[0], script=planned[1], demonstration=shown)
        if not shown.diverged and not shown.foreign and _succeeded(performance):
            return performance
    raise ConfigError(asset.name, f"no demonstration succeeds in {MAX_TRIES} settings", "choose another seed")


def _succeeded(performance: Performance) -> bool:
    """Whether what the style says has come of it.

    A part that moves reaches at least 90 % of its travel and stays within 10 % after release; one
    that is not gripped may coast on.
    """
    theta, style = performance.theta, performance.style
    travel = style.travel
    if style.outcome in ("moves", "cut"):
        goal = travel if style.touch == "pinch" else float(np.clip(theta.max(), travel, COAST * travel))
        return bool(theta.max() >= 0.9 * travel and abs(theta[-1] - goal) <= 0.1 * travel)
    pressed = any(touch.force > FELT_N for touches in performance.demonstration.contacts for touch in touches)
    still = np.abs(theta).max() < MOVED[performance.joint.type] / 2
    return bool(still and pressed == (style.outcome != "nothing"))
