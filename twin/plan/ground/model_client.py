"""Ask a vision-language model what an instruction means, and believe none of it unjudged.

Requests go to an OpenAI-compatible server (``POST .../chat/completions``): the question with its
picture, then at most two more that quote what was wrong with the reply.
"""

import base64
import hashlib
import http.client
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from bridge.errors import UsageError
from bridge.task.model_policy import server_of
from bridge.whole_file import write_whole
from twin.errors import TwinError
from twin.plan.constrain.reply import MAX_BYTES, ReplyError
from twin.plan.constrain.schema import printable

Messages = list[dict[str, Any]]
Read = TypeVar("Read")
BY_MODEL, BY_REPAIR = "model", "model, repaired"
REPAIRS = 2
"""Replies that may be wrong before the last one is."""
KEY_VARIABLE = "GST_MODEL_KEY"
"""Environment variable with the key; not set: none is sent."""
CONNECT_S, TOTAL_S = 5.0, 60.0
"""Of one request: to connect, and until the last byte."""
MOST_ANSWER_BYTES = 1_000_000
"""Of the server's answer around the reply."""
_CHUNK = 64 * 1024
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_REFUSES_FORMAT = (400, 404, 415, 422, 501)
"""Statuses of servers that do not know ``response_format``, pictures or another field."""
_HINT = "Nothing was planned. Leave --model out to have the words read by fixed rules."


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Which model is asked, and how long."""

    url: str
    """Base address of an OpenAI-compatible server, such as http://127.0.0.1:8000/v1."""
    model: str
    cache: Path | None = None
    """Folder of replies that were taken, by the content of their request."""

    def __post_init__(self) -> None:
        """Refuse addresses that make no sense."""
        server_of(self.url)

    @property
    def key(self) -> str:
        """The key, or nothing."""
        key = os.environ.get(KEY_VARIABLE, "").strip()
        if key and not (key.isascii() and key.isprintable() and " " not in key):
            message = f"{KEY_VARIABLE} is not a key: it has spaces or odd characters."
            raise UsageError(message)
        return key


@dataclass(frozen=True, kw_only=True)
class Question:
    """What a model is asked."""

    rules: str
    data: Mapping[str, Any]
    """Instruction and scene: data, whoever wrote it."""
    picture_jpeg: bytes | None = None

    def messages(self) -> Messages:
        """As a chat."""
        parts: list[dict[str, Any]] = [{"type": "text", "text": json.dumps(self.data)}]
        if self.picture_jpeg is not None:
            coded = base64.b64encode(self.picture_jpeg).decode()
            address = {"url": f"data:image/jpeg;base64,{coded}"}
            parts.append({"type": "image_url", "image_url": address})
        return [{"role": "system", "content": self.rules}, {"role": "user", "content": parts}]


@dataclass(frozen=True, kw_only=True)
class Answer(Generic[Read]):
    """What was read in a reply, and whose it is."""

    read: Read
    answered_by: str
    remarks: tuple[str, ...] = ()
    """Whom was asked, and what was wrong with what came back."""


class EndpointError(TwinError):
    """A server that did not answer as one of its kind."""

    def __init__(self, *, address: str, found: str, status: int | None = None) -> None:
        """Remember what was found."""
        self.found, self.status = found, status
        super().__init__(f"the model server {address} {found}. Check that it runs. {_HINT}")


def ask_model(
    question: Question, config: ModelConfig, judge: Callable[[str], Read]
) -> Answer[Read]:
    """Get what a judge reads in a model's reply, or in its next ones."""
    remarks, problems = [f"asked {config.model} at {config.url}"], ""
    first = messages = question.messages()

    def answer(read: Read, who: str) -> Answer[Read]:
        told = tuple(_redacted(remark, config) for remark in remarks)
        return Answer(read=read, answered_by=who, remarks=told)

    if kept := _kept(config, first):
        remarks.append("the reply was kept from an earlier request with the same content")
        try:
            return answer(judge(kept[0]), kept[1])
        except ReplyError:
            remarks[-1] = "a kept reply fits no longer"
    for who in (BY_MODEL, *[BY_REPAIR] * REPAIRS):
        reply = _reply(messages, config, remarks)
        try:
            read = judge(reply)
        except ReplyError as error:
            problems = "; ".join(error.problems)
            remarks.append(f"refused a reply: {problems}")
            messages = _repair(first, reply, error)
            continue
        _keep(config, first, reply, who)
        return answer(read, who)
    found = f"gave no answer that can be used in {REPAIRS + 1} replies; the last: {problems}"
    raise UsageError(_redacted(f"{config.model} {found}. {_HINT}", config))


def _repair(messages: Messages, reply: str, error: ReplyError) -> Messages:
    listed = "\n".join(f"- {text}" for text in error.problems)
    return [
        *messages,
        {"role": "assistant", "content": printable(reply[:MAX_BYTES])},
        {
            "role": "user",
            "content": f"That reply cannot be used:\n{listed}\nReply with the whole corrected JSON "
            "object and nothing else.",
        },
    ]


# What comes back


def _reply(messages: Messages, config: ModelConfig, remarks: list[str]) -> str:
    """The model's text."""
    body = {
        "model": config.model,
        "messages": messages,
        "temperature": 0,
        "seed": 0,
        "response_format": {"type": "json_object"},
    }
    plain: dict[str, Any] = {"model": config.model, "messages": messages}
    in_words = plain | {"messages": _in_words(messages)}
    forms = [(body, "without a reply format"), (plain, "without the picture")]
    for form, what in forms if in_words != plain else forms[:1]:
        try:
            return _text_of(_post(form, config), config)
        except EndpointError as error:
            if error.status not in _REFUSES_FORMAT:
                raise
            remarks.append(f"the server {error.found}; asked again {what}")
    return _text_of(_post(in_words, config), config)


def _in_words(messages: Messages) -> Messages:
    """The same without pictures."""
    return [
        each
        if isinstance(parts := each["content"], str) or not any("image_url" in p for p in parts)
        else each | {"content": "\n".join(part["text"] for part in parts if "text" in part)}
        for each in messages
    ]


def _text_of(record: Any, config: ModelConfig) -> str:
    """The text of a chat completion."""
    try:
        message = record["choices"][0]["message"]
        text = message["content"]
    except (KeyError, IndexError, TypeError) as error:
        raise EndpointError(address=config.url, found="sent no chat completion") from error
    if isinstance(text, list):  # in parts, as some servers send it
        text = "".join(str(p.get("text", "")) for p in text if isinstance(p, dict))
    if isinstance(message.get("refusal"), str):
        refused = printable(message["refusal"][:200])
        raise EndpointError(address=config.url, found=f"says that its model refuses: {refused}")
    if not isinstance(text, str):
        raise EndpointError(address=config.url, found="sent a chat completion without text")
    return text


def _post(body: Mapping[str, Any], config: ModelConfig) -> Any:
    """Send one request and read its answer within all limits."""
    scheme, host, port, path = server_of(config.url)
    if config.key and scheme == "http" and host not in _LOOPBACK:
        message = (
            f"the key in {KEY_VARIABLE} would go to {host} without encryption. "
            "Use https, or unset it."
        )
        raise UsageError(message)
    data = json.dumps(body, separators=(",", ":")).encode()
    headers = {
        "Content-Type": "application/json",
        "Accept": "application/json",
        "Accept-Encoding": "identity",
        "Connection": "close",
    }
    if config.key:
        headers["Authorization"] = f"Bearer {config.key}"
    place = f"{path.rstrip('/')}/chat/completions"
    try:
        with _connected(scheme, host, port, config) as connection:
            connection.request("POST", place, body=data, headers=headers)
            with connection.getresponse() as response:
                answer = _read(response, config)
            status, kind = response.status, response.headers.get_content_type()
            onward = response.headers.get("Location", "")
    except EndpointError:
        raise
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise EndpointError(address=config.url, found=_failure(error, config)) from error
    if 300 <= status < 400:
        found = f"redirects to {printable(onward[:200])}, which is not followed"
        raise EndpointError(address=config.url, found=found, status=status)
    if status != http.client.OK:
        told = printable(answer[:200].decode(errors="replace"))
        found = _redacted(f"answers with status {status}: {told}", config)
        raise EndpointError(address=config.url, found=found, status=status)
    if kind != "application/json":
        found = f"answers with {printable(kind)[:80]}, not application/json"
        raise EndpointError(address=config.url, found=found)
    try:
        return json.loads(answer)
    except (ValueError, RecursionError) as error:
        raise EndpointError(address=config.url, found="answers with broken JSON") from error


@contextmanager
def _connected(
    scheme: str, host: str, port: int, config: ModelConfig
) -> Iterator[http.client.HTTPConnection]:
    """A connection that is cut when the time is up, whatever it waits for."""
    kind = http.client.HTTPSConnection if scheme == "https" else http.client.HTTPConnection
    connection, ends_s = kind(host, port, timeout=CONNECT_S), time.monotonic() + TOTAL_S
    with closing(connection):
        connection.connect()
        connection.sock.settimeout(TOTAL_S)
        timer = threading.Timer(max(ends_s - time.monotonic(), 0.0), _cut, (connection.sock,))
        timer.daemon = True
        timer.start()
        try:
            yield connection
        except (OSError, http.client.HTTPException) as error:
            if time.monotonic() >= ends_s:
                raise TimeoutError from error  # it was cut
            raise
        finally:
            timer.cancel()
        if time.monotonic() >= ends_s:
            raise TimeoutError


def _cut(link: socket.socket) -> None:
    with suppress(OSError):  # it may have ended by itself
        link.shutdown(socket.SHUT_RDWR)


def _read(response: http.client.HTTPResponse, config: ModelConfig) -> bytes:
    if response.headers.get("Content-Encoding", "identity") != "identity":
        raise EndpointError(address=config.url, found="answers compressed, which was not asked for")
    chunks, size = [], 0
    while chunk := response.read1(_CHUNK):
        size += len(chunk)
        if size > MOST_ANSWER_BYTES:
            found = f"answers with more than {MOST_ANSWER_BYTES} bytes"
            raise EndpointError(address=config.url, found=found)
        chunks.append(chunk)
    if response.length:
        raise http.client.IncompleteRead(b"", response.length)
    return b"".join(chunks)


def _failure(error: Exception, config: ModelConfig) -> str:
    if isinstance(error, TimeoutError):
        return f"did not answer in time ({CONNECT_S:g} s to connect, {TOTAL_S:g} s in all)"
    if isinstance(error, ConnectionRefusedError):
        return "refuses the connection"
    if isinstance(error, http.client.IncompleteRead | http.client.RemoteDisconnected):
        return "ended the connection before its answer did"
    return f"cannot be talked to ({printable(str(error)[:200]) or type(error).__name__})"


# What is kept


def _digest(config: ModelConfig, messages: Messages) -> str:
    asked = json.dumps([config.url, config.model, messages], sort_keys=True)
    return hashlib.sha256(asked.encode()).hexdigest()


def _kept(config: ModelConfig, messages: Messages) -> tuple[str, str] | None:
    """A reply to the same content, and who answered then; None: there is none."""
    if config.cache is None:
        return None
    try:
        with (config.cache / f"{_digest(config, messages)}.json").open("rb") as stream:
            record = json.loads(stream.read(8 * MAX_BYTES))
        reply, who = record["reply"], record["answered_by"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return (reply, who) if isinstance(reply, str) and who in (BY_MODEL, BY_REPAIR) else None


def _keep(config: ModelConfig, messages: Messages, reply: str, who: str) -> None:
    """Remember a reply that was taken; it is judged again when it is used."""
    if config.cache is not None:
        record = json.dumps({"answered_by": who, "reply": reply})
        config.cache.mkdir(parents=True, exist_ok=True)
        write_whole(config.cache / f"{_digest(config, messages)}.json", record.encode())


def _redacted(text: str, config: ModelConfig) -> str:
    for form in {config.key, json.dumps(config.key)[1:-1]} - {""}:
        text = text.replace(form, "[redacted]")
    return text
