"""Effect of a parameter of a stage: python examples/04_set_a_parameter.py RUN FOLDER

Runs the motion stage again with another parameter in a copy of a finished run, and prints both joints. In place,
`aomgen run RUN --set motion.joint.nodes=16` does the same.
"""

import argparse
import shutil
from pathlib import Path

import numpy as np

import aomgen as ag


def describe(motion: ag.MotionEstimate) -> str:
    """Describe a joint in one line."""
    joint = motion.joint
    travel = np.degrees(joint.upper) if joint.type == "revolute" else 1e3 * joint.upper
    return f"{joint.type}, axis {np.round(joint.axis, 4)}, moved {travel:.2f}, slip {1e3 * motion.slip_m.max():.1f} mm"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()

    before = ag.Run.open(options.run)
    shutil.copytree(before.folder, options.folder)
    params = {"motion": {"joint": {"nodes": 16}}}
    after = ag.reconstruct(before.capture, options.folder, until="motion", params=params)

    print(f"before  {describe(before.motion)}")
    print(f"after   {describe(after.motion)}")
    turned = np.arccos(np.clip(before.motion.joint.axis @ after.motion.joint.axis, -1, 1))
    assert before.motion.joint.type == after.motion.joint.type
    assert turned < before.motion.axis_ci95_rad + after.motion.axis_ci95_rad


if __name__ == "__main__":
    main()
