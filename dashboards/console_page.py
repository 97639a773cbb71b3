"""The operator's console: start, stop and answer the trials of a locked protocol, from a phone.

It asks the recorder by its control keys, as ``robot-gst ctl`` does, and says nothing of the twin.
"""

import hashlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response

from bridge.episode.metadata import Outcome
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.record.control import RecorderClient
from bridge.task.protocol import PlannedTrial
from bridge.wire.config import WireConfig
from bridge.wire.errors import RemoteError, WireError
from bridge.wire.session import WireSession, open_session
from dashboards.answers import kept, posted, refused
from dashboards.config import DashboardConfig
from dashboards.console_door import ConsoleDoor, Operator, locked_protocol
from dashboards.console_study import (
    NONE_DONE,
    NOT_EXECUTED,
    Answered,
    ConsoleStudy,
    TrialView,
)
from dashboards.errors import NotHereError
from dashboards.guard import CONSOLE_COOKIE
from dashboards.label_page import CAUSES, rater_name
from dashboards.live_page import CONNECT_S, LiveFeed, feed_of

MAX_BODY = 16_000
STATUS_S, COMMAND_S = 2.0, 60.0
"""How long the recorder is waited for, asked how it is and told to do something [s]."""
SESSION_S = 12 * 3600
"""A phone forgets its session after so long."""
Render = Callable[..., str]
"""Called with a template and its values."""


class RecorderLink:
    """Asks one recorder; the session is opened when first needed, and anew after a failure."""

    def __init__(
        self, wire: WireConfig, recorder: str, open_wire: Callable[..., WireSession] = open_session
    ) -> None:
        """Remember where it is."""
        self._wire, self._recorder, self._open = wire, recorder, open_wire
        self._session: WireSession | None = None
        self._lock = threading.Lock()

    def ask(self, command: Callable[[RecorderClient], Any], timeout_s: float = COMMAND_S) -> Any:
        """Send one command; several threads wait for each other.

        Raises:
            WireError: When nobody answers, or the recorder refuses.
        """
        with self._lock:
            if self._session is None:
                self._session = self._open(self._wire).__enter__()
            try:
                client = RecorderClient(self._session, self._recorder, timeout_s=timeout_s)
                return command(client)
            except RemoteError:
                raise
            except WireError:
                self._close()
                raise

    def _close(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            session.__exit__(None, None, None)

    def end(self) -> None:
        """Close the session."""
        with self._lock:
            self._close()


@dataclass(frozen=True, kw_only=True)
class ConsoleState:
    """What the console shows now."""

    kind: str
    """ready, recording, answer, done, or stuck: the recorder cannot be told to start."""
    trial: TrialView | None
    made: int
    total: int
    problem: str
    """Why the recorder is not to be had; empty where it is."""
    duration_s: float
    disk_free_gb: float | None
    answered: Answered | None
    """What was said before of the trial to answer; None of one that nobody said anything of."""
    last: Answered | None
    """The trial made last, where it was answered."""
    version: str
    """Of the answer that is shown."""
    camera: str
    """Whose live picture may be laid over the start's; empty without any."""


class ConsolePages:
    """Answers of the console for one run."""

    def __init__(
        self,
        run: RunFolder,
        door: ConsoleDoor,
        config: DashboardConfig,
        render: Render,
    ) -> None:
        """Ask nobody yet.

        Raises:
            UsageError: When the run has no protocol.
        """
        self._study = ConsoleStudy(run, locked_protocol(run.path))
        self._door, self._render = door, render
        wire = WireConfig(
            connect=config.connect, config=config.live_config, connect_timeout_s=CONNECT_S
        )
        self._link = RecorderLink(wire, config.recorder)
        self._recorder = config.recorder
        self._feed: LiveFeed = feed_of(config)
        self._acting = threading.Lock()

    def end(self) -> None:
        """Close what is open."""
        self._feed.end()
        self._link.end()

    def page(self, request: Request) -> Response:
        """``/console``: the console, or the form for a code."""
        operator = self._operator(request)
        if operator is None:
            return HTMLResponse(self._render("console_code.html"))
        return HTMLResponse(self._render("console.html", operator=operator))

    async def enter(self, request: Request) -> Response:
        """``POST /console/enter``: a code and a name against a session."""
        record = await posted(request, "a code", MAX_BODY)
        if isinstance(record, Response):
            return record
        try:
            name = rater_name(str(record.get("name", "")))
        except UsageError as error:
            return refused(400, str(error).replace("a rater's name", "a name"))
        operator = self._door.enter(str(record.get("code", ""))[:40], name)
        if operator is None:
            closed_s = self._door.closed_s()
            if closed_s:
                return refused(429, f"Too many wrong codes. Try again in {closed_s:.0f} s.")
            return refused(403, "That is not the code that the terminal shows now.")
        answer = JSONResponse({"name": operator.name})
        answer.set_cookie(
            CONSOLE_COOKIE,
            operator.session,
            max_age=SESSION_S,
            path="/console",
            httponly=True,
            samesite="strict",
        )
        return answer

    def state(self, request: Request) -> Response:
        """``/console/state?correct=``: what to show now."""
        operator = self._operator(request)
        if operator is None:
            return _entered_no_more()
        return JSONResponse(self._told(operator, request.query_params.get("correct", "")))

    async def act(self, request: Request) -> Response:
        """``POST /console/act``: start, stop, answer, or take the console over."""
        record = await posted(request, "a command", MAX_BODY)
        if isinstance(record, Response):
            return record
        return await run_in_threadpool(self._act, request, record)

    def start_picture(self, request: Request) -> Response:
        """``/console/start/<number>``: an earlier picture of a trial's start."""
        if self._operator(request) is None:
            return _entered_no_more()
        number = request.path_params["number"]
        return kept(*self._study.start_picture(number))

    def live_picture(self, request: Request) -> Response:
        """``/console/now/<camera>``: the camera's last picture."""
        data = None
        if self._operator(request) is not None:
            data = self._feed.preview(request.path_params["camera"])
        if data is None:
            message = "no picture of that camera was heard."
            raise NotHereError(message)
        return Response(data, media_type="image/jpeg")

    def _operator(self, request: Request) -> Operator | None:
        return self._door.operator(request.cookies.get(CONSOLE_COOKIE, ""))

    def _act(self, request: Request, record: Mapping[str, Any]) -> Response:
        operator = self._operator(request)
        if operator is None:
            return _entered_no_more()
        acts = {"start": self._start, "stop": self._stop, "answer": self._answer}
        try:
            if record.get("do") == "take":
                self._door.take(operator)
            elif record.get("do") not in acts:
                return refused(400, f"do is one of: take, {', '.join(acts)}.")
            else:
                with self._acting:
                    if self._door.holder() != operator:
                        raise _LateError("Another phone holds the console now.")
                    acts[str(record["do"])](record, operator)
        except _LateError as error:
            answer = {"message": str(error), **self._told(operator, "")}
            return JSONResponse(answer, status_code=409)
        except (GstError, OSError) as error:
            return refused(400 if isinstance(error, UsageError) else 502, str(error))
        return JSONResponse(self._told(operator, ""))

    def _start(self, record: Mapping[str, Any], operator: Operator) -> None:
        status = self._status()
        trial = self._study.next(self._study.made())
        name = "" if trial is None else self._study.episode_id(trial)
        if status["episode"] == name == record.get("trial"):
            return  # the answer to an earlier press was lost
        if trial is None or record.get("trial") != name or status["episode"]:
            raise _LateError("Something else is next by now; look again.")
        if self._study.unanswered(self._study.made()) is not None:
            raise _LateError("The trial before has no answer yet.")
        info, task = self._study.about(trial, operator.name)
        self._link.ask(lambda recorder: recorder.start(name, info, task))

    def _stop(self, record: Mapping[str, Any], operator: Operator) -> None:
        recording = self._status()["episode"]
        if recording is None and record.get("trial") in {e.id for e in self._study.entries()}:
            return
        if recording is None or recording != record.get("trial"):
            raise _LateError("That trial is not being recorded; look again.")
        self._link.ask(lambda recorder: recorder.stop())

    def _answer(self, record: Mapping[str, Any], operator: Operator) -> None:
        name = str(record.get("trial", ""))
        trial = self._trial_of(name)
        now = self._study.answered(name)
        if record.get("seen") != now.version:
            raise _LateError("Another answer was given meanwhile; look at it, then answer again.")
        self._study.answer(trial, record, operator.name)

    def _trial_of(self, episode_id: str) -> PlannedTrial:
        for number, entry in self._study.made().items():
            if entry.id == episode_id:
                return self._study.order[number - 1]
        message = f"no trial {episode_id!r} of the protocol was made."
        raise UsageError(message)

    def _status(self) -> dict[str, Any]:
        """Ask the recorder how it is.

        Raises:
            GstError: When nobody answers, it cannot record, or it records into another folder.
        """
        status: dict[str, Any] = self._link.ask(lambda recorder: recorder.status(), STATUS_S)
        where = Path(str(status.get("run", "")))
        if not may_write_into(where, self._study.run.path):
            message = f"The recorder writes into {where}, and this console is of another run."
            raise UsageError(message)
        if status.get("error"):
            message = f"The recorder cannot go on: {status['error']}"
            raise UsageError(message)
        return status

    def _state(self, correct: str) -> ConsoleState:
        study, problem = self._study, ""
        status: dict[str, Any] = {}
        try:
            status = self._status()
        except GstError as error:
            problem = str(error)
        made = study.made()
        recording = status.get("episode")
        open_, after = study.unanswered(made), study.next(made)
        last = self._last(made)
        kind, trial, name, answered = "done", after, "", None
        if recording is not None:
            expected = None if after is None else study.episode_id(after)
            kind, name = "recording", recording
            if recording != expected:
                kind, trial = "stuck", None
                problem = f"The recorder is busy with {recording}, which is not the next trial."
        elif correct and last is not None and correct == last.trial_id:
            kind, trial, name, answered = "answer", self._trial_of(correct), correct, last
        elif open_ is not None:
            kind, trial, name = "answer", open_[0], open_[1].id
        elif after is not None:
            kind, name = "stuck" if problem else "ready", study.episode_id(after)
        shown = answered or (study.answered(name) if kind == "answer" else None)
        free = status.get("disk_free_bytes")
        return ConsoleState(
            kind=kind,
            trial=None if trial is None else study.view(trial, name),
            made=len(made),
            total=len(study.order),
            problem=problem,
            duration_s=float(status.get("duration_s", 0.0)),
            disk_free_gb=None if not isinstance(free, int) else free / 1e9,
            answered=answered,
            last=last,
            version="" if shown is None else shown.version,
            camera=self._camera() if kind in ("ready", "stuck") else "",
        )

    def _last(self, made: Mapping[int, Any]) -> Answered | None:
        """Return the trial made last, where somebody answered it."""
        readable = [entry for entry in made.values() if not entry.error]
        if not readable:
            return None
        newest = max(readable, key=lambda entry: entry.start_ns)
        found = self._study.answered(newest.id)
        return None if found.outcome is None else found

    def _camera(self) -> str:
        """Listen on for a while, and return the camera that shows most."""
        if self._feed.enter():
            self._feed.leave()
        names = [name for name, _ in self._feed.state().previews]
        return min(names, key=lambda name: ("wrist" in name or "hand" in name, name), default="")

    def _told(self, operator: Operator, correct: str) -> dict[str, Any]:
        """What a phone is sent: the page's part, and a key that changes when it does."""
        state, holder = self._state(correct), self._door.holder()
        is_holder = holder == operator
        html = self._render(
            "console_state.html",
            state=state,
            holder=holder,
            is_holder=is_holder,
            causes=CAUSES,
            none_done=NONE_DONE,
            not_executed=NOT_EXECUTED,
            result_of=partial(_answer_words, is_blind=bool(self._study.protocol.codes)),
            recorder=self._recorder,
        )
        key = hashlib.sha256(html.encode()).hexdigest()[:16]
        return {"html": html, "key": key, "elapsed_s": state.duration_s, "kind": state.kind}


def _answer_words(outcome: Outcome, *, is_blind: bool) -> str:
    """Say an answer with a sign; to whom is blinded without its words, which may name the gate."""
    words = {"success": "✓ success", "failure": "✗ failure", "unknown": "? not known"}
    word = words.get(outcome.result, outcome.result)
    return f"{word}: {outcome.detail}" if outcome.detail and not is_blind else word


def may_write_into(told: Path, run_path: Path) -> bool:
    """Whether a recorder writes into a run; it may have been given a path from its own folder."""
    here = run_path.resolve()
    if told.is_absolute():
        return told.resolve() == here
    ending = [part for part in told.parts if part != ".."]
    return not ending or list(here.parts[-len(ending) :]) == ending


class _LateError(UsageError):
    """What a phone showed is no longer so."""


def _entered_no_more() -> Response:
    return refused(401, "This phone is not let in, or no longer: enter the code again.")
