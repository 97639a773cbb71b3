import numpy as np
import pytest
from skimage.color import rgb2lab

from twin.naming.colours import COLOUR_NAMES, colour_name, lab_from_srgb, main_colour, near_colours


@pytest.mark.parity
def test_lab_is_that_of_scikit_image() -> None:
    colors = np.random.default_rng(0).uniform(size=(500, 3))
    np.testing.assert_allclose(lab_from_srgb(colors), rgb2lab(colors), atol=0.02)


def test_colours_outside_the_range_are_clipped() -> None:
    np.testing.assert_array_equal(
        lab_from_srgb(np.array([-0.2, 0.5, 1.7])), lab_from_srgb(np.array([0.0, 0.5, 1.0]))
    )


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((0, 0, 0), "black"),
        ((120, 122, 125), "grey"),
        ((250, 250, 245), "white"),
        ((200, 30, 35), "red"),
        ((120, 20, 20), "red"),
        ((235, 120, 25), "orange"),
        ((245, 205, 40), "yellow"),
        ((150, 125, 20), "yellow"),
        ((40, 130, 60), "green"),
        ((30, 150, 160), "cyan"),
        ((35, 80, 190), "blue"),
        ((20, 30, 90), "blue"),
        ((130, 40, 140), "purple"),
        ((240, 170, 190), "pink"),
        ((110, 75, 50), "brown"),
        ((143, 110, 79), "brown"),
        ((215, 190, 150), "beige"),
    ],
)
def test_people_would_agree_with_the_name(rgb: tuple[int, int, int], name: str) -> None:
    assert colour_name(np.array(rgb) / 255) == name


def test_every_colour_has_a_name() -> None:
    for color in np.random.default_rng(1).uniform(size=(300, 3)):
        assert colour_name(color) in COLOUR_NAMES


def test_a_thing_has_the_colour_of_its_colourful_part_unless_that_has_many() -> None:
    frame, seat, hues = np.full((61, 3), 0.9), np.array([0.6, 0.7, 0.1]), 0.8 * np.eye(3)
    np.testing.assert_allclose(main_colour(np.concatenate([frame, np.tile(seat, (30, 1))])), seat)
    np.testing.assert_allclose(main_colour(np.concatenate([frame, np.tile(hues, (20, 1))])), 0.9)
    np.testing.assert_allclose(main_colour(np.concatenate([frame, seat[None]])), 0.9)


def test_grey_is_white_in_other_light_and_beige_only_in_light_of_another_hue() -> None:
    in_light, near = near_colours((186, 172, 151))
    assert "white" in near_colours((185, 189, 195))[0]
    assert "white" in near - in_light
