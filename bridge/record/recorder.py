"""The recorder: messages and commands go in, episodes come out.

Network threads fill the queues, one thread for each image stream encodes, and one writer thread
does everything that touches the disk.
"""

import contextlib
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, replace

from bridge.clock import StepWatch
from bridge.episode import metadata
from bridge.episode.catalogue import label_episode, read_entry
from bridge.episode.contract import find_contract
from bridge.episode.run_folder import RunFolder, check_episode_id
from bridge.errors import BridgeError, GstError
from bridge.record.clocks import ClockBook
from bridge.record.config import RecorderConfig
from bridge.record.encoders import EncoderThreads, Preview
from bridge.record.errors import (
    ControlError,
    DiskError,
    LifecycleError,
    MissingTopicsError,
    cause_of,
)
from bridge.record.lifecycle import Answer, Lifecycle
from bridge.record.presence import News, PresenceMonitor
from bridge.record.queue import Command, Dropped, InputQueue, Item, Merge
from bridge.record.status import Status
from bridge.task.find import MissingTaskError, find_task_file, keep_task_file
from bridge.task.task_file import TaskFile
from bridge.wire.session import WireSample

POLL_S = 0.02
"""The writer looks for messages this often rather than being woken by each."""
IDLE_POLL_S = 0.1
BARRIER_POLL_S = 0.002
SECOND_S, LOOK_S = 1.0, 0.1  # LOOK_S: how often file and free space are looked at
MAX_NEWS = 1000
LAST_IMAGES_S = 2.0
"""How long a failed disk waits for images in the encoders, to count them."""


class Recorder:
    """Idle until ``start``; records one episode at a time into a run folder."""

    def __init__(
        self,
        run: RunFolder,
        *,
        now_ns: Callable[[], int],
        config: RecorderConfig | None = None,
        preview: Preview = lambda sample: None,
        task: TaskFile | None = None,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Start the writer thread."""
        self.config = config or RecorderConfig()
        self.failed = threading.Event()
        self._now_ns = now_ns
        self.run = run
        self._task = task
        self._encoders = EncoderThreads(self.config, self._take_back, preview)
        self.input_queue = InputQueue(self.config.queues, self._encoders.submit)
        self._merge = Merge(lambda: self._life.keeps_up)
        self._life = Lifecycle(
            run, self.config, lambda: self.input_queue.queued_bytes, self.input_queue.latched
        )
        self.presence = PresenceMonitor(self.input_queue.seen, tell=self.note)
        self.clocks = ClockBook(tell=self.note, write=self._write_clock)
        self._life.earlier_clocks = self.clocks.earlier
        self._life.answering = self.clocks.answering
        self.settle: Callable[[], None] = lambda: None
        """Asks publishers how many messages they have sent; what has not come is counted."""
        self.news: deque[str] = deque(maxlen=MAX_NEWS)
        """What a person should hear of at once, for one reader who takes it out."""
        self.news_arrived = threading.Event()
        """Set with each piece of news; for one waiter, who clears it."""
        self.read_contract()
        self._status = Status(
            run, self.config, self.input_queue, self._life, now_ns, self.presence.status
        )
        self._steps = StepWatch(now_ns, wall_ns=wall_ns)
        self._next_second_s = self._next_look_s = 0.0
        if self._life.is_quiet:
            self.input_queue.be_quiet(0)
        self._thread = threading.Thread(target=self._work, name="episode writer", daemon=True)
        self._thread.start()

    @property
    def error(self) -> DiskError | None:
        """What the disk said when it ended the recording."""
        return self._life.error

    @property
    def recording(self) -> str | None:
        """Id of the episode that is being recorded."""
        take = self._life.take
        return None if take is None else take.info.id

    def receive(self, sample: WireSample) -> None:
        """Take a message from the network; never waits."""
        self.input_queue.put(sample)

    def _take_back(self, item: Item, saved: int) -> None:
        self.input_queue.put_image(item, saved)

    def read_contract(self) -> None:
        """Read the contract of the cell anew; it may have been learned or edited."""
        contract = find_contract(self.run.path, self.config.contract)
        self._life.contract = self.presence.contract = contract

    def start(
        self, info: metadata.EpisodeInfo, task: TaskFile | None = None, *, anyway: bool = False
    ) -> Answer:
        """Begin an episode.

        Args:
            task: Its task file: attached to the episode, and kept in the run's ``tasks/``; looked
                up by the name in ``info`` when it is not given.
            anyway: Warn of topics that are required and missing, instead of refusing.

        Raises:
            UsageError: When the id is unsafe, taken, or another episode is being recorded.
            BridgeError: When the folder cannot be written, or has too little space.
        """
        check_episode_id(info.id)
        self.read_contract()
        task = self._task_of(info) if task is None else task
        info = described_by(info, task)
        missing = self.presence.missing(self._life.contract)
        if missing and not anyway:
            raise MissingTopicsError(episode=info.id, missing=missing)

        def act(command: Command) -> Answer:
            answer = self._life.start(info, command, task)
            if missing and self._life.take is not None:
                self._life.take.ledger.warn(f"started without what is required: {missing}")
            self.presence.begin(by_habit=not info.stand_in)
            return answer

        answer = {**self._command(act), **self._keep(task)}
        return {**answer, "missing": missing} if missing else answer

    def _task_of(self, info: metadata.EpisodeInfo) -> TaskFile | None:
        """The recorder's own task file, or the one there is of the name; None for other names."""
        if self._task is not None and info.task in ("", self._task.task().name):
            return self._task
        if not info.task:
            return None
        try:
            return find_task_file(info.task, tasks_dir=self.run.tasks_dir)
        except MissingTaskError:
            return None

    def _keep(self, task: TaskFile | None) -> Answer:
        """Copy the task file into the run, for people and for episodes without attachments."""
        if task is None:
            return {}
        name = task.task().name
        try:
            path = keep_task_file(self.run.tasks_dir, name, task.data)
        except OSError as error:  # the episode carries it all the same
            return {"task_file": None, "task_remark": f"tasks/ cannot be written: {error.strerror}"}
        answer = {"task_file": str(path)}
        if path.name != f"{name}.toml":
            answer["task_remark"] = (
                f"{name}.toml in {path.parent} is another file; kept as {path.name}"
            )
        return answer

    def note(self, news: News) -> None:
        """Tell people of something, and write it into the open episode."""
        self._say(news.text)

        def act(command: Command) -> None:
            take = self._life.take
            if take is not None and not self._life.is_finishing:
                stamp_ns = command.received_ns
                take.write_event("note", stamp_ns=stamp_ns, text=news.text, data=news.data)
                if news.warns:
                    take.ledger.warn(news.text)

        self._aside(act)

    def _write_clock(self, record: Answer) -> None:
        """Write a reading of a source's clock into the open episode."""

        def act(command: Command) -> None:
            take = self._life.take
            if take is not None and not self._life.is_finishing:
                take.write_clock(record, command.received_ns)

        if self._life.take is not None:
            self._aside(act)

    def _aside(self, act: Callable[[Command], None]) -> None:
        """Have the writer thread do something in its place; nobody waits for it."""
        command = Command(
            action=lambda command: self._guard(lambda: act(command)),
            received_ns=self._now_ns(),
            is_barrier=False,
        )
        self.input_queue.put_command(command)

    def stop(
        self,
        *,
        outcome: metadata.Outcome | None = None,
        discard: bool = False,
        reason: str = "command",
    ) -> Answer:
        """Finish the episode, or throw it away, after everything received so far."""
        if self._life.take is not None and not discard:
            self.settle()

        def act(command: Command) -> Answer:
            self.presence.end()
            return self._life.stop(outcome, command, discard=discard, reason=reason)

        return self._command(act)

    def _say(self, text: str) -> None:
        self.news.append(text)
        self.news_arrived.set()

    def mark(self, text: str) -> Answer:
        """Note this instant in the episode; does not wait for images in work."""
        return self._command(
            lambda command: self._life.event("mark", command, text, None), is_barrier=False
        )

    def label(
        self, *, text: str = "", outcome: metadata.Outcome | None = None, episode: str | None = None
    ) -> Answer:
        """Say how the open episode went, or, by its id, a finished one (kept under notes/)."""

        def act(command: Command) -> Answer:
            take = self._life.take
            if take is not None and episode in (None, take.info.id):
                return self._life.event("label", command, text, outcome)
            return {"finished": episode or self._life.last_episode}

        answer = self._command(act, is_barrier=False)
        if "finished" not in answer:
            return answer
        return self._label_finished(answer["finished"], text, outcome)

    def _label_finished(
        self, name: str | None, text: str, outcome: metadata.Outcome | None
    ) -> Answer:
        if name is None:
            raise LifecycleError("no episode has been recorded yet. Record one, or name one.")
        if outcome is None:
            raise LifecycleError(
                f"episode {name!r} is finished; only a result can be added to it. "
                "Give one: success, failure or unknown."
            )
        if text and not outcome.detail:
            outcome = replace(outcome, detail=text)
        note = label_episode(self.run, name, outcome)
        return {"ok": True, "episode": name, "note": str(note)}

    def episodes(self, last: int) -> Answer:
        """The last episodes of the run folder, by name."""
        paths = self.run.episodes()
        episodes = [asdict(read_entry(self.run, path)) for path in paths[-last:]]
        return {"ok": True, "of": len(paths), "episodes": episodes}

    def forget(self, prefix: str, but: tuple[str, ...] = ()) -> None:
        """Repeat no latched message of topics that begin so: their publisher has gone."""
        self._aside(lambda command: self._life.latched.forget(prefix, but))

    def also_tell(self, name: str, ask: Callable[[], object]) -> None:
        """Add something to every status and episode; ``ask`` must answer at once."""
        self._status.others[name] = ask
        self._life.others[name] = ask

    def status(self) -> Answer:
        """What is going on; answers at once, whatever the disk does."""
        return self._status.answer()

    def close(self, reason: str = "the recorder was stopped") -> Answer | None:
        """Finish the open episode, if any, and end all threads."""
        answer = None
        if self._life.take is not None and self.error is None:
            with contextlib.suppress(LifecycleError, DiskError):  # somebody was quicker
                answer = self.stop(reason=reason)
        self._life.is_closing = True
        self.input_queue.put_command(Command(action=lambda command: None, received_ns=0))  # wake up
        self._thread.join(timeout=self.config.command_timeout_s)
        self._encoders.close()
        return answer

    def _command(self, act: Callable[[Command], Answer], *, is_barrier: bool = True) -> Answer:
        if self.error is not None:
            raise self.error
        future: Future[Answer] = Future()

        def action(command: Command) -> None:
            try:
                if self.error is not None:
                    raise self.error
                future.set_result(act(command))
            except GstError as error:
                future.set_exception(error)
            except OSError as error:
                future.set_exception(self._fail(error))
            except Exception as error:  # noqa: BLE001  # a bug: tell the caller, keep recording
                future.set_exception(error)

        self.input_queue.put_command(
            Command(action=action, received_ns=self._now_ns(), is_barrier=is_barrier)
        )
        try:
            return future.result(timeout=self.config.command_timeout_s)
        except TimeoutError as error:
            raise BridgeError(
                f"the recorder did not finish within {self.config.command_timeout_s:g} s; "
                "the disk is too slow or the queue very long. Ask for its status."
            ) from error

    # Below: the writer thread.

    def _work(self) -> None:
        while True:
            if self._merge.is_waiting or self._life.is_closing:
                poll_s = BARRIER_POLL_S
            else:
                poll_s = IDLE_POLL_S if self._life.is_quiet else POLL_S
            self.input_queue.wait(poll_s)
            entries, images = self.input_queue.take()
            is_over = self._life.is_closing and not entries and not self._merge.is_waiting
            self._merge.feed(entries, images)
            self._drain()
            self._guard(self._tick)
            if is_over:
                self._life.end()
                return

    def _drain(self) -> None:
        for entry in self._merge.ready():
            self._status.beat()
            if isinstance(entry, Command):
                entry.action(entry)
                if self._life.is_quiet:
                    self.input_queue.be_quiet(entry.number)
                continue
            try:
                self._life.receive(entry)
            except OSError as error:
                self._fail(error)
            except Exception:  # noqa: BLE001  # a bug in one message, not the end
                traceback.print_exc()
            if isinstance(entry, Item):
                self.input_queue.release(entry)

    def _guard(self, act: Callable[[], None]) -> None:
        try:
            act()
        except OSError as error:
            self._fail(error)
        except Exception:  # noqa: BLE001  # a bug; recording goes on
            traceback.print_exc()

    def _tick(self) -> None:
        now_ns, now_s = self._now_ns(), time.monotonic()
        self._status.beat()
        self._life.tick(now_ns)
        if now_s >= self._next_second_s:
            self._next_second_s = now_s + SECOND_S
            self._status.second(now_ns)
            if step_ns := self._steps.step_ns():
                self._status.clock_steps += 1
                self._life.note_clock_step(step_ns, now_ns)
            for news in self._life.take_news():
                told = news.data
                if "topics" not in told or not self.clocks.has_named(told["topics"], told["by_ns"]):
                    self.note(news)
        if now_s >= self._next_look_s and self._life.may_ask_disk:
            self._next_look_s = now_s + LOOK_S
            if (cause := self._life.look_at_disk()) and not self._status.failing:
                self._end_because(cause)

    def _end_because(self, cause: str) -> None:
        """Finish the open episode behind everything received so far, and stop."""

        def act(command: Command) -> None:
            self._life.fail(cause, command.received_ns, list, in_reserve=True)
            self.failed.set()

        self._status.failing = cause
        self.input_queue.put_command(Command(action=act, received_ns=self._now_ns()))

    def _fail(self, error: OSError) -> DiskError:
        """End the recording."""
        cause = cause_of(error)
        if self._life.error is not None:
            return self._life.error
        self._status.failing = f"cannot write: {cause}. Finishing what there is."
        self._encoders.is_passing = True
        failure = self._life.fail(cause, self._now_ns(), self._rest)
        self.failed.set()
        return failure

    def _rest(self) -> list[Item | Dropped]:
        """What was received and not yet written, images in the encoders included."""
        end_s = time.monotonic() + LAST_IMAGES_S
        while True:
            self._merge.feed(*self.input_queue.take())
            if self._merge.images_seen == self.input_queue.images_in or time.monotonic() > end_s:
                return self._merge.rest()
            time.sleep(BARRIER_POLL_S)


def described_by(info: metadata.EpisodeInfo, task: TaskFile | None) -> metadata.EpisodeInfo:
    """Add to a description which task file the episode is recorded with."""
    if task is None:
        if info.task_sha256:
            raise ControlError(
                "task_sha256 is written by the recorder. Send the task file instead."
            )
        return info
    about = task.task()
    if info.task not in ("", about.name):
        raise ControlError(f"the episode's task is {info.task!r}, and the file's {about.name!r}.")
    if info.task_sha256 not in ("", task.sha256):
        raise ControlError(f"task_sha256 {info.task_sha256!r:.80} is not that of the task file.")
    instruction = info.instruction or about.instruction
    return replace(info, task=about.name, task_sha256=task.sha256, instruction=instruction)
