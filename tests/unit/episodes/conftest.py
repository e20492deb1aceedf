"""A drawer before the robot, and a demonstration that opens it."""

import pytest

from aomgen.core.demonstration import Demonstration
from aomgen.core.plan import FittedAsset
from aomgen.episodes.ik import IkSolver, ik_solver
from aomgen.robots.robot import RobotModel
from toy_drawer import fitted_drawer, opening


@pytest.fixture(scope="session")
def solver(robot: RobotModel) -> IkSolver:
    return ik_solver(robot)


@pytest.fixture(scope="session")
def fitted() -> FittedAsset:
    return fitted_drawer()


@pytest.fixture(scope="session")
def demo(solver: IkSolver, fitted: FittedAsset) -> Demonstration:
    return opening(solver, fitted)
