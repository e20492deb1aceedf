"""Plan one episode: generate candidates, evaluate them one by one, and take the first that passes.

The candidates come in the order of their value for policies: the arm's configuration and the motion as
demonstrated, the grasp most like the usual one. Only where none of them passes, the end effector approaches
straight, then the free motion is searched around obstacles, and finally the arm takes another configuration.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from aomgen.core.demonstration import Demonstration
from aomgen.core.episode import PHASES
from aomgen.core.plan import EpisodePlan, FittedAsset, Rejection, Variation
from aomgen.core.transforms import invert
from aomgen.core.values import Array
from aomgen.episodes.candidates import WAYS, Candidate, Way, follow_contact, follow_sides, list_motions
from aomgen.episodes.free_motion import find_free_path
from aomgen.episodes.grasps import Grasp, between, difference
from aomgen.episodes.ik import IkSolver, find_arms, path_residuals, solve_smoothly
from aomgen.episodes.joint_limits import IkLimits, check_margins, check_speed, keep_margins
from aomgen.episodes.rejections import locate, rank
from aomgen.episodes.retarget import CONTACT, INTERVAL_PHASES, DemonstratedMotion, RetargetedMotion, ease
from aomgen.episodes.start import find_start
from aomgen.simulation.collision_check import (
    KinematicLimits,
    check_kinematics,
    make_collision_test,
    self_overlap_mm,
    stalling_gripper,
)
from aomgen.simulation.scene import Scene

# Number of bisections between two grasps, to an eighth of their difference; largest difference, [rad].
HALVINGS: Final = 3
MAX_APART_RAD: Final = np.pi / 2
# A motion that is too fast is slowed down by this factor more than needed: sampling shifts its peaks.
SLOWER = 1.05
NO_START: Final = Rejection(reason="no_path", detail="the arm collides at every possible start")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanParams:
    """Parameters of the planning of an episode.

    Attributes:
        fps: Samples per second.
        ik: Limits of the arm.
        kinematic: Limits of tier A.
        max_slow_down: Largest factor on the requested duration of a phase: demonstrations
            may start near the handle.
        search: Where no motion like the demonstrated one passes, search a free motion around obstacles and
            other configurations of the arm. Demonstrations without such motions resemble each other more.
        clearance_m: Distance kept between the object and the arm, [m], because a lid that resists lags behind;
            in searched free motions, the gripper keeps it as well.
        gripper_clearance_m: Distance kept between the gripper and the object's static link, [m].
    """

    fps: float = 10.0
    ik: IkLimits = field(default_factory=IkLimits)
    kinematic: KinematicLimits = field(default_factory=KinematicLimits)
    max_slow_down: float = 5.0
    search: bool = True
    clearance_m: float = 0.003
    gripper_clearance_m: float = 0.0


def plan_episode(
    fitted: FittedAsset,
    demo: Demonstration,
    variation: Variation,
    scene: Scene,
    solver: IkSolver,
    params: PlanParams,
    usual: Grasp | None = None,
    start: Array | None = None,
) -> EpisodePlan | Rejection:
    """Plan one episode, with the grasp most like the usual one that works, or else like the demonstrated one.

    Args:
        fitted: The object and its planned motion. It is oriented like the recorded object, so that its
            axes are those of the demonstrated end effector.
        scene: Robot, table and this asset, at any pose.
        usual: See `grasp_choice`.
        start: Joints (J,) at which the arm starts; by default as demonstrated, see `Planner`.

    Returns:
        The plan; or the Rejection of the candidate that came farthest, with the number of
        `grasps_tried` among its metrics.
    """
    planner = Planner(fitted, demo, variation, scene, solver, params, start)
    motions = planner.list_motions(usual)
    found = planner.search(motions, WAYS if params.search else WAYS[:2])
    if isinstance(found, Rejection):
        return found
    return found[1] if usual is None else planner.approach_usual(motions[0].grasp, *found)


class Planner:
    """Planner of one variation; arguments as for `plan_episode`."""

    def __init__(
        self,
        fitted: FittedAsset,
        demo: Demonstration,
        variation: Variation,
        scene: Scene,
        solver: IkSolver,
        params: PlanParams,
        start: Array | None = None,
    ) -> None:
        self.fitted, self.variation, self.solver = fitted, variation, solver
        self.shown, self.robot = DemonstratedMotion(demo), scene.robot
        self.T_world_object = variation.place_at(fitted)
        self.scene = scene.place_at(self.T_world_object, params.clearance_m, params.gripper_clearance_m)
        allowed = params.kinematic.max_self_penetration_mm
        allowed += self_overlap_mm(self.scene, demo.joints[0], float(demo.gripper[0]))
        kinematic = replace(params.kinematic, max_self_penetration_mm=allowed)
        self.params = replace(params, kinematic=kinematic)
        self.is_free = make_collision_test(self.scene, float(demo.gripper[0]), fitted.start_theta, kinematic)
        self.start = self._find_start(demo.Ts_world_ee[0], demo.joints[0]) if start is None else start
        measured = demo.joints if start is None else np.vstack([demo.joints, start])
        self.margins = keep_margins(self.robot, measured, params.ik)
        grip = float(np.median(demo.gripper[demo.contact_frames]))
        self._held_tests = [
            make_collision_test(self.scene, grip, theta, kinematic, holding=True)
            for theta in (fitted.start_theta, fitted.target_theta)
        ]
        self._stalls = dict[tuple[str | float, ...], float]()
        # Seeds of OMPL start at 1.
        self.seed = 1 + int(np.random.default_rng([variation.seed, variation.index]).integers(2**31 - 1))

    def _find_start(self, T_from: Array, joints: Array) -> Array | None:
        """Find the arm's start (J,), in the configuration that it has at a pose (4, 4).

        The end effector starts at its demonstrated pose in the world, or else relative to the object, and is
        raised until it is free of collisions.
        """
        demo, offset = self.shown.demo, np.array(self.variation.start_offset or 0.0)
        if np.array_equal(joints, demo.joints[0]) and self.is_free(joints):
            return joints + offset
        there = demo.Ts_world_ee[0]
        carried = self.T_world_object @ invert(self.fitted.T_world_asset) @ there
        Ts_start = np.stack([carried, there])
        found = find_start(Ts_start, T_from, joints, self.solver, self.params.ik, self.is_free)
        return None if found is None else found + offset

    def list_motions(self, usual: Grasp | None = None) -> list[RetargetedMotion]:
        """List motions with all grasps, see `candidates.list_motions`."""
        return list_motions(self.fitted, self.shown, self.T_world_object, self.robot, usual)

    def search(
        self, motions: Sequence[RetargetedMotion], ways: Sequence[Way] = WAYS
    ) -> tuple[Candidate, EpisodePlan] | Rejection:
        """Find the first candidate that passes, and its plan; or return the rejection that came farthest."""
        best: Rejection | None = None
        for found in self.evaluate_all(motions, ways):
            if not isinstance(found, Rejection):
                return found
            best = found if best is None else max(best, found, key=rank)
        # Without a start, no candidate of an object that the arm can hold is evaluated.
        best = best or NO_START
        return replace(best, metrics={**best.metrics, "grasps_tried": float(len(motions))})

    def evaluate_all(
        self, motions: Sequence[RetargetedMotion], ways: Sequence[Way]
    ) -> Iterator[tuple[Candidate, EpisodePlan] | Rejection]:
        """Evaluate all candidates, the best first; a grasp that cannot hold is evaluated once."""
        near_limit = None if self.start is None else check_margins(self.robot, self.start[None], self.margins)
        if near_limit is not None:
            yield near_limit
            return
        for number, arm in enumerate(self._arms(ways)):
            contacts = dict[int, Array]()
            for k, contact in enumerate(follow_contact(motions, arm, self.solver, self.params.ik)):
                if isinstance(contact, Rejection):
                    yield contact
                # For the first arm configuration, a rejection shall name what collides.
                elif number == 0 or self._is_clear(contact):
                    contacts[k] = contact
            for way in ways if number == 0 else ways[-1:]:
                if self.start is None and way[1] == "demonstrated":
                    continue
                for k, candidate in follow_sides(motions, contacts, way, self.solver, self.params.ik):
                    result = candidate if isinstance(candidate, Rejection) else self.evaluate(candidate)
                    if isinstance(result, Rejection):
                        yield result
                        if result.metrics.get("in_contact"):
                            del contacts[k]
                    elif not isinstance(candidate, Rejection):
                        yield candidate, result

    def _is_clear(self, contact: Array) -> bool:
        """Check that the arm has no collision at either end of a contact (K, J)."""
        ends = zip(self._held_tests, contact[[0, -1]], strict=True)
        return all(is_free(joints) for is_free, joints in ends)

    def evaluate(self, candidate: Candidate) -> EpisodePlan | Rejection:
        """Check the motion near the handle, then find the free motion, the time law and the plan of a candidate."""
        motion, shown, params, free = candidate.motion, self.shown, self.params, candidate.free
        knots, held_at = candidate.knots.ravel(), self._find_stall(candidate)
        at_knots = candidate.joints.reshape(len(knots), -1)
        near = self._check_motion(motion, knots, at_knots, held_at)
        if isinstance(near, Rejection):
            return near
        start, goal = self.start, candidate.joints[0, 0]
        if start is None:
            start = self._find_start(motion.knots[0, 0], goal)
        if start is None:
            return NO_START
        path = self._find_free_path(start, goal, held_at) if free == "searched" else None
        if isinstance(path, Rejection):
            return path
        T_free = self.robot.ee_poses(self._free_joints(shown.knots[0], start, goal, path))
        stretches, slow_down = motion.stretches(T_free) / self.variation.speed, np.ones(len(PHASES))
        while True:
            times = shown.retime(stretches * slow_down[list(INTERVAL_PHASES)], params.fps)
            first = int(np.searchsorted(times, shown.marks[1]))
            guesses = np.stack([np.interp(times[first:], knots, q) for q in at_knots.T], 1)
            poses = motion.at(times[first:])
            joints = solve_smoothly(self.solver, poses, guesses, params.fps, params.ik)
            if isinstance(joints, Rejection):
                return locate(joints, shown.phases(times), first)
            mm, deg = path_residuals(self.solver, poses, joints)
            # The smoothed path does not begin exactly at the first knot.
            goal = candidate.joints[0, 0] + joints[0] - guesses[0]
            free_joints = self._free_joints(times[:first], start, goal, path)
            near_limit = check_margins(self.robot, free_joints, self.margins)
            if near_limit is not None:
                return locate(near_limit, shown.phases(times))
            joints = np.concatenate([free_joints, joints])
            rates = check_speed(joints, params.fps, params.ik, self.robot.slides, shown.phases(times))
            if not isinstance(rates, Rejection):
                break
            needed = np.array([rates.metrics[f"{phase}_share"] for phase in PHASES])
            slow_down *= np.where(needed > 1.0, SLOWER * needed, 1.0)
            if not slow_down.max() <= params.max_slow_down:
                in_contact = float(slow_down[CONTACT] > params.max_slow_down)
                return replace(rates, metrics={**rates.metrics, "in_contact": in_contact})
        figures = self._check_motion(motion, times, joints, held_at)
        if isinstance(figures, Rejection):
            return figures
        return EpisodePlan(
            variation=self.variation,
            fitted=self.fitted,
            T_world_object=self.T_world_object,
            fps=params.fps,
            times_s=np.arange(len(times)) / params.fps,
            joints=joints,
            gripper=shown.gripper(times, held_at),
            thetas=motion.thetas(times),
            phases=shown.phases(times),
            Ts_world_ee=self.robot.ee_poses(joints),
            grasp=str(candidate),
            metrics={**figures, **rates, "residual_mm": float(mm.max()), "residual_deg": float(deg.max())},
        )

    def approach_usual(self, usual: Grasp, found: Candidate, plan: EpisodePlan) -> EpisodePlan:
        """Bisect between the usual and the found grasp for the plan nearest to the usual one that works.

        Grasps then change with the object's pose by small steps, which policies can learn; the grasps on
        offer are at least 15 degrees apart.
        """
        far, low, high = found.motion.grasp, 0.0, 1.0
        # No grasp holds between an end effector and one that is rotated by half a turn.
        if found.free == "searched" or not 0 < difference(usual, far) < MAX_APART_RAD:
            return plan
        for _ in range(HALVINGS):
            share = (low + high) / 2
            motion = replace(found.motion, grasp=between(usual, far, share))
            nearer = self.search([motion], [(motion.style, found.free)])
            if isinstance(nearer, Rejection):
                low = share
            else:
                high, plan = share, nearer[1]
        return plan

    def list_candidates(self) -> dict[str, list[Candidate]]:
        """List candidates as demonstrated, before their evaluation, by the name of their grasp in order of preference."""
        if self.start is None:
            return {}
        found, motions, limits = dict[str, list[Candidate]](), self.list_motions(), self.params.ik
        solved = follow_contact(motions, next(self._arms(WAYS[:1])), self.solver, limits)
        contacts = {k: item for k, item in enumerate(solved) if not isinstance(item, Rejection)}
        for _, candidate in follow_sides(motions, contacts, WAYS[0], self.solver, limits):
            if not isinstance(candidate, Rejection):
                found.setdefault(candidate.motion.grasp.name, []).append(candidate)
        return found

    def works(self, candidates: Sequence[Candidate]) -> bool:
        """Check whether an episode can be planned with one of several candidates."""
        return any(isinstance(self.evaluate(candidate), EpisodePlan) for candidate in candidates)

    def _arms(self, ways: Sequence[Way]) -> Iterator[Array]:
        """Yield configurations (J,) at the handle: the demonstrated one, and others if paths are searched."""
        times = self.shown.from_closed(self.fitted)[:1]
        first = self.shown.joints(times)[0]
        yield first
        if ways[-1][1] == "searched":
            yield from find_arms(self.solver, self.shown.poses(times)[0], first, self.params.ik)[1:]

    def _find_free_path(self, start: Array, goal: Array, held_at: float) -> Array | Rejection:
        """Find joints (N, J) from the start to the approach, around obstacles."""
        opened = float(self.shown.gripper(self.shown.knots[0], held_at).min())
        is_free = make_collision_test(
            self.scene, opened, self.fitted.start_theta, self.params.kinematic, gripper_as_arm=True
        )
        limits = self.robot.joint_limits + self.margins[:, None] * [1.0, -1.0]
        path = find_free_path(start, goal, limits, is_free, self.seed)
        if path is None:
            return Rejection(
                reason="no_path", detail="no path of the arm leads to the handle without a collision"
            )
        return path

    def _free_joints(self, times: Array, start: Array, goal: Array, path: Array | None) -> Array:
        """Compute joints (N, J) of the free motion to `goal` (J,), along a path or as demonstrated."""
        if path is None:
            return self.shown.bend(times, start, goal)
        shares = ease(times / max(self.shown.marks[1], 1e-9))
        lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        along = np.stack([np.interp(shares * lengths[-1], lengths, q) for q in path.T], 1)
        return along + shares[:, None] * (goal - path[-1])

    def _find_stall(self, candidate: Candidate) -> float:
        """Find the gripper value 0..1 at which the fingers stall on the handle; cached per grasp."""
        grasp, demo = candidate.motion.grasp, self.shown.demo
        key = (grasp.name, *grasp.held_ee)
        if key not in self._stalls:
            measured = float(np.median(demo.gripper[demo.contact_frames]))
            theta = self.fitted.start_theta
            self._stalls[key] = stalling_gripper(self.scene, candidate.joints[1, 0], theta, measured)
        return self._stalls[key]

    def _check_motion(
        self, motion: RetargetedMotion, times: Array, joints: Array, held_at: float
    ) -> dict[str, float] | Rejection:
        """Check tier A at times (N,), with the fingers as wide open as the handle will hold them."""
        phases, gripper = self.shown.phases(times), self.shown.gripper(times, held_at)
        holding = (phases == CONTACT) & (gripper > 0.95)
        # While the fingers close or open around the handle, their position is left to the simulation.
        between = (phases == CONTACT) & ~holding
        gripper = np.minimum(gripper, held_at)
        widest = max(0.5 * held_at, float(gripper.min()))
        gripper = np.where(between, np.minimum(gripper, widest), gripper)
        thetas = motion.thetas(times)
        result = check_kinematics(self.scene, joints, gripper, thetas, holding, self.params.kinematic)
        return locate(result, phases) if isinstance(result, Rejection) else result
