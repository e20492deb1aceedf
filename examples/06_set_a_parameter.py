"""What a parameter of a stage changes: python examples/06_set_a_parameter.py RUN NAME=VALUE

Runs the motion stage of a finished run again with a parameter changed, in a folder of its own, and prints both joints. `aomgen
run RUN --set NAME=VALUE` would do the same to the run itself, and make everything after it anew.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from aomgen.core.motion import MotionEstimate
from aomgen.core.progress import silent
from aomgen.io.schema import parse_setting
from aomgen.motion.stage import run
from aomgen.pipeline.project_file import read_project
from aomgen.pipeline.runner import results_of
from aomgen.pipeline.stages import PROJECT_FILE, STAGES
from aomgen.results import Results


def describe(motion: MotionEstimate) -> str:
    """One line about a joint."""
    joint = motion.joint
    travel = np.degrees(joint.upper) if joint.type == "revolute" else 1e3 * joint.upper
    return f"{joint.type}, axis {np.round(joint.axis, 4)}, moved {travel:.2f}, slip {1e3 * motion.slip_m.max():.1f} mm"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("setting", nargs="?", default="motion.joint.nodes=16")
    options = parser.parse_args()

    before: Results = results_of(read_project(options.run / PROJECT_FILE), STAGES)
    folder = options.run / "changed_motion"
    folder.mkdir(exist_ok=True)
    project = before.project.model_copy(update={"params": parse_setting(options.setting)})
    after = replace(before, project=project, out=folder, folders={**before.folders, "motion": folder})
    run(after, folder, silent)

    print(f"before  {describe(before.motion)}")
    print(f"after   {describe(after.motion)}")
    turned = np.arccos(np.clip(before.motion.joint.axis @ after.motion.joint.axis, -1, 1))
    assert before.motion.joint.type == after.motion.joint.type
    assert turned < before.motion.axis_ci95_rad + after.motion.axis_ci95_rad


if __name__ == "__main__":
    main()
