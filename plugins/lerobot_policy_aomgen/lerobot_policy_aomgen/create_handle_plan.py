"""Creation of a policy `handle_plan`: `python -m lerobot_policy_aomgen.create_handle_plan FINDER SUITE LIBRARY OUT`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION

from aomgen.errors import AomgenError, ConfigError
from aomgen.evaluation.suite import open_results, open_suite
from lerobot_policy_aomgen.configuration_handle_plan import HandlePlanConfig
from lerobot_policy_aomgen.modeling_handle_plan import HandlePlanPolicy
from lerobot_policy_aomgen.processor_handle_plan import make_handle_plan_pre_post_processors


def create_policy(finder: Path, suite: Path, library: Path, out: Path, cameras: Sequence[str] = ()) -> None:
    """Write a policy that `aomgen evaluate` runs as `lerobot:OUT`.

    Args:
        finder: File of a finder.
        suite: File of a suite, whose cameras and arm the policy uses.
        library: Folder of a run, see `HandlePlanConfig`.
        out: Folder of the policy.
        cameras: Names of the cameras that the policy uses, at least two; empty for all cameras of the suite.

    Raises:
        ConfigError: Suite and library have different arms or rates, or the actions of the suite are no joint targets.
        ValueError: A camera is unknown, or there are fewer than two.
        AomgenError: A file is missing or damaged.
    """
    trials, results = open_suite(suite)[0], open_results(library)
    if (trials.joint_names, trials.fps) != (tuple(results.robot.joint_names), round(results.fps)):
        raise ConfigError(
            library, f"has another arm or rate than {suite}", "name a run with the same recording"
        )
    if trials.action_space != "joint":
        raise ConfigError(suite, f"has actions {trials.action_space}", "make a suite with --actions joint")
    config = HandlePlanConfig(
        finder=str(finder),
        suite=str(suite),
        library=str(library.resolve()),
        cameras=list(cameras),
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
    parser.add_argument("finder", type=Path, help="finder.safetensors of `train_finder`")
    parser.add_argument("suite", type=Path, help="suite with the cameras and the arm of the policy")
    parser.add_argument("library", type=Path, help="run whose assets are the known objects")
    parser.add_argument("out", type=Path, help="folder of the policy")
    parser.add_argument(
        "--cameras",
        nargs="+",
        default=[],
        metavar="NAME",
        help="at least two cameras of the suite [default: all]",
    )
    given = parser.parse_args(arguments)
    try:
        create_policy(given.finder, given.suite, given.library, given.out, given.cameras)
    except AomgenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    except ValueError as error:
        parser.error(str(error))
    sys.stdout.write(f"wrote {given.out}: evaluate it with --policy lerobot:{given.out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
