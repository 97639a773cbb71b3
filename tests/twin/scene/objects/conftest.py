"""The sloth as a reconstructed shape, for tests of what belongs to it and what it leaves."""

import pytest

from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import load_task
from twin.scene.shape.reconstruct import ObjectShape, shape_of_mesh


@pytest.fixture(scope="session")
def shape() -> ObjectShape:
    """In the frame of the object, from the triangles of the task's mesh."""
    mesh = object_mesh(load_task("sloth_into_basket").objects["sloth"])
    return shape_of_mesh(mesh.vertices_m, mesh.triangles, mesh.vertices_m)
