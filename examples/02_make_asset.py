"""Make an articulated object, check it, write it as USD and read it back: python examples/02_make_asset.py FILE.usda

The file carries meshes, colliders, masses, the joint with its limits, and the friction that verification assumes, so
that other simulators can load it.
"""

import argparse
from pathlib import Path

import numpy as np

import aomgen as ag


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--category", default="microwave")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()

    made = ag.Asset.make(options.category, options.seed)
    for finding in made.check():
        print(f"{finding.name:10} {finding.problem or finding.warning or finding.state}")
        assert not finding.problem
    made.save(options.file)

    read = ag.Asset.load(options.file)
    joint = read.joint
    print(f"{read.name}: {joint.type} about {np.round(joint.axis, 3)} through {np.round(joint.origin, 3)} m")
    assert joint.type == made.joint.type
    assert np.allclose(joint.axis, made.joint.axis, atol=1e-5)
    assert np.isclose(read.model.moving.mass, made.model.moving.mass, rtol=1e-4)


if __name__ == "__main__":
    main()
