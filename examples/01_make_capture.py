"""Make a capture with ground truth: python examples/01_make_capture.py FOLDER

Simulates a robot that opens a drawer, photographs the scene, films the demonstration and writes the folder that
`aomgen run` starts from, with `truth/` beside it.
"""

import argparse
from pathlib import Path

from aomgen.capture.read import read_capture
from aomgen.synthetic.scene_recording import Conditions
from aomgen.synthetic.world import make_capture


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--category", default="drawer")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scan-views", type=int, default=40)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    options = parser.parse_args()

    conditions = Conditions(size=tuple(options.size), scan_views=options.scan_views)
    make_capture(options.folder, category=options.category, seed=options.seed, conditions=conditions)

    capture = read_capture(options.folder)
    log = capture.joint_log
    seconds = log.times_s[-1] - log.times_s[0]
    print(f"{len(capture.scan_images)} scan images, {len(log.times_s)} joint readings over {seconds:.1f} s")
    assert len(capture.scan_images) == options.scan_views
    assert log.joints.shape == (len(log.times_s), 6)


if __name__ == "__main__":
    main()
