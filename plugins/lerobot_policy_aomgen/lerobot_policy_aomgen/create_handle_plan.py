"""Creation of a policy `handle_plan`: `python -m lerobot_policy_aomgen.create_handle_plan SUITE OUT --library RUN FINDER`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION

from aomgen.errors import AomgenError, ConfigError
from aomgen.evaluation.known_objects import KNOWN
from aomgen.evaluation.suite import open_results, open_suite
from lerobot_policy_aomgen.configuration_handle_plan import HandlePlanConfig
from lerobot_policy_aomgen.modeling_handle_plan import HandlePlanPolicy
from lerobot_policy_aomgen.processor_handle_plan import make_handle_plan_pre_post_processors


def create_policy(
    suite: Path,
    out: Path,
    libraries: Sequence[tuple[Path, Path]],
    cameras: Sequence[str] = (),
    known: int = KNOWN,
) -> None:
    """Write a policy that `aomgen evaluate` runs as `lerobot:OUT`.

    Args:
        suite: File of a suite, whose cameras and arm the policy uses.
        out: Folder of the policy.
        libraries: Folders of runs, and the file of the finder for the objects of each; see `HandlePlanConfig`.
        cameras: Names of the cameras that the policy uses, at least two; empty for all cameras of the suite.
        known: Number of parametric objects of each run's category that the policy knows besides the run's assets.

    Raises:
        ConfigError: Suite and libraries have different arms or rates, two libraries have the same instruction, or the actions
            of the suite are no joint targets.
        ValueError: A camera is unknown, or there are fewer than two.
        AomgenError: A file is missing or damaged.
    """
    trials, instructions = open_suite(suite)[0], dict[str, Path]()
    for library, _ in libraries:
        results = open_results(library)
        if (trials.joint_names, trials.fps) != (tuple(results.robot.joint_names), round(results.fps)):
            what = f"has another arm or rate than {suite}"
            raise ConfigError(library, what, "name runs of recordings with the same arm and rate")
        same = instructions.setdefault(results.recorded.instruction, library)
        if same != library:
            raise ConfigError(
                library, f"has the instruction of {same}", "give each capture another instruction"
            )
    if trials.action_space != "joint":
        raise ConfigError(suite, f"has actions {trials.action_space}", "make a suite with --actions joint")
    config = HandlePlanConfig(
        suite=str(suite),
        libraries=[str(library.resolve()) for library, _ in libraries],
        finders=[str(finder) for _, finder in libraries],
        cameras=list(cameras),
        known=known,
        device="cpu",
        output_features={ACTION: PolicyFeature(FeatureType.ACTION, (trials.action_size,))},
    )
    HandlePlanPolicy(config).save_pretrained(out)
    for processor in make_handle_plan_pre_post_processors(config):
        processor.save_pretrained(out)


def main(arguments: list[str] | None = None) -> int:
    """Create a policy and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m lerobot_policy_aomgen.create_handle_plan",
        description="Create a policy that locates an object with a finder and plans its opening.",
    )
    parser.add_argument("suite", type=Path, help="suite with the cameras and the arm of the policy")
    parser.add_argument("out", type=Path, help="folder of the policy")
    parser.add_argument(
        "--library",
        type=Path,
        nargs=2,
        action="append",
        required=True,
        dest="libraries",
        metavar=("RUN", "FINDER"),
        help="run with the demonstration, and finder.safetensors of `train_finder` for the objects of its category; repeatable: "
        "the instruction of an episode selects one",
    )
    parser.add_argument(
        "--cameras",
        nargs="+",
        default=[],
        metavar="NAME",
        help="at least two cameras of the suite [default: all]",
    )
    parser.add_argument(
        "--known",
        type=int,
        default=KNOWN,
        metavar="N",
        help="number of parametric objects that the policy knows besides the assets of a run; choosing them takes minutes, once "
        "for each run [default: %(default)s]",
    )
    given = parser.parse_args(arguments)
    sys.stderr.write("choosing the known objects of each run: minutes, unless its folder contains them\n")
    try:
        create_policy(given.suite, given.out, given.libraries, given.cameras, given.known)
    except AomgenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    except ValueError as error:
        parser.error(str(error))
    sys.stdout.write(f"wrote {given.out}: evaluate it with --policy lerobot:{given.out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
