"""Laws of matching masks, on observations made by hand: no drawing."""

from dataclasses import replace

import numpy as np
import pytest

from twin.naming.things import Instance
from twin.scene.semantics.masks import Observation, associate

NUM_SPLATS = 400
THINGS = {"cube": range(100), "duck": range(150, 230), "box": range(260, 400)}


def observation(
    rng: np.random.Generator, order: list[str], *, noise: float = 0.05, seen: float = 0.7
) -> Observation:
    """A frame that shows a random part of everything, its masks in a given order."""
    ids = np.flatnonzero(rng.uniform(size=NUM_SPLATS) < seen)
    inside = np.zeros((len(ids), len(order)), dtype=np.float32)
    for column, name in enumerate(order):
        inside[:, column] = np.isin(ids, np.array(THINGS[name]))
    inside = np.clip(inside + rng.normal(0, noise, inside.shape), 0, 1)
    return Observation(
        splat_ids=ids,
        weight=rng.uniform(0.5, 2.0, len(ids)).astype(np.float32),
        inside=inside.astype(np.float32),
        labels=tuple(order),
        scores=(0.9,) * len(order),
    )


def frames(count: int = 8, seed: int = 0) -> list[Observation]:
    rng = np.random.default_rng(seed)
    return [observation(rng, [str(n) for n in rng.permutation(list(THINGS))]) for _ in range(count)]


def run(observations: list[Observation]) -> tuple[Instance, ...]:
    tracks, labels = associate(observations, NUM_SPLATS)
    for number, track in enumerate(tracks, start=1):
        np.testing.assert_array_equal(labels == number, track.mask)
    return tracks


def by_label(tracks: tuple[Instance, ...]) -> dict[str, np.ndarray]:
    return {track.label: track.mask for track in tracks}


def test_things_are_found_whatever_the_order_of_the_masks() -> None:
    masks = by_label(run(frames()))
    assert masks.keys() == THINGS.keys()
    for name, members in THINGS.items():
        expected = np.isin(np.arange(NUM_SPLATS), np.array(members))
        assert (masks[name] == expected).mean() > 0.99


def test_the_order_of_frames_does_not_matter() -> None:
    first, second = run(frames()), run(frames()[::-1])
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.mask, other.mask)
        assert one.label == other.label


def test_dropped_masks_do_not_eat_the_edge() -> None:
    """Half the masks missing: with them counted as background, a thing would be on the brink."""
    items = frames(10)
    for index in (0, 3, 4, 7, 9):
        column = items[index].labels.index("cube")
        items[index].inside[:, column] = 0.0
    masks = by_label(run(items))
    expected = np.isin(np.arange(NUM_SPLATS), np.array(THINGS["cube"]))
    assert (masks["cube"] == expected).mean() > 0.99


def test_what_only_two_frames_claim_is_dropped() -> None:
    items = frames()
    for index in (1, 5):
        ghost = np.isin(items[index].splat_ids, np.arange(100, 150))
        items[index] = replace(
            items[index],
            inside=np.concatenate([items[index].inside, ghost[:, None]], axis=1, dtype=np.float32),
            labels=(*items[index].labels, "ghost"),
            scores=(*items[index].scores, 1.0),
        )
    found = run(items)
    assert "ghost" not in by_label(found)


def test_a_wrong_name_is_outvoted() -> None:
    items = frames()
    wrong = tuple("duck" if name == "box" else name for name in items[0].labels)
    items[0] = replace(items[0], labels=wrong)
    assert by_label(run(items)).keys() == THINGS.keys()


def test_a_thing_seen_in_few_frames_needs_masks_in_most_of_them() -> None:
    items = frames(8)
    for item in items[:5]:
        item.inside[:, item.labels.index("box")] = 0.0
    assert "box" not in by_label(run(items))
    items[4].inside[:, items[4].labels.index("box")] = items[5].inside.max() * np.isin(
        items[4].splat_ids, np.array(THINGS["box"])
    )
    assert "box" in by_label(run(items))


@pytest.mark.parametrize("observations", [[], frames(1)])
def test_too_few_frames_give_nothing(observations: list[Observation]) -> None:
    assert run(observations) == ()
