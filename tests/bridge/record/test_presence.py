"""Who is silent, by heartbeats: the clock is stepped by hand."""

from collections.abc import Callable

import pytest

from bridge.episode.contract import Contract, TopicRule
from bridge.record.presence import BEAT_S, DEAF_S, FIRST_BEAT_S, News, PresenceMonitor

JOINTS, COLOR, EVENTS = "/lab/joint_states", "/lab/cam/a/color/image", "/lab/event"


class Cell:
    """A monitor in a world whose time goes by heartbeats."""

    def __init__(self) -> None:
        """Begin at zero, recording."""
        self.time_s = 0.0
        self.counts: dict[str, int] = {}
        self.news: list[News] = []
        self.monitor = PresenceMonitor(
            lambda: dict(self.counts), tell=self.news.append, now_s=lambda: self.time_s
        )
        self.monitor.begin()

    def run(
        self, seconds: float, *, hearing: bool = True, beat_s: float = BEAT_S, **rates_hz: float
    ) -> None:
        """Let time pass while topics (joints, color, events) speak."""
        names = {"joints": JOINTS, "color": COLOR, "events": EVENTS}
        due = dict.fromkeys(rates_hz, 0.0)
        for _ in range(round(seconds / beat_s)):
            self.time_s += beat_s
            for name, rate_hz in rates_hz.items():
                due[name] += rate_hz * beat_s
                whole = int(due[name])
                due[name] -= whole
                self.counts[names[name]] = self.counts.get(names[name], 0) + whole
            self.monitor.tick()
            if hearing:
                self.monitor.heard()

    def silent(self) -> list[str]:
        return [silence.topic for silence in self.monitor.silences()]

    def kinds(self) -> list[str]:
        return [news.data["kind"] for news in self.news]


@pytest.fixture
def cell() -> Cell:
    return Cell()


def test_a_stream_that_stops_is_told_once_within_a_second_and_its_return_too(cell: Cell) -> None:
    cell.run(5.0, joints=500, color=30)
    assert not cell.silent()
    cell.run(0.5, color=30)
    assert not cell.news
    cell.run(0.5, color=30)
    assert cell.silent() == [JOINTS]
    assert cell.kinds() == ["silent"]
    assert cell.news[0].data["topic"] == JOINTS
    cell.run(2.0, color=30)
    assert cell.kinds() == ["silent"]
    cell.run(1.0, joints=500, color=30)
    assert cell.kinds() == ["silent", "back"]
    assert cell.news[1].data["silent_s"] == pytest.approx(3.0, abs=2 * BEAT_S)
    assert not cell.silent()


def test_a_recorder_that_stood_still_blames_nobody_but_itself(cell: Cell) -> None:
    cell.run(5.0, joints=500)
    cell.time_s += 5.0
    cell.run(0.5, joints=500)
    assert cell.kinds() == ["starved"]
    assert cell.monitor.status()["starved_s"] == pytest.approx(5.1)


def test_deafness_is_told_within_a_second(cell: Cell) -> None:
    cell.run(5.0, joints=500)
    cell.run(DEAF_S + 2 * BEAT_S, hearing=False)
    assert DEAF_S + 2 * BEAT_S < 1.0
    assert cell.kinds() == ["deaf"]


def test_slow_heartbeats_prove_little_silence(cell: Cell) -> None:
    """Law: time in which hearing is not proved is no silence: a loaded machine raises no alarm."""
    cell.run(5.0, joints=500)
    cell.run(2.4, beat_s=0.6)  # four beats only
    assert not cell.silent()


def test_where_the_network_returns_no_heartbeat_silences_are_seen_all_the_same(cell: Cell) -> None:
    cell.run(FIRST_BEAT_S + 5.0, hearing=False, joints=500)
    cell.run(1.0, hearing=False)
    assert cell.kinds() == ["silent"]
    assert cell.monitor.status()["deaf_s"] == 0.0


def test_what_was_silent_before_the_start_is_not_missed(cell: Cell) -> None:
    cell.monitor.end()
    cell.run(5.0, joints=500, color=30)
    cell.run(5.0, color=30)
    assert not cell.news  # nothing is recorded: nobody need be told
    cell.monitor.begin()
    cell.run(5.0, color=30)
    assert not cell.silent()
    cell.run(5.0, joints=500, color=30)
    cell.run(1.0, color=30)
    assert cell.silent() == [JOINTS]


def test_a_contract_decides_instead_of_habits(cell: Cell) -> None:
    rules = {
        JOINTS: TopicRule(rate_hz=500.0, silence_s=2.0),
        EVENTS: TopicRule(required=False),
        COLOR: TopicRule(rate_hz=30.0, silence_s=0.5),
    }
    cell.monitor.contract = Contract(topics=rules)
    missing = cell.monitor.missing(cell.monitor.contract)
    assert missing == [f"{JOINTS} has not been seen", f"{COLOR} has not been seen"]
    cell.run(1.0, joints=500, color=30, events=1)
    assert not cell.monitor.missing(cell.monitor.contract)
    cell.run(1.0)
    assert cell.silent() == [COLOR]
    cell.run(1.5)
    assert sorted(cell.silent()) == [COLOR, JOINTS]
    assert len(cell.monitor.missing(cell.monitor.contract)) == 2


@pytest.mark.parametrize(
    ("happen", "cause"),
    [
        (lambda monitor: monitor.publisher("/lab/", is_there=False), "its publisher left"),
        (lambda monitor: monitor.publisher("/other/", is_there=False), ""),
    ],
)
def test_what_else_is_known_is_given_as_the_cause(
    cell: Cell, happen: Callable[[PresenceMonitor], None], cause: str
) -> None:
    cell.run(5.0, joints=500)
    happen(cell.monitor)
    cell.run(1.0)
    (silence,) = cell.monitor.silences()
    assert silence.cause == cause
    assert str(silence).startswith(f"{JOINTS} silent for 1.0 s")
    assert (f"({cause})" in str(silence)) == bool(cause)
