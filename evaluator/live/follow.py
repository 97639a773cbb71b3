"""Follow one session: hear of trials, say what they settle, publish it, end on a signal.

Said is one line for each trial and the state in a few lines; published the same as records for
other programs.
"""

import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

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
from evaluator.live.session import (
    Change,
    GainSummary,
    LiveTrial,
    NextStart,
    RateSummary,
    SessionSummary,
    SessionTrials,
    next_start,
    summarise_session,
    trial_of,
)
from evaluator.statistics.sequential import Advice

SCHEMA_VERSION = 1


def outcome_word(trial: LiveTrial) -> str:
    """success, failure or unknown."""
    return {True: "success", False: "failure", None: "unknown"}[trial.recorded]


def label(task: str, condition: str, policy: str) -> str:
    """Return a group in a reader's words.

    Args:
        task: Task of the group; its underscores become spaces, as in the others.
        condition: Without or with replanning; empty leaves it out.
        policy: Policy of the group; empty leaves it out.
    """
    return ", ".join(part.replace("_", " ") for part in (task, condition, policy) if part)


def what_happened(change: Change) -> str:
    """trial_0007: success; or what was corrected, or labelled late."""
    trial, before = change.trial, change.before
    text = f"{trial.episode}: {outcome_word(trial)}"
    if before is None or before.recorded == trial.recorded:
        return text
    if before.recorded is None:
        return f"{text} (labelled late)"
    return f"{text} (corrected, was {outcome_word(before)})"


def advice_words(advice: Advice | None, changed: str, stop: str) -> str:
    """Stop, or continue: about n more.

    Args:
        advice: What the interval settles; None without a goal.
        changed: Why no interval is left; empty where there is one.
    """
    if changed:
        return f"stop: {changed}"
    if advice is None:
        return "continue: no --goal to decide"
    if advice.stop:
        return f"stop: {stop}"
    if advice.more_trials is None:
        return "continue: no end in sight at these rates"
    return f"continue: about {advice.more_trials} more"


def rate_words(rate: RateSummary, goal: float | None) -> str:
    """One group's rate, its interval at any time, and what follows.

    Args:
        goal: The success rate that is asked about, 0 to 1; None where none is.
    """
    percent = 0.0 if goal is None else 100 * goal
    answer = rate.advice.answer if rate.advice else ""
    words = advice_words(rate.advice, rate.changed, f"{answer} {percent:g} %")
    return (
        f"{label(rate.task, rate.condition, rate.policy)} {rate.k}/{rate.n} "
        f"[{100 * rate.low:.1f}, {100 * rate.high:.1f}] %: {words}"
    )


def gain_words(gain: GainSummary) -> str:
    """One paired gain, its interval at any time, and what follows."""
    better = {"above": "replanning helps", "below": "replanning harms"}
    words = advice_words(gain.advice, gain.changed, better.get(gain.advice.answer, ""))
    value = 100 * (gain.improved - gain.worsened) / gain.n
    return (
        f"gain {label(gain.task, '', gain.policy)} {value:+.0f} pp "
        f"[{100 * gain.low:+.1f}, {100 * gain.high:+.1f}] over {gain.n} pairs "
        f"({gain.improved} improved, {gain.worsened} worsened): {words}"
    )


def next_words(proposal: NextStart | None) -> str:
    """What to run next."""
    if proposal is None:
        return "next: nothing, every question is settled"
    start = "a start not tried yet" if proposal.start_id is None else f"start {proposal.start_id}"
    group = label(proposal.task, proposal.condition, proposal.policy)
    return f"next: {group}, {start} ({proposal.reason})"


def change_line(
    change: Change, summary: SessionSummary, proposal: NextStart | None, goal: float | None
) -> str:
    """Return the line of one trial.

    Args:
        change: The trial that is new, or corrected, and what was known of it before.
        proposal: Which start to run next; None when every question is settled.
        goal: The success rate that is asked about, 0 to 1; None where none is.
    """
    trial = change.trial
    rate, gain = summary.rate(trial.key), summary.gain(trial.task, trial.policy)
    parts = [what_happened(change)]
    parts += [rate_words(rate, goal)] if rate is not None else []
    parts += [gain_words(gain)] if gain is not None else []
    return "; ".join([*parts, next_words(proposal)])


def state_lines(
    summary: SessionSummary, proposal: NextStart | None, goal: float | None
) -> list[str]:
    """Everything that is known, one line for each group and gain.

    Args:
        proposal: Which start to run next; None when every question is settled.
        goal: The success rate that is asked about, 0 to 1; None where none is.
    """
    if not summary.rates:
        return [f"no trial with a known outcome yet ({summary.unknown} without)"]
    lines = [rate_words(rate, goal) for rate in summary.rates]
    lines += [gain_words(gain) for gain in summary.gains]
    if summary.unknown:
        lines.append(f"{summary.unknown} trials without a known outcome are part of nothing")
    return [*lines, next_words(proposal)]


def record(
    *,
    run: str,
    stamp_ns: int,
    text: str,
    change: Change | None,
    summary: SessionSummary,
    proposal: NextStart | None,
    goal: float | None,
) -> dict[str, Any]:
    """Return what is published, as ``advice.schema.json`` describes it.

    Args:
        change: The trial it is about; None for the state at the start and at the end.
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "stamp_ns": stamp_ns,
        "run": run,
        "text": text,
        "episode": None if change is None else change.trial.episode,
        "outcome": None if change is None else outcome_word(change.trial),
        "goal": goal,
        "rates": [asdict(rate) for rate in summary.rates],
        "gains": [asdict(gain) for gain in summary.gains],
        "unknown": summary.unknown,
        "next": None if proposal is None else asdict(proposal),
    }


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
        goal: Success rate that is asked about, None for the gain with replanning only.

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
class Update:
    """What a recorder said of one episode."""

    run: str
    trial: LiveTrial | None


class Follower:
    """Keeps all trials of a session, and says what each change means. One thread calls ``step``."""

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
        self._known = SessionTrials()
        self._heard: queue.Queue[WireSample] = queue.Queue(MAX_WAITING)
        self._next_listing_s = 0.0
        self._shown_once: set[str] = set()

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
        update = read_update(sample.data)
        if update is None:
            self._once(f"a message on {sample.topic} cannot be read; it is left out")
            return
        if not _same_folder(update.run, self._run.path):
            self._once(f"the recorder writes to {update.run}, not to {self._run.path}; left out")
            return
        change = None if update.trial is None else self._known.take(update.trial)
        if change is not None and change.changes_numbers:
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
        changes, gone = self._known.take_listing(trials)
        took_s = time.monotonic() - began_s
        self._next_listing_s = began_s + max(LISTING_PERIOD_S, LISTING_SHARE * took_s)
        if quiet:
            return
        for trial in gone:
            self._output.say(f"{trial.episode} is no longer in the run folder; it counts no more")
        self._tell([change for change in changes if change.changes_numbers])
        if gone:
            self._tell_state()

    def _tell(self, changes: list[Change]) -> None:
        if not changes:
            return
        summary, proposal = self._now()
        for change in changes:
            text = change_line(change, summary, proposal, self._goal)
            self._show(text, change, summary, proposal)

    def _tell_state(self) -> None:
        summary, proposal = self._now()
        text = "\n".join(state_lines(summary, proposal, self._goal))
        self._show(text, None, summary, proposal)

    def _now(self) -> tuple[SessionSummary, NextStart | None]:
        trials = self._known.trials
        summary = summarise_session(trials, self._goal)
        return summary, next_start(trials, summary)

    def _show(
        self, text: str, change: Change | None, summary: SessionSummary, proposal: NextStart | None
    ) -> None:
        data = record(
            run=self._run.path.resolve().name,
            stamp_ns=self._now_ns(),
            text=text,
            change=change,
            summary=summary,
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

    def _once(self, text: str) -> None:
        if text not in self._shown_once:
            self._shown_once.add(text)
            self._output.say(text)


def read_update(data: bytes) -> Update | None:
    """Read what a recorder said of one episode; None when it is not that."""
    try:
        record = parse_record(data, name="entry", package="bridge.episode")
        known = {name: record[name] for name in Entry.__dataclass_fields__ if name in record}
        known["tags"] = tuple(record.get("tags", ()))
        return Update(str(record["run"]), trial_of(Entry(**known)))
    except (GstError, TypeError, KeyError):
        return None


def _same_folder(folder: str, run: Path) -> bool:
    return Path(folder).resolve() == run.resolve()
