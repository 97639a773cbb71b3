"""A task with soft objects is not replayed as something else: it says so."""

import pytest

from bridge.task.task_file import load_task
from twin.errors import TwinError
from twin.replay.scene import SoftBodiesError, refuse_soft


def test_a_task_with_soft_objects_is_not_evaluated_and_names_them() -> None:
    with pytest.raises(SoftBodiesError, match=r"^not evaluated: soft bodies .* 1 \(sloth\)"):
        refuse_soft(load_task("sloth_into_basket"))
    with pytest.raises(TwinError, match="duck_5"):
        refuse_soft(load_task("five_ducks_into_basket"))


def test_a_rigid_task_passes() -> None:
    refuse_soft(load_task("cube_into_box"))
