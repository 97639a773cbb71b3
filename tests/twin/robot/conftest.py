import pytest

from bridge.robots.default import ROBOT
from twin.robot.model import RobotModel, load_robot


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot(ROBOT.urdf_text())
