"""Ask a vision-language model what an instruction means, and believe none of it unjudged.

Requests go to an OpenAI-compatible server (``POST .../chat/completions``): the question with its
picture, then at most two more that quote what was wrong with the reply.
"""

import base64
import http.client
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from typing import Any, TypeVar

from bridge.errors import UsageError
from bridge.task.model_policy import server_of
from twin.errors import TwinError
from twin.plan.config import PlanConfig
from twin.plan.constrain.reply import MAX_BYTES, ReplyError
from twin.plan.constrain.schema import printable

Messages = list[dict[str, Any]]
Read = TypeVar("Read")
REPAIRS = 2
"""Replies that may be wrong before the last one is."""
KEY_VARIABLE = "GST_MODEL_KEY"
"""Environment variable with the key; not set: none is sent."""
CONNECT_S, TOTAL_S = 5.0, 60.0
"""Of one request: to connect, and until the last byte."""
MOST_ANSWER_BYTES = 1_000_000
"""Of the server's answer around the reply."""
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_HINT = "Nothing was planned. Leave --model out to have the words read by fixed rules."


def chat(rules: str, data: Mapping[str, Any], picture_jpeg: bytes | None = None) -> Messages:
    """A question: the rules, and instruction and scene, which are data, whoever wrote them."""
    parts: list[dict[str, Any]] = [{"type": "text", "text": json.dumps(data)}]
    if picture_jpeg is not None:
        coded = base64.b64encode(picture_jpeg).decode()
        address = {"url": f"data:image/jpeg;base64,{coded}"}
        parts.append({"type": "image_url", "image_url": address})
    return [{"role": "system", "content": rules}, {"role": "user", "content": parts}]


class EndpointError(TwinError):
    """A server that did not answer as one of its kind."""

    def __init__(self, config: PlanConfig, found: str) -> None:
        """Say what was found, without the key."""
        told = printable(_redacted(found))
        super().__init__(f"the model server {config.model} {told}. Check that it runs. {_HINT}")


def ask_model(
    question: Messages, config: PlanConfig, judge: Callable[[str], Read]
) -> tuple[Read, tuple[str, ...]]:
    """Get what a judge reads in a model's reply, or in its next ones, and why others were refused.

    Args:
        config: Its address and its name.
    """
    messages, refused = question, list[str]()
    for _ in range(1 + REPAIRS):
        reply = _reply(messages, config)
        try:
            return judge(reply), tuple(refused)
        except ReplyError as error:
            refused.append(f"refused a reply: {'; '.join(error.problems)}")
            messages = _repair(question, reply, error)
    found = f"gave no answer that can be used in {REPAIRS + 1} replies; {refused[-1]}"
    raise UsageError(f"{config.model_name} {found}. {_HINT}")


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


def _reply(messages: Messages, config: PlanConfig) -> str:
    """The model's text in the server's chat completion."""
    body = {"model": config.model_name, "messages": messages, "temperature": 0}
    status, answer = _post(json.dumps(body, separators=(",", ":")).encode(), config)
    begin = answer[:200].decode(errors="replace")
    if status != http.client.OK:
        raise EndpointError(config, f"answers with status {status}: {begin}")
    if len(answer) > MOST_ANSWER_BYTES:
        raise EndpointError(config, f"answers with more than {MOST_ANSWER_BYTES} bytes")
    try:
        message = json.loads(answer)["choices"][0]["message"]
        text, refusal = message["content"], message.get("refusal")
    except (ValueError, RecursionError, LookupError, TypeError) as error:
        raise EndpointError(config, f"sent no chat completion: {begin}") from error
    if not isinstance(text, str):
        why = f": its model refuses: {refusal[:200]}" if isinstance(refusal, str) else ""
        raise EndpointError(config, f"sent a chat completion without text{why}")
    return _redacted(text)


def _key() -> str:
    """The key, or nothing."""
    key = os.environ.get(KEY_VARIABLE, "").strip()
    if key and not (key.isascii() and key.isprintable() and " " not in key):
        message = f"{KEY_VARIABLE} is not a key: it has spaces or odd characters."
        raise UsageError(message)
    return key


def _redacted(text: str) -> str:
    for form in {_key(), json.dumps(_key())[1:-1]} - {""}:
        text = text.replace(form, "[redacted]")
    return text


def _post(data: bytes, config: PlanConfig) -> tuple[int, bytes]:
    """Send one request; return status and body. It is cut when the time is up."""
    scheme, host, port, path = server_of(config.model)
    headers = {"Content-Type": "application/json", "Connection": "close"}
    if key := _key():
        if scheme == "http" and host not in _LOOPBACK:
            message = (
                f"the key in {KEY_VARIABLE} would go to {host} without encryption. "
                "Use https, or unset it."
            )
            raise UsageError(message)
        headers["Authorization"] = f"Bearer {key}"
    kind = http.client.HTTPSConnection if scheme == "https" else http.client.HTTPConnection
    connection, ends_s = kind(host, port, timeout=CONNECT_S), time.monotonic() + TOTAL_S
    try:
        with closing(connection):
            connection.connect()
            connection.sock.settimeout(TOTAL_S)
            timer = threading.Timer(TOTAL_S, _cut, (connection.sock,))
            timer.daemon = True
            timer.start()
            try:
                connection.request("POST", f"{path.rstrip('/')}/chat/completions", data, headers)
                response = connection.getresponse()
                answer = response.read(MOST_ANSWER_BYTES + 1)
            finally:
                timer.cancel()
        if time.monotonic() >= ends_s:
            raise TimeoutError
    except (OSError, http.client.HTTPException, ValueError) as error:
        late = isinstance(error, TimeoutError) or time.monotonic() >= ends_s
        found = f"did not answer in time ({CONNECT_S:g} s to connect, {TOTAL_S:g} s in all)"
        raise EndpointError(config, found if late else f"cannot be talked to: {error}") from error
    return response.status, answer


def _cut(link: socket.socket) -> None:
    with suppress(OSError):  # it may have ended by itself
        link.shutdown(socket.SHUT_RDWR)
