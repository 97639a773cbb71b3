"""Follow one session: hear of trials, say what they settle, publish it, end on a signal."""

import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bridge.episode import schema
from bridge.episode.catalogue import Entry, list_episodes
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.record import parse_record
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.errors import WireError
from bridge.wire.qos import Qos
from bridge.wire.session import Subscriber, WireSample, WireSession, open_session
from evaluator.live.config import LiveConfig
from evaluator.live.ledger import Change, Ledger, LiveTrial, trial_of
from evaluator.live.next_start import NextStart, next_start
from evaluator.live.standing import Standing, standing_of
from evaluator.live.wording import change_line, record, state_lines

LISTING_PERIOD_S = 2.0
"""How often the run folder is looked at: labels given by hand are heard of nowhere else."""
LISTING_SHARE = 20
"""Looking takes at most one part in so many of the time, however many episodes there are."""
WAIT_S = 0.1
MAX_MESSAGE_BYTES = 1_000_000
MAX_WAITING = 10_000
"""Messages; more are dropped, for the folder holds every trial."""


def follow(
    run_path: Path,
    config: LiveConfig,
    *,
    goal: float | None,
    stop: threading.Event,
    output: Output,
) -> None:
    """Say after every trial what is settled, until ``stop`` is set; then print the state.

    Args:
        run_path: The run folder that is recorded into.
        config: Whom to listen to.
        goal: Success rate that is asked about, None for the gain with replanning only.
        stop: Set by a signal handler.
        output: How to talk.

    Raises:
        PathNotFoundError: When there is no such run folder.
        WireError: When no recorder listens there.
    """
    run = RunFolder.open(run_path)
    wire = WireConfig(connect=config.connect, config=config.zenoh_config)
    with open_session(wire) as session:
        topic = f"/rec/{config.recorder}/advice"
        publisher = session.publisher(topic, schema.ADVICE, qos=Qos.CONTROL)

        def publish(data: bytes) -> None:
            publisher.put(data, source_ns=session.now_ns())

        follower = Follower(run, publish, session.now_ns, goal=goal, output=output)
        subscriber = _subscribe(session, config.recorder, follower)
        try:
            follower.begin()
            while not stop.is_set():
                follower.step()
        finally:
            subscriber.close()
        follower.end()


def _subscribe(session: WireSession, recorder: str, follower: "Follower") -> Subscriber:
    key = f"rec/{recorder}/episode"
    return session.subscribe(key, follower.hear, max_bytes=MAX_MESSAGE_BYTES)


@dataclass(frozen=True)
class News:
    """What a recorder said of one episode."""

    run: str
    trial: LiveTrial | None


class Follower:
    """Keeps the ledger, and says what every change of it means. One thread calls ``step``."""

    def __init__(
        self,
        run: RunFolder,
        publish: Callable[[bytes], None],
        now_ns: Callable[[], int],
        *,
        goal: float | None,
        output: Output,
    ) -> None:
        """Begin knowing nothing."""
        self._run, self._publish, self._now_ns = run, publish, now_ns
        self._goal, self._output = goal, output
        self._ledger = Ledger()
        self._heard: queue.Queue[WireSample] = queue.Queue(MAX_WAITING)
        self._next_listing_s = 0.0
        self._said: set[str] = set()

    def hear(self, sample: WireSample) -> None:
        """Take a message on the network thread; never waits."""
        try:
            self._heard.put_nowait(sample)
        except queue.Full:
            self._next_listing_s = 0.0  # the folder knows what was dropped

    def begin(self) -> None:
        """Resume from what the run folder holds, and say so."""
        self._list(quiet=True)
        self._tell_state()

    def step(self) -> None:
        """Wait a moment for news; look at the folder when it is time."""
        try:
            sample = self._heard.get(timeout=WAIT_S)
        except queue.Empty:
            pass
        else:
            self._take(sample)
        if time.monotonic() >= self._next_listing_s:
            self._list(quiet=False)

    def end(self) -> None:
        """Look once more and print the state."""
        self._list(quiet=False)
        self._tell_state()

    def _take(self, sample: WireSample) -> None:
        news = read_news(sample.data)
        if news is None:
            self._once(f"a message on {sample.topic} cannot be read; it is left out")
            return
        if not _same_folder(news.run, self._run.path):
            self._once(f"the recorder writes to {news.run}, not to {self._run.path}; left out")
            return
        change = None if news.trial is None else self._ledger.take(news.trial)
        if change is not None and change.is_worth_saying:
            self._tell([change])

    def _list(self, *, quiet: bool) -> None:
        began_s = time.monotonic()
        try:
            entries = list_episodes(self._run)
        except (GstError, OSError) as error:
            self._once(f"{self._run.path} cannot be listed ({error}); trying again")
            self._next_listing_s = began_s + LISTING_PERIOD_S
            return
        trials = [trial for entry in entries if (trial := trial_of(entry)) is not None]
        changes, gone = self._ledger.take_listing(trials)
        took_s = time.monotonic() - began_s
        self._next_listing_s = began_s + max(LISTING_PERIOD_S, LISTING_SHARE * took_s)
        if quiet:
            return
        for trial in gone:
            self._output.say(f"{trial.episode} is no longer in the run folder; it counts no more")
        self._tell([change for change in changes if change.is_worth_saying])
        if gone:
            self._tell_state()

    def _tell(self, changes: list[Change]) -> None:
        if not changes:
            return
        standing, proposal = self._now()
        for change in changes:
            text = change_line(change, standing, proposal, self._goal)
            self._show(text, change, standing, proposal)

    def _tell_state(self) -> None:
        standing, proposal = self._now()
        text = "\n".join(state_lines(standing, proposal, self._goal))
        self._show(text, None, standing, proposal)

    def _now(self) -> tuple[Standing, NextStart | None]:
        trials = self._ledger.trials
        standing = standing_of(trials, self._goal)
        return standing, next_start(trials, standing)

    def _show(
        self, text: str, change: Change | None, standing: Standing, proposal: NextStart | None
    ) -> None:
        data = record(
            run=self._run.path.resolve().name,
            stamp_ns=self._now_ns(),
            text=text,
            change=change,
            standing=standing,
            proposal=proposal,
            goal=self._goal,
        )
        line = json.dumps(data)
        if self._output.json:
            sys.stdout.write(line + "\n")  # one line for each, so that a reader can follow
            sys.stdout.flush()
        else:
            self._output.result(data, text)
        try:
            self._publish(line.encode())
        except WireError as error:
            self._once(f"not published: {error}")

    def _once(self, remark: str) -> None:
        if remark not in self._said:
            self._said.add(remark)
            self._output.say(remark)


def read_news(data: bytes) -> News | None:
    """Read what a recorder said of one episode; None when it is not that."""
    try:
        said = parse_record(data, name="entry", package="bridge.episode")
        known = {name: said[name] for name in Entry.__dataclass_fields__ if name in said}
        known["tags"] = tuple(said.get("tags", ()))
        return News(str(said["run"]), trial_of(Entry(**known)))
    except (GstError, TypeError, KeyError):
        return None


def _same_folder(said: str, run: Path) -> bool:
    return Path(said).resolve() == run.resolve()
