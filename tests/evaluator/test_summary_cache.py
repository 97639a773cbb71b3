"""The cache of summaries: what is kept comes back as it was, and what is wrong is not believed."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluator import cache as cache_module
from evaluator.cache import SummaryCache, read_rows


@dataclass(frozen=True, kw_only=True)
class Inner:
    name: str
    pairs: tuple[tuple[str, bool | None], ...] = ()


@dataclass(frozen=True, kw_only=True)
class Owner:
    """A record that is always there, with another one inside."""

    text: str
    inner: Inner
    maybe: Inner | None = None
    count: int | None = None


@dataclass(frozen=True, kw_only=True)
class Everything:
    """One field of each sort that a summary may have."""

    text: str
    number: float
    count: int = 0
    answer: bool = False
    maybe: float | None = None
    unknown: bool | None = None
    curve_m: tuple[float, ...] = ()
    names: tuple[str, ...] | None = None
    inner: Inner | None = None
    places: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    cells: tuple[str | int | float | None, ...] = ()
    owner: Owner = Owner(text="", inner=Inner(name=""))


@dataclass(frozen=True, kw_only=True)
class Other:
    text: str


FULL = Everything(
    text='a "b" ✓\n',
    number=0.1,
    count=-(2**62),
    answer=True,
    maybe=1e-300,
    unknown=False,
    curve_m=(0.0, -0.0, 1.5),
    names=("x", ""),
    inner=Inner(name="i", pairs=(("grasp", True), ("place", None))),
    places={"cube": (0.1, 0.2, 0.3)},
    settings={"a": [1, {"b": None}]},
    cells=("x", 1, 1.0, None),
    owner=Owner(text="o", inner=Inner(name="p"), maybe=Inner(name="q"), count=3),
)

names = st.text(max_size=5).filter(lambda text: text.isprintable())
numbers = st.floats(allow_nan=False)
everything = st.builds(
    Everything,
    text=names,
    number=numbers,
    count=st.integers(-(2**63), 2**63 - 1),
    answer=st.booleans(),
    maybe=st.none() | numbers,
    unknown=st.none() | st.booleans(),
    curve_m=st.lists(numbers, max_size=4).map(tuple),
    names=st.none() | st.lists(names, max_size=3).map(tuple),
    inner=st.none() | st.builds(Inner, name=names),
    places=st.dictionaries(names, st.tuples(numbers, numbers, numbers), max_size=2),
    owner=st.builds(
        Owner,
        text=names,
        inner=st.builds(Inner, name=names),
        maybe=st.none() | st.builds(Inner, name=names),
        count=st.none() | st.integers(-9, 9),
    ),
)


def kept(folder: Path, rows: dict[str, tuple[Everything, ...]]) -> list[Any]:
    """Return what is found of some rows after they were written and read."""
    with SummaryCache(folder) as cache:
        for key, found in rows.items():
            cache.keep(Everything, key, found)
    return [SummaryCache(folder).find(Everything, key) for key in rows]


@given(rows=st.dictionaries(names, st.lists(everything, max_size=3).map(tuple), max_size=4))
def test_what_is_written_is_read_back_as_it_was(
    tmp_path_factory: pytest.TempPathFactory, rows: dict[str, tuple[Everything, ...]]
) -> None:
    back = kept(tmp_path_factory.mktemp("kept"), rows)
    assert back == list(rows.values())
    assert repr(back) == repr(list(rows.values()))  # 1 and 1.0 are not the same


def test_not_a_number_stays_not_a_number(tmp_path: Path) -> None:
    odd = Everything(text="x", number=math.nan, maybe=math.inf, curve_m=(math.nan, 1.0))
    ((back,),) = kept(tmp_path, {"k": (odd,)})
    assert math.isnan(back.number)
    assert back.maybe == math.inf
    assert math.isnan(back.curve_m[0])


def test_a_number_beyond_the_format_costs_only_its_own_place(tmp_path: Path) -> None:
    rows = {
        "huge": (Everything(text="x", number=0.0, count=2**70),),
        "broken text": (Everything(text="\ud800", number=0.0),),
        "\ud800": (FULL,),
        "good": (FULL,),
    }
    assert kept(tmp_path, rows) == [None, None, None, (FULL,)]


def test_no_flipped_bit_changes_an_answer(tmp_path: Path) -> None:
    kept(tmp_path, {f"key {i}": (FULL,) for i in range(20)})
    (path,) = tmp_path.iterdir()
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.choice(len(data), 150, replace=False):
        spoilt = bytearray(data)
        spoilt[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(spoilt)
        with pytest.raises(ValueError, match="damaged"):
            read_rows(path)


@pytest.mark.parametrize("damage", [b"", b"PAR1", b"nothing of ours" * 100])
def test_a_damaged_file_is_ignored_with_one_sentence_and_made_anew(
    tmp_path: Path, damage: bytes
) -> None:
    with SummaryCache(tmp_path) as cache:
        cache.keep(Everything, "k", (FULL,))
    (path,) = tmp_path.iterdir()
    path.write_bytes(damage)
    said: list[str] = []
    with SummaryCache(tmp_path, say=said.append) as cache:
        assert cache.find(Everything, "k") is None
        assert cache.kept_or_made(Everything, "k", lambda: (FULL,)) == (FULL,)
    assert len(said) == 1
    assert "The episodes are read again" in said[0]
    said.clear()
    with SummaryCache(tmp_path, say=said.append) as cache:
        assert cache.find(Everything, "k") == (FULL,)
    assert said == []
    assert len(list(tmp_path.iterdir())) == 1


def test_changed_code_forgets_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with SummaryCache(tmp_path) as cache:
        cache.keep(Everything, "k", ())
        assert cache.find(Everything, "k") == ()
    monkeypatch.setattr(cache_module, "code_version", lambda: b"tomorrow's")
    said: list[str] = []
    with SummaryCache(tmp_path, say=said.append) as cache:
        assert cache.find(Everything, "k") is None
        cache.keep(Everything, "k", (FULL,))
    assert "another version" in said[0]
    with SummaryCache(tmp_path) as cache:
        assert cache.find(Everything, "k") == (FULL,)


def test_what_raises_is_not_kept(tmp_path: Path) -> None:
    def fail() -> tuple[Other, ...]:
        raise KeyError("x")

    with SummaryCache(tmp_path) as cache, pytest.raises(KeyError):
        cache.kept_or_made(Other, "k", fail)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_said_once_and_nothing_else_happens(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "file" / "cache"
    (tmp_path / "file").write_text("not a folder")
    said: list[str] = []
    with SummaryCache(folder, say=said.append) as cache:
        for key in "abc":
            assert cache.kept_or_made(Other, key, lambda: (Other(text="x"),))
            cache.save()
    assert len(said) == 1
    assert "cannot be written" in said[0]


def test_what_is_gone_is_dropped(tmp_path: Path) -> None:
    with SummaryCache(tmp_path) as cache:
        for key in "abcdef":
            cache.keep(Other, key, (Other(text=key),))
    with SummaryCache(tmp_path) as cache:
        assert cache.find(Other, "a") == (Other(text="a"),)
    (path,) = tmp_path.iterdir()
    assert read_rows(path).keys() == {"a"}


def test_files_of_the_edition_before_are_ignored_and_removed(tmp_path: Path) -> None:
    old = tmp_path / f"Other.{'0' * 16}.parquet"
    old.write_bytes(b"PAR1")
    os.utime(old, (0, 0))
    said: list[str] = []
    with SummaryCache(tmp_path, say=said.append) as cache:
        assert cache.find(Other, "a") is None
    assert (said, list(tmp_path.iterdir())) == ([], [])


def test_an_interrupted_evaluation_drops_nothing(tmp_path: Path) -> None:
    with SummaryCache(tmp_path) as cache:
        for key in "abcdef":
            cache.keep(Other, key, ())

    def interrupted() -> None:
        with SummaryCache(tmp_path) as cache:
            cache.keep(Other, "g", ())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with SummaryCache(tmp_path) as cache:
        assert all(cache.find(Other, key) == () for key in "abcdefg")


def test_of_two_evaluations_at_once_the_later_one_stays_whole(tmp_path: Path) -> None:
    with SummaryCache(tmp_path) as first:
        first.keep(Other, "shared", (Other(text="s"),))
    first, second = SummaryCache(tmp_path), SummaryCache(tmp_path)
    for cache, own in ((first, "a"), (second, "b")):
        assert cache.find(Other, "shared") is not None
        cache.keep(Other, own, (Other(text=own),))
    first.close()
    second.close()
    third = SummaryCache(tmp_path)
    assert [third.find(Other, key) for key in ("shared", "a", "b")] == [
        (Other(text="s"),),
        None,
        (Other(text="b"),),
    ]
