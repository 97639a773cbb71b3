"""The page Live says what a recorder says, plainly when there is none, and only listens."""

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from live_recorder import open_recorder
from test_review_index import HOSTILE

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.run_folder import RunFolder
from bridge.media.color import encode_jpeg
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSession, open_session
from dashboards import live_page
from dashboards.config import DashboardConfig
from dashboards.library import Library
from dashboards.live_page import LiveFeed, LiveState, feed_of, told

WAIT_S = 15.0


@pytest.fixture
def feed(endpoint: str) -> Iterator[LiveFeed]:
    made = feed_of(DashboardConfig(connect=(endpoint,)))
    assert made.enter()
    yield made
    made.end()


def state_when(feed: LiveFeed, is_so: Callable[[LiveState], object]) -> LiveState:
    end_s = time.monotonic() + WAIT_S
    while not is_so(state := feed.state()):
        assert time.monotonic() < end_s, state
        time.sleep(0.02)
    return state


def say(session: WireSession, name: str, type_name: str, record: object) -> None:
    data = record if isinstance(record, bytes) else json.dumps(record).encode()
    publisher = session.publisher(name, type_name)
    end_s = time.monotonic() + WAIT_S
    while not publisher.has_subscribers():
        assert time.monotonic() < end_s
        time.sleep(0.02)
    publisher.put(data, source_ns=session.now_ns())


def test_a_recorder_is_heard_with_its_topics_pictures_and_losses(
    feed: LiveFeed, endpoint: str, tmp_path: Path, synthetic: ModuleType
) -> None:
    wire = WireConfig(mode="router", connect=(), listen=(endpoint,))
    with open_recorder(tmp_path / "run", wire=wire) as recorder:
        state_when(feed, lambda s: s.state == "idle")
        recorder.start("t1", cell="lab")
        with open_session(WireConfig(connect=(endpoint,))) as session:
            note = session.publisher("/lab/note", "odd/Type")
            camera = session.publisher("/lab/cam/side/color/image", schema.COMPRESSED_IMAGE)
            verdict = session.publisher("/lab/verdict", schema.VERDICT)
            verdict.put(
                synthetic.make_verdict("plan_7", False, "planned", "gate").to_json(),
                source_ns=session.now_ns(),
            )
            done = threading.Event()

            def speak() -> None:
                red = encode_jpeg(np.full((480, 640, 3), (200, 0, 0), np.uint8))
                while not done.wait(0.05):
                    ns = session.now_ns()
                    note.put(b"1", source_ns=ns)
                    image = CompressedColor(stamp_ns=ns, frame_id="c", format="jpeg", data=red)
                    camera.put(image.to_cdr(), source_ns=ns)

            speaking = threading.Thread(target=speak)
            speaking.start()
            try:
                state = state_when(
                    feed,
                    lambda s: (
                        s.state == "recording"
                        and s.previews
                        and any(line.rate_hz > 5 for line in s.topics)
                    ),
                )
            finally:
                done.set()
                speaking.join()
        assert "t1" in state.words
        lines = {line.topic: line for line in state.topics}
        assert lines["/lab/note"].lost == 0
        assert [name for name, _ in state.previews] == ["side"]
        assert (feed.preview("side") or b"").startswith(b"\xff\xd8")
        ((_, told_of),) = state.verdicts
        assert (told_of.plan_id, told_of.accepted) == ("plan_7", False)
        recorder.stop(result="success")
        assert recorder.status()["last_episode"] == "t1"


def test_what_is_silent_stands_first_and_what_is_no_record_is_counted(
    feed: LiveFeed, router: WireSession
) -> None:
    status = {
        "state": "recording", "episode": "e", "rates_hz": {"/a": 1e300, "/b": 2.0, "/z": 3.0},
        "seen": {"/a": 1, "/b": 5, "/z": 6}, "missing": ["/gone has not been seen", 7],
        "silent": [{"topic": "/z", "silent_s": 2.25}, "nonsense", {"silent_s": "x"}],
        "topics": {"/b": {"gaps": 2, "queue_drops": 1}}, "clocks": "none",
    }  # fmt: skip
    say(router, "/rec/main/status", schema.STATUS, status)
    state = state_when(feed, lambda s: s.is_heard)
    noted = [(line.topic, line.trouble) for line in state.topics]
    assert noted == [
        ("/b", "3 lost"),
        ("/gone", "not seen; the contract asks for it"),
        ("/z", "silent for 2.2 s"),
        ("/a", ""),
    ]
    assert "cannot be put into words" in state.words
    for name, type_name in (
        ("/rec/main/status", schema.STATUS),
        ("/lab/verdict", schema.VERDICT),
        ("/rec/main/preview/side", schema.COMPRESSED_IMAGE),
    ):
        say(router, name, type_name, b"\xff[1]")
    state = state_when(feed, lambda s: s.malformed == 3)
    assert state.is_heard
    assert not state.previews
    assert not state.verdicts


def test_without_a_recorder_and_after_it_left_it_is_said_plainly(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page, "RETRY_S", 0.05)
    monkeypatch.setattr(live_page, "QUIET_S", 0.5)
    feed = feed_of(DashboardConfig(connect=(endpoint,)))
    assert endpoint in feed.state().problem
    assert feed.enter()
    try:
        state = state_when(feed, lambda s: "no zenoh peer" in s.problem)
        assert not state.topics
        wire = WireConfig(mode="router", connect=(), listen=(endpoint,))
        with open_session(wire) as session:
            state_when(feed, lambda s: "no recorder named 'main' says anything" in s.problem)

            def is_heard(state: LiveState) -> bool:
                # Again and again, as a recorder does: what comes before the link is up is lost.
                say(session, "/rec/main/status", schema.STATUS, {"state": "idle"})
                return state.is_heard

            state_when(feed, is_heard)
        state = state_when(feed, lambda s: not s.is_heard)
        assert state.problem
    finally:
        feed.end()
    assert not feed.enter()


def test_a_session_is_open_only_while_somebody_looks(
    endpoint: str, router: WireSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page, "LINGER_S", 0.0)
    monkeypatch.setattr(live_page, "MOST_VIEWERS", 2)
    feed = feed_of(DashboardConfig(connect=(endpoint,)))
    status = router.publisher("/rec/main/status", schema.STATUS)
    assert not status.has_subscribers()
    assert feed.enter()
    assert feed.enter()
    assert not feed.enter()
    end_s = time.monotonic() + WAIT_S
    while not status.has_subscribers():
        assert time.monotonic() < end_s
        time.sleep(0.02)
    feed.leave()
    feed.leave()
    while status.has_subscribers():
        assert time.monotonic() < end_s
        time.sleep(0.02)
    feed.end()


def test_only_parts_that_changed_are_sent_and_a_viewer_too_many_is_told(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page, "PERIOD_S", 0.0)
    feed = feed_of(DashboardConfig(connect=(endpoint,)))
    shown = iter([{"a": 1, "b": 1}, {"a": 1, "b": 2}, {"a": 1, "b": 2}])
    left = iter([False] * 14 + [True] * 5)

    async def is_gone() -> bool:
        return next(left)

    async def hear() -> list[bytes]:
        return [event async for event in told(feed, lambda _: next(shown), is_gone)]

    events = asyncio.run(hear())
    assert [json.loads(e.removeprefix(b"data: ")) for e in events] == [
        {"a": 1, "b": 1},
        {"b": 2},
        {},
    ]
    monkeypatch.setattr(live_page, "MOST_VIEWERS", 0)
    assert asyncio.run(hear())[0].startswith(b"event: full")
    feed.end()


def test_the_page_is_there_without_a_recorder_and_hostile_words_are_text(
    shared_run: RunFolder, synthetic: ModuleType, endpoint: str, router: WireSession
) -> None:
    app = synthetic.create_app(
        Library.open([shared_run.path]), live=DashboardConfig(connect=(endpoint,))
    )
    browser: Any = synthetic.Browser(app)
    answer = browser.get("/live")
    assert answer.status_code == 200
    assert "no recorder heard" in answer.text
    assert browser.get("/live/preview/side").status_code == 404
    feed = app.state.pages._heard()
    assert feed.enter()
    try:
        status = {"state": HOSTILE, "seen": {HOSTILE: 1}, "episode": HOSTILE, "warnings": [HOSTILE]}
        say(router, "/rec/main/status", schema.STATUS, status)
        state_when(feed, lambda s: s.is_heard)
        text = browser.get("/live").text
        assert "<script>alert" not in text
        assert "&lt;script&gt;" in text
    finally:
        app.state.pages.end_live()
