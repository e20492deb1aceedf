"""Make an articulated object, check it, write it as USD and read it back: python examples/03_make_asset.py FILE.usda

The file carries meshes, colliders, masses, the joint with its limits, and the friction that verification assumes, so
that other simulators can load it.
"""

import argparse
from pathlib import Path

import numpy as np

from aomgen.assets.asset_check import check_asset
from aomgen.assets.choice import make_asset
from aomgen.assets.usd_read import read_usd
from aomgen.assets.usd_write import write_usd


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--category", default="microwave")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()

    made = make_asset(options.category, options.seed)
    problems = check_asset(made)
    assert problems == [], problems
    write_usd(made, options.file)

    read = read_usd(options.file)
    joint = read.joint
    print(f"{read.name}: {joint.type} about {np.round(joint.axis, 3)} through {np.round(joint.origin, 3)} m")
    assert joint.type == made.joint.type
    assert np.allclose(joint.axis, made.joint.axis, atol=1e-5)
    assert np.isclose(read.moving.mass, made.moving.mass, rtol=1e-4)


if __name__ == "__main__":
    main()
