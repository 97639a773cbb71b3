"""Mass from a name and a volume."""

import pytest

from twin.scene.shape.carve import ShapeError
from twin.scene.shape.files import mass_prior


@pytest.mark.parametrize(
    ("label", "material"),
    [
        ("sloth", "plush"),
        ("plush sloth", "plush"),
        ("duck_3", "hollow soft plastic"),
        ("five ducks", "hollow soft plastic"),
        ("Red cube", "plastic"),
        ("basket", "plastic"),
        ("kitchen sponge", "foam"),
        ("thing", "unknown"),
        ("", "unknown"),
    ],
)
def test_a_label_names_its_material(label: str, material: str) -> None:
    prior = mass_prior(label, 1e-4)
    assert prior.material == material
    assert prior.low_kg < prior.mass_kg < prior.high_kg
    assert prior.source


def test_mass_is_density_times_volume() -> None:
    prior = mass_prior("sloth", 5e-4)
    assert prior.mass_kg == pytest.approx(150.0 * 5e-4)
    assert mass_prior("sloth", 1e-3).mass_kg == pytest.approx(2 * prior.mass_kg)


@pytest.mark.parametrize("volume", [0.0, -1.0, float("nan"), float("inf")])
def test_a_volume_that_is_none_is_refused(volume: float) -> None:
    with pytest.raises(ShapeError, match="sloth"):
        mass_prior("sloth", volume)
