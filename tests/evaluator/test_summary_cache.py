"""The cache of summaries: what is kept comes back as it was, and what is wrong is not believed."""

import math
import os
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluator import cache as cache_module
from evaluator.cache import MOST_FILES, SummaryCache
from evaluator.cache_file import UnusableFileError, read_summaries, write_summaries
from evaluator.memory import Packed


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
    packed_m: Packed = field(default_factory=lambda: array("d"))
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
    packed_m=array("d", (0.0, -0.0, 0.1)),
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
    packed_m=st.lists(numbers, max_size=4).map(lambda values: array("d", values)),
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


@given(
    rows=st.dictionaries(names, st.lists(everything, max_size=3).map(tuple), max_size=4),
)
def test_what_is_written_is_read_back_as_it_was(
    tmp_path_factory: pytest.TempPathFactory, rows: dict[str, tuple[Everything, ...]]
) -> None:
    path = tmp_path_factory.mktemp("kept") / "rows.parquet"
    assert write_summaries(path, Everything, rows, "v") == 0
    back = read_summaries(path, Everything, "v")
    assert back == rows
    assert repr(back) == repr(rows)  # 1 and 1.0 are not the same


def test_not_a_number_stays_not_a_number(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    kept = Everything(text="x", number=math.nan, maybe=math.inf, curve_m=(math.nan, 1.0))
    write_summaries(path, Everything, {"k": (kept,)}, "v")
    (back,) = read_summaries(path, Everything, "v")["k"]
    assert math.isnan(back.number)
    assert back.maybe == math.inf
    assert math.isnan(back.curve_m[0])


def test_a_number_beyond_the_columns_costs_only_its_own_place(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    rows = {
        "huge": (Everything(text="x", number=0.0, count=2**70),),
        "broken text": (Everything(text="\ud800", number=0.0),),
        "good": (FULL,),
    }
    assert write_summaries(path, Everything, rows, "v") == 2
    assert read_summaries(path, Everything, "v") == {"good": (FULL,)}


@pytest.mark.parametrize("kind", [Everything, Other])
def test_other_code_and_other_kinds_are_not_believed(tmp_path: Path, kind: type[Any]) -> None:
    path = tmp_path / "rows.parquet"
    write_summaries(path, Everything, {"k": (FULL,)}, "v1")
    said = "another version" if kind is Everything else "another program"
    with pytest.raises(UnusableFileError, match=said):
        read_summaries(path, kind, "v2")


def test_no_flipped_bit_changes_an_answer(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    rows = {f"key {i}": (FULL,) for i in range(20)}
    write_summaries(path, Everything, rows, "v")
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    believed = 0
    for place in rng.choice(len(data), 150, replace=False):
        spoilt = bytearray(data)
        spoilt[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(spoilt)
        try:
            assert read_summaries(path, Everything, "v") == rows
            believed += 1
        except UnusableFileError:
            continue
    assert believed < 75  # statistics and the like may flip unseen; most of the file is checked


@pytest.mark.parametrize("damage", [b"", b"PAR1", b"not parquet at all" * 100])
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
    monkeypatch.setattr(cache_module, "code_version", lambda: "tomorrow's")
    said: list[str] = []
    with SummaryCache(tmp_path, say=said.append) as cache:
        assert cache.find(Everything, "k") is None
        cache.keep(Everything, "k", (FULL,))
    assert "another version" in said[0]
    with SummaryCache(tmp_path) as cache:
        assert cache.find(Everything, "k") == (FULL,)


def test_a_fresh_cache_believes_nothing_and_keeps_what_is_made(tmp_path: Path) -> None:
    old, new = Other(text="old"), Other(text="new")
    with SummaryCache(tmp_path) as cache:
        cache.keep(Other, "k", (old,))
    with SummaryCache(tmp_path, fresh=True) as cache:
        assert cache.kept_or_made(Other, "k", lambda: (new,)) == (new,)
    with SummaryCache(tmp_path) as cache:
        assert cache.find(Other, "k") == (new,)
    assert len(list(tmp_path.iterdir())) == 1


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


def test_without_pyarrow_nothing_is_kept_and_somebody_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "evaluator.cache_file", raising=False)
    monkeypatch.delattr("evaluator.cache_file", raising=False)
    said: list[str] = []
    with SummaryCache(tmp_path / "cache", say=said.append) as cache:
        assert cache.kept_or_made(Other, "k", lambda: ()) == ()
        assert cache.find(Other, "k") is None
    assert said == [said[0]]
    assert "robot-gst[report]" in said[0]
    assert not (tmp_path / "cache").exists()


def test_files_of_many_evaluations_are_folded_and_what_is_gone_is_dropped(tmp_path: Path) -> None:
    for number in range(MOST_FILES + 3):
        with SummaryCache(tmp_path) as cache:
            for key in range(number + 1):
                cache.kept_or_made(Other, str(key), lambda key=key: (Other(text=str(key)),))  # type: ignore[misc]
        assert len(list(tmp_path.iterdir())) <= MOST_FILES
    with SummaryCache(tmp_path) as cache:
        assert cache.find(Other, "0") == (Other(text="0"),)
    (path,) = tmp_path.iterdir()
    assert set(read_summaries(path, Other, cache_module.code_version())) == {"0"}


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


def test_two_evaluations_at_once_lose_nothing(tmp_path: Path) -> None:
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
        (Other(text=text),) for text in ("s", "a", "b")
    ]


def test_files_folded_while_they_are_read_are_looked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for key in "ab":
        cache = SummaryCache(tmp_path)
        cache.keep(Other, key, ())
        cache.save()
    folder = cache_module.CacheFolder(tmp_path, print)
    listed = folder.files_of(Other)
    seen: list[list[Path]] = [listed]

    def list_them(kind: type[Any]) -> list[Path]:
        if len(seen) == 1:  # now another evaluation folds what was listed
            write_summaries(
                tmp_path / f"Other.{'0' * 16}.parquet",
                Other,
                {"a": (), "b": ()},
                cache_module.code_version(),
            )
            for path in listed:
                path.unlink()
            seen.append([])
            return listed
        return [tmp_path / f"Other.{'0' * 16}.parquet"]

    monkeypatch.setattr(folder, "files_of", list_them)
    assert folder.read(Other).rows == {"a": (), "b": ()}


KILLED = """
import sys
from pathlib import Path
from bridge.episode.metadata import EpisodeInfo
from evaluator.cache import SummaryCache
from evaluator.run_reader.episodes import RecordedFacts

cache = SummaryCache(Path(sys.argv[1]))
for number in range(10**9):
    info = EpisodeInfo(id=f"e{number}", kind="trial", tags=("x" * 2000,))
    cache.keep(RecordedFacts, f"k{number}", (RecordedFacts(info=info),))
    if number % 50 == 49:
        cache.save()
        print(number, flush=True)
"""


@pytest.mark.slow
def test_a_killed_evaluation_leaves_what_it_had_saved(tmp_path: Path) -> None:
    from evaluator.run_reader.episodes import RecordedFacts

    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        saved = [int(child.stdout.readline()) for _ in range(4)][-1]
        time.sleep(0.013)  # somewhere within the next file
        child.send_signal(signal.SIGKILL)
    stray = tmp_path / "RecordedFacts.0.parquet.part"
    stray.write_bytes(b"half")
    os.utime(stray, (0, 0))
    said: list[str] = []
    with SummaryCache(tmp_path, say=said.append) as cache:
        for number in range(saved + 1):
            found = cache.find(RecordedFacts, f"k{number}")
            assert found is not None
            assert found[0].info.id == f"e{number}"
    assert said == []
    assert not stray.exists()
