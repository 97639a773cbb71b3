"""The recorder's control keys ``rec/<recorder>/ctl/<verb>``, JSON in and out.

Verbs: start, stop, mark, label, list, status. Each has its own thread, so that a status is never
behind a stop.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, replace
from typing import Any, TypeVar

import msgspec

from bridge.episode import metadata
from bridge.episode.run_folder import check_episode_id
from bridge.episode.topics import policy_key
from bridge.record.errors import ControlError
from bridge.record.recorder import Recorder
from bridge.task.record import check_record
from bridge.task.task_file import MAX_BYTES, TaskFile
from bridge.wire.errors import NoReplyError, WireError
from bridge.wire.session import Service, WireSession


def control_key(recorder: str, verb: str) -> str:
    """The key that one command of a recorder is sent to."""
    return f"rec/{recorder}/ctl/{verb}"


class RecorderClient:
    """Start, stop, mark, label and status of one recorder over the wire."""

    def __init__(
        self, session: WireSession, recorder: str = "main", *, timeout_s: float = 60.0
    ) -> None:
        """Choose the recorder by name."""
        self._session = session
        self._recorder = recorder
        self._timeout_s = timeout_s

    def ask(self, verb: str, request: dict[str, Any] | None = None) -> dict[str, Any]:
        """Send one command and return the recorder's answer."""
        key = control_key(self._recorder, verb)
        payload = json.dumps(request or {}).encode()
        answer = json.loads(self._session.query(key, payload, timeout_s=self._timeout_s))
        if not isinstance(answer, dict):
            raise WireError(f"{key} answered {answer!r:.80}, expected a JSON object.")
        return answer

    def start(
        self,
        episode_id: str,
        info: dict[str, Any] | None = None,
        task: TaskFile | None = None,
        *,
        anyway: bool = False,
    ) -> dict[str, Any]:
        """Begin an episode, with its task file where there is one."""
        sent = {} if task is None else {"task_file": task.data.decode()}
        request = {"id": episode_id, "info": info or {}, "anyway": anyway, **sent}
        return self.ask("start", request)

    def stop(
        self, outcome: dict[str, Any] | None = None, *, discard: bool = False
    ) -> dict[str, Any]:
        """Finish it after everything this session has sent so far."""
        return self.ask("stop", {"outcome": outcome, "discard": discard})

    def status(self) -> dict[str, Any]:
        """Ask what is going on."""
        return self.ask("status")


MAX_LISTED = 1000
RESULTS = ("success", "failure", "unknown")
Record = TypeVar("Record")


def serve_control(session: WireSession, recorder: Recorder) -> list[Service]:
    """Answer the control keys until the session closes."""
    begun: list[metadata.EpisodeInfo] = []

    def start(request: dict[str, Any]) -> dict[str, Any]:
        named = request.get("id")
        info = parse_info("new" if named is None else named, request.get("info", {}))
        if named is None:
            info = replace(info, id=recorder.run.free_id(info.kind))
        task = parse_task_file(request.get("task_file"))
        who_acts = _ask_policy(session, info)
        info = replace(info, tags=tuple(dict.fromkeys((*info.tags, *who_acts))))
        answer = recorder.start(info, task, anyway=request.get("anyway") is True)
        begun.clear()
        if who_acts:
            told = info.instruction or (task.task().instruction if task else "")
            about = {"episode": info.id, "instruction": told, "start_seed": info.start_seed}
            if _ask_policy(session, info, about):
                begun.append(info)
        return answer

    def stop(request: dict[str, Any]) -> dict[str, Any]:
        outcome = parse_outcome(request.get("outcome"))
        for info in begun:
            _ask_policy(session, info, {"over": info.id, "by": "operator"})
        begun.clear()
        return recorder.stop(outcome=outcome, discard=request.get("discard") is True)

    def label(request: dict[str, Any]) -> dict[str, Any]:
        episode = request.get("episode")
        return recorder.label(
            text=_text(request),
            outcome=parse_outcome(request.get("outcome")),
            episode=None if episode is None else check_episode_id(str(episode)),
        )

    verbs: dict[str, tuple[set[str] | None, Callable[[dict[str, Any]], dict[str, Any]]]] = {
        "start": ({"id", "info", "anyway", "task_file"}, start),
        "stop": ({"outcome", "discard"}, stop),
        "mark": ({"text"}, lambda request: recorder.mark(_text(request))),
        "label": ({"text", "outcome", "episode"}, label),
        "list": (None, lambda request: recorder.episodes(MAX_LISTED)),
        "status": (None, lambda request: recorder.status()),
    }
    return [
        session.serve(control_key(recorder.config.recorder, verb), _json_handler(verb, *how))
        for verb, how in verbs.items()
    ]


ASK_S = 10.0
"""A policy's runner says who acts and begins at once; nobody waits longer for it."""


def _ask_policy(
    session: WireSession, info: metadata.EpisodeInfo, about: Mapping[str, Any] | None = None
) -> tuple[str, ...]:
    """Ask the runner of an episode's policy who acts, let it begin, or stop it.

    Returns:
        Tags of the episode; none: nobody answers for the policy.
    """
    if info.kind != "trial" or not info.policy or not info.cell:
        return ()
    key, request = policy_key(info.cell, info.policy), {"policy": info.policy, **(about or {})}
    try:
        answer = json.loads(session.query(key, json.dumps(request).encode(), timeout_s=ASK_S))
        return tuple(map(str, answer["tags"]))
    except NoReplyError:
        return ()
    except (ValueError, TypeError, KeyError) as error:
        raise ControlError(f"what answers on {key} is no policy's runner ({error!r}).") from error


def _json_handler(
    verb: str, known: set[str] | None, act: Callable[[dict[str, Any]], dict[str, Any]]
) -> Callable[[bytes], bytes]:
    def handler(payload: bytes) -> bytes:
        try:
            request = json.loads(payload or b"{}")
        except (ValueError, RecursionError) as error:
            raise ControlError(f"{verb}: the request is not JSON ({error}).") from error
        if not isinstance(request, dict):
            raise ControlError(f"{verb}: the request must be a JSON object, got {request!r:.80}.")
        if known is not None:
            _only(request, verb, known)
        return json.dumps(act(request)).encode()

    return handler


def _only(request: dict[str, Any], verb: str, known: set[str]) -> None:
    unknown = sorted(set(request) - known)
    if unknown:
        raise ControlError(
            f"{verb} does not know {', '.join(unknown)}. It knows: {', '.join(sorted(known))}."
        )


def _text(request: dict[str, Any]) -> str:
    text = request.get("text", "")
    if not isinstance(text, str):
        raise ControlError(f"text must be a string, got {text!r:.80}.")
    return text


def parse_info(episode_id: Any, info: Any) -> metadata.EpisodeInfo:
    """Build the episode's description from a request; unknown fields are refused."""
    if not isinstance(episode_id, str):
        raise ControlError(f"start needs an episode id as a string, got {episode_id!r:.80}.")
    check_episode_id(episode_id)
    if not isinstance(info, dict):
        raise ControlError(f"info must be a JSON object, got {info!r:.80}.")
    values = {"kind": "trial", **info, "id": episode_id}
    made = _build(metadata.EpisodeInfo, values, "info")
    if made.schema_version != metadata.SCHEMA_VERSION:
        raise ControlError(
            f"info.schema_version {made.schema_version} is not the {metadata.SCHEMA_VERSION} "
            "that this recorder writes. Leave it out."
        )
    if made.kind not in metadata.KINDS:
        raise ControlError(f"kind {made.kind!r} is unknown. Kinds: {', '.join(metadata.KINDS)}.")
    if made.cell:
        check_episode_id(made.cell)  # becomes part of a topic
    return made


def parse_task_file(text: Any) -> TaskFile | None:
    """Check a task file that came with a request; None stays None."""
    if text is None:
        return None
    if not isinstance(text, str) or len(text) > MAX_BYTES:
        raise ControlError(f"task_file must be the text of a task file, at most {MAX_BYTES} bytes.")
    file = TaskFile(text.encode(errors="replace"), "the task file of the command")
    file.task()
    return file


def parse_outcome(outcome: Any) -> metadata.Outcome | None:
    """Build an outcome from a request; None stays None."""
    if outcome is None:
        return None
    made = _build(metadata.Outcome, outcome, "outcome")
    if made.result not in RESULTS:
        raise ControlError(f"result {made.result!r} is unknown. Results: {', '.join(RESULTS)}.")
    check_record(json.loads(json.dumps(asdict(made))), name="outcome")
    return made


def _build(of_type: type[Record], values: Any, what: str) -> Record:
    if not isinstance(values, dict):
        raise ControlError(f"{what} must be a JSON object, got {values!r:.80}.")
    _only(values, what, {item.name for item in fields(of_type)})  # type: ignore[arg-type]
    try:
        return msgspec.convert(values, of_type)
    except msgspec.ValidationError as error:
        raise ControlError(f"{what}: {error}.") from error
