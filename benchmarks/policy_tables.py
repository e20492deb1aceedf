"""Tables of `python -m benchmarks policy`: training data of the policies, and where each is tested."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from aomgen.datasets.features import ActionSpace
from aomgen.errors import UnknownNameError
from aomgen.evaluation.known_objects import KNOWN
from aomgen.evaluation.policies import NEAREST, ORACLE
from aomgen.evaluation.views import VISUALS, Visuals
from benchmarks.policy_data import (
    FULL,
    MANY,
    NEIGHBORS,
    UNSEEN,
    WITH_NEIGHBOR,
    WORLDS,
    Sight,
    Trials,
)
from benchmarks.policy_neighbors import SCALE

SEEDS: Final = (0, 1, 2)
SCALES: Final = (0.6, 0.7, 0.8, 0.9)
MOVED_M: Final = (0.0, 0.05, 0.10, 0.20)
# Worlds that are tested where only the success matters.
QUICK: Final = "quick"


# Kinds of policies: those of our plug-in, of which `handle_plan` is not trained, and LeRobot's own, which need a GPU.
Kind = Literal["small_act", "handle_act", "handle_plan", "act", "diffusion"]
# Trainings of a finder: with all parts, without the second and the third look, and without pretrained weights.
Variant = Literal["usual", "one_look", "from_scratch"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Training:
    """A policy.

    Attributes:
        world: World of the demonstrations.
        demonstrations: Number of demonstrations; none for an untrained policy.
        seed: Seed of the training; with `handle_plan`, of its finder's.
        sees: Observations of the demonstrations.
        kind: Network of the policy.
        fixed_camera: Whether it uses only the camera of the recorded video.
        wrist_camera: Whether a policy with a finder uses the cameras on the robot.
        others: Further worlds of `handle_plan`, whose demonstrations the instruction selects.
        known: Number of parametric objects that `handle_plan` knows besides those of the world.
        variant: Training of the finder of `handle_plan`.
    """

    world: str
    demonstrations: int = FULL
    seed: int = 0
    sees: Sight = "splat"
    kind: Kind = "small_act"
    fixed_camera: bool = False
    wrist_camera: bool = True
    others: tuple[str, ...] = ()
    known: int = KNOWN
    variant: Variant = "usual"

    @property
    def worlds(self) -> tuple[str, ...]:
        """Names of all worlds."""
        return (self.world, *self.others)

    @property
    def category(self) -> str:
        """Category of the objects of the demonstrations."""
        return WORLDS[self.world].recording

    @property
    def learns(self) -> bool:
        """Return whether the policy is trained with demonstrations."""
        return self.kind != "handle_plan"

    @property
    def finds(self) -> bool:
        """Return whether the policy contains a finder."""
        return self.kind in ("handle_act", "handle_plan")

    @property
    def actions(self) -> ActionSpace:
        """Action space of the trials: a planned motion may pass a singularity, at which poses do not determine the joints."""
        return "ee_absolute" if self.kind == "handle_act" else "joint"

    @property
    def name(self) -> str:
        """Name in files."""
        own = [self.sees] * (self.sees != "splat") + [self.kind] * (self.kind != "small_act")
        seen = ["front"] * self.fixed_camera + ["no_wrist"] * (not self.wrist_camera)
        known = [f"known{self.known}"] * (self.known != KNOWN)
        variant = [self.variant] * (self.variant != "usual")
        return "-".join(
            [*self.worlds, str(self.demonstrations), str(self.seed), *own, *seen, *known, *variant]
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A row of a table: one kind of policy, possibly trained several times, in the same trials.

    Attributes:
        label: Difference from the table's other rows.
        policies: Trained ones; or a name of `evaluation.policies`.
        test: The trials.
        visuals: Source of the observed images.
    """

    label: Mapping[str, Any]
    policies: tuple[Training | str, ...]
    test: Trials
    visuals: Visuals = "splat"


def _curve(world: str) -> list[Row]:
    test = Trials(world=world)
    floors = {name: Row(label={"policy": name}, policies=(name,), test=test) for name in (NEAREST, ORACLE)}
    counts = {0: SEEDS[:1], 1: SEEDS[:1], 50: SEEDS[:1], 100: SEEDS[:1], FULL: SEEDS}
    learned = [
        Row(
            label={"demonstrations": count},
            policies=tuple(Training(world=world, demonstrations=count, seed=seed) for seed in seeds),
            test=test,
        )
        for count, seeds in counts.items()
    ]
    told = Row(label={"policy": "state_policy"}, policies=(Training(world=world, sees="pose"),), test=test)
    return [*learned, *floors.values(), told]


def _scales(world: str) -> list[Row]:
    return [
        Row(
            label={"scale": scale, "sizes_in_training": learned != world},
            policies=(Training(world=learned),),
            test=Trials(world=world, scale=scale),
        )
        for learned in (f"{world}_sizes", world)
        for scale in SCALES
    ]


def _planned(
    category: str,
    known: int = KNOWN,
    wrist_camera: bool = True,
    moved_m: float = 0.0,
    objects: str = "",
    seeds: Sequence[int] = SEEDS[:1],
    variant: Variant = "usual",
) -> Row:
    """Describe `handle_plan` with the recording of a category, tested with its unseen objects or with those of another world."""
    world = objects or UNSEEN[category]
    policies = tuple(
        Training(
            world=category,
            demonstrations=0,
            seed=seed,
            sees="keypoints",
            kind="handle_plan",
            wrist_camera=wrist_camera,
            known=known,
            variant=variant,
        )
        for seed in seeds
    )
    return Row(
        label={
            "policy": "handle_plan",
            "objects": world,
            "known_objects": known,
            "wrist_camera": wrist_camera,
            "moved_m": moved_m,
            "finder": variant,
        },
        policies=policies,
        test=Trials(world=world, moved_m=moved_m),
    )


def _planner_table(category: str) -> list[Row]:
    return [
        *(_planned(category, moved_m=moved_m) for moved_m in MOVED_M),
        _planned(category, wrist_camera=False),
        _planned(category, known=0),
    ]


def _five_categories() -> list[Row]:
    """Describe one policy `handle_plan` that is tested with objects of all categories; the instruction selects the category.

    In further trials, an object of another category is next to the named one.
    """
    first, *others = UNSEEN
    policy = Training(
        world=first, others=tuple(others), demonstrations=0, sees="keypoints", kind="handle_plan"
    )
    alone = [
        Row(label={"category": category}, policies=(policy,), test=Trials(world=unseen))
        for category, unseen in UNSEEN.items()
    ]
    beside = [
        Row(
            label={"category": category, "neighbor": NEIGHBORS[category]},
            policies=(policy,),
            test=Trials(world=world, scale=SCALE),
        )
        for category, world in WITH_NEIGHBOR.items()
    ]
    return [*alone, *beside]


def _on_gpu(kind: Kind) -> list[Row]:
    return [
        Row(
            label={"demonstrations": count},
            policies=(Training(world="microwave", demonstrations=count, kind=kind),),
            test=Trials(world="microwave"),
        )
        for count in (50, 100, FULL)
    ]


TABLES: Final = {
    "curve.microwave": _curve("microwave"),
    "curve.drawer": _curve("drawer"),
    "scale_table.microwave": _scales("microwave"),
    "scale_table.drawer": _scales("drawer"),
    QUICK: [
        Row(
            label={"demonstrations": 2},
            policies=(Training(world="microwave", demonstrations=2),),
            test=Trials(world="microwave"),
        )
    ],
    "gpu.act": _on_gpu("act"),
    "gpu.diffusion": _on_gpu("diffusion"),
    "unseen_table.microwave": [
        Row(
            label={"training": label, "demonstrations": count},
            policies=(Training(world=world, demonstrations=count),),
            test=Trials(world=UNSEEN["microwave"]),
        )
        for label, world, count in (
            ("single", "microwave", FULL),
            ("mixed", "microwaves", FULL),
            ("mixed", "microwaves", MANY),
        )
    ]
    + [
        Row(
            label={"training": "mixed", "demonstrations": MANY, "policy": "handle_act"},
            policies=tuple(
                Training(
                    world="microwaves", demonstrations=MANY, seed=seed, sees="keypoints", kind="handle_act"
                )
                for seed in SEEDS
            ),
            test=Trials(world=UNSEEN["microwave"]),
        ),
        _planned("microwave"),
    ],
    **{f"planner_table.{category}": _planner_table(category) for category in UNSEEN},
    "planner_table.microwave": [
        *_planner_table("microwave"),
        _planned("microwave", objects="further_microwaves"),
        _planned("microwave", seeds=SEEDS),
        _planned("microwave", variant="one_look"),
        _planned("microwave", variant="from_scratch"),
    ],
    "five_categories": _five_categories(),
    "renderer_table": [
        Row(
            label={"trained_on": learned, "tested_on": seen},
            policies=(Training(world="microwave", sees=learned),),
            test=Trials(world="microwave"),
            visuals=seen,
        )
        for learned in VISUALS
        for seen in VISUALS
    ],
    "recovery_ablation": [
        Row(
            label={"recovery": world != "microwave"},
            policies=(Training(world=world),),
            test=Trials(world="microwave"),
        )
        for world in ("microwave", "microwave_recovery")
    ],
    "viewpoint_table": [
        Row(
            label={"moved_m": moved, "views_in_training": world != "microwave"},
            policies=(Training(world=world),),
            test=Trials(world="microwave", moved_m=moved),
        )
        for world in ("microwave", "microwave_views")
        for moved in MOVED_M
    ],
}


# Policies that are tested on the recorded video, by their training data.
FILMED: Final = {name: Training(world="microwave", sees=name, fixed_camera=True) for name in VISUALS}
VIDEO: Final = "video_error_mm"
# Categories of the finders whose errors in labelled images are measured, by table.
FINDERS: Final = {f"finder_error_mm.{category}": category for category in UNSEEN}
NOT_BY_DEFAULT: Final = (QUICK, "gpu.")


def chosen_tables(names: list[str]) -> list[str]:
    """Select tables by their names or prefixes; without names, all that a CPU can make in hours.

    Raises:
        ConfigError: There is no such table.
    """
    tables = [*TABLES, VIDEO, *FINDERS]
    for name in names:
        if not any(table.startswith(name) for table in tables):
            raise UnknownNameError("--cells", name, tables)
    if not names:
        return [table for table in tables if not table.startswith(NOT_BY_DEFAULT)]
    return [table for table in tables if table.startswith(tuple(names))]
