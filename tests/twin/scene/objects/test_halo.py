"""What is left on the table when an object is taken out: no outline of it, and no made-up table."""

import numpy as np

from bridge.geometry import se3
from bridge.task.meshes.catalogue import object_mesh
from bridge.task.task_file import load_task
from twin.scene.gaussians import GaussianCloud, as_float32
from twin.scene.localise.mesh_fit import mesh_surface
from twin.scene.localise.result import LocalisedObject
from twin.scene.objects.assignment import assign_splats, hidden_table
from twin.scene.objects.decompose import split_objects
from twin.scene.shape.known import pose_of
from twin.scene.shape.reconstruct import ObjectShape

TASK = load_task("sloth_into_basket")
SLOTH = TASK.objects["sloth"]
T = pose_of(np.array([0.48, -0.17, SLOTH.rest_height_m, 0.3]))
WHITE = (0.9, 0.9, 0.88)


def cloud_of(points_m: np.ndarray, color: tuple[float, float, float] = WHITE) -> GaussianCloud:
    count = len(points_m)
    return GaussianCloud(
        means_m=as_float32(points_m),
        quats_wxyz=as_float32(np.tile([1.0, 0, 0, 0], (count, 1))),
        scales_log=as_float32(np.full((count, 3), np.log(0.002))),
        opacities_logit=as_float32(np.full(count, 2.0)),
        colors=as_float32(np.tile(color, (count, 1))),
    )


def toy_shifted(by_m: float) -> np.ndarray:
    """Points of the toy well above the table, where a camera with a wrong pose showed them."""
    mesh = object_mesh(SLOTH)
    points = se3.apply(T, mesh_surface(mesh.vertices_m, mesh.triangles, 3000).p_m)
    return points[points[:, 2] > 0.012] + np.array([by_m, 0.0, 0.0])


def test_what_a_wrong_camera_pose_shifted_by_a_centimetre_still_goes_with_the_toy(
    shape: ObjectShape,
) -> None:
    """White on purpose: a face has not the colour of its toy."""
    right, shifted = toy_shifted(0.0), toy_shifted(0.010)
    given = assign_splats(
        cloud_of(np.concatenate([right, shifted])), {"sloth": T}, TASK, {"sloth": shape}
    )
    assert (given[: len(right)] == 0).mean() > 0.99
    assert (given[len(right) :] == 0).mean() > 0.99


def test_a_mug_beside_the_toy_keeps_its_near_side(shape: ObjectShape) -> None:
    toy = toy_shifted(0.0)
    side = toy[np.argmax(toy[:, 0])]
    rng = np.random.default_rng(1)
    # A wall of Gaussians from 11 mm beside the toy's outermost point to 60 mm.
    mug = side + rng.uniform([0.011, -0.03, -0.005], [0.06, 0.03, 0.05], (2000, 3))
    mug = mug[mug[:, 2] > 0.012]
    given = assign_splats(
        cloud_of(np.concatenate([toy, mug])), {"sloth": T}, TASK, {"sloth": shape}
    )
    assert (given[: len(toy)] == 0).all()
    assert (given[len(toy) :] == -1).mean() > 0.98


def test_table_under_a_toy_is_dropped_and_filled_and_table_beside_it_is_kept(
    shape: ObjectShape,
) -> None:
    rng = np.random.default_rng(2)
    table = np.column_stack([rng.uniform([0.36, -0.29], [0.60, -0.05], (9000, 2)), np.zeros(9000)])
    table[:, 2] = rng.normal(-0.001, 0.002, 9000)
    on_top = table * [1, 1, 0]
    distance = shape.sdf.distance(se3.apply(se3.invert(T), on_top))
    toy = toy_shifted(0.0)
    cloud = cloud_of(np.concatenate([toy, table]))
    given = assign_splats(cloud, {"sloth": T}, TASK, {"sloth": shape})
    hidden = hidden_table(cloud, given, {"sloth": T}, {"sloth": shape}, TASK)[len(toy) :]
    stayed = given[len(toy) :] < 0
    assert hidden[stayed & (distance < 0.002)].all()
    assert not hidden[distance > 0.010].any()
    assert hidden.sum() > 100

    found = {
        "sloth": LocalisedObject(
            object_id="sloth",
            found=True,
            T_base_object=T,
            covariance=np.eye(6) * 1e-6,
            confidence=1.0,
            method="given",
            reason=None,
            stamp_ns=0,
        )
    }
    parts = split_objects(cloud, found, TASK, shapes={"sloth": shape})
    assert len(parts.background) == int((given < 0).sum() - hidden.sum())
    assert len(parts.filling) > 100
    assert np.abs(parts.filling.colors - np.array(WHITE)).max() < 1e-3


def test_what_a_shift_put_onto_the_table_in_the_toys_colour_is_dropped_too(
    shape: ObjectShape,
) -> None:
    rng = np.random.default_rng(3)
    table = np.column_stack([rng.uniform([0.36, -0.29], [0.60, -0.05], (9000, 2)), np.zeros(9000)])
    distance = shape.sdf.distance(se3.apply(se3.invert(T), table))
    ring = (distance > 0.005) & (distance < 0.014)
    brown = tuple(c / 255 for c in SLOTH.color_srgb)
    nobody = np.full(len(table), -1)
    for color, dropped in ((WHITE, False), (brown, True)):
        found = hidden_table(cloud_of(table, color), nobody, {"sloth": T}, {"sloth": shape}, TASK)
        # Beyond the grid of distances they are lower bounds: some are farther away than they say.
        assert (found[ring] == dropped).mean() > 0.97
        assert not found[distance > 0.016].any()
