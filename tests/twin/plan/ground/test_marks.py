"""Numbers are drawn where things are seen, each readable, none over another."""

import numpy as np

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from twin.plan.ground.marks import draw_marks

CAMERA = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=160.0, cy=120.0)
T_BASE_CAMERA = se3.look_at(
    np.array([0.5, 0.0, 0.8]), np.array([0.5, 0.0, 0.0]), np.array([1.0, 0, 0])
)
GREY = np.full((240, 320, 3), 90, dtype=np.uint8)


def drawn(**middles_m: tuple[float, float, float]) -> tuple[np.ndarray, dict[str, int]]:
    places = {name: np.array(place) for name, place in middles_m.items()}
    GREY.flags.writeable = False
    return draw_marks(GREY, CAMERA, T_BASE_CAMERA, places)


def areas(image: np.ndarray) -> np.ndarray:
    return (image != 90).any(axis=2)


def test_a_mark_is_where_its_thing_is_seen() -> None:
    image, numbers = drawn(cube=(0.5, 0.1, 0.0))
    assert numbers == {"cube": 1}
    rows, columns = np.nonzero(areas(image))
    pixel, _ = CAMERA.project(se3.apply(se3.invert(T_BASE_CAMERA), np.array([0.5, 0.1, 0.0])))
    assert abs(columns.mean() - pixel[0]) < 3
    assert abs(rows.mean() - pixel[1]) < 3
    assert set(np.unique(image[areas(image)])) == {0, 255}


def test_what_is_not_seen_has_no_mark_and_keeps_its_number() -> None:
    _, numbers = drawn(behind=(0.5, 0.0, 2.0), aside=(3.0, 0.0, 0.0), cube=(0.5, 0.0, 0.0))
    assert numbers == {"cube": 3}
    _, numbers = drawn(lost=(np.nan, 0.0, 0.0), cube=(0.5, 0.0, 0.0))
    assert numbers == {"cube": 2}


def test_marks_on_one_spot_do_not_cover_each_other() -> None:
    one, _ = drawn(a=(0.5, 0.0, 0.0))
    image, numbers = drawn(a=(0.5, 0.0, 0.0), b=(0.5, 0.001, 0.0), c=(0.501, 0.0, 0.0))
    assert len(numbers) == 3
    assert areas(image).sum() >= 3 * areas(one).sum()


def test_numbers_look_different() -> None:
    many = {f"thing{index}": (0.5, 0.0, 0.0) for index in range(12)}
    alone = [
        draw_marks(
            GREY,
            CAMERA,
            T_BASE_CAMERA,
            {name: np.array((9.0, 9.0, 9.0)) for name in list(many)[:index]}
            | {"x": np.array([0.5, 0.0, 0.0])},
        )[0].tobytes()
        for index in range(12)
    ]
    assert len(set(alone)) == 12


def test_marks_at_the_edge_stay_in_the_image() -> None:
    image, numbers = drawn(corner=(0.5 + 0.31, 0.42, 0.0), other=(0.5 - 0.31, -0.42, 0.0))
    assert image.shape == GREY.shape
    assert len(numbers) == 2
