"""A model on the loopback that answers well, badly, late or with malice."""

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from hostile_replies import put, valid_reply
from planned_start import problem_of_test

from bridge.errors import UsageError
from bridge.task.task_file import load_task
from twin.plan.config import PlanConfig
from twin.plan.constrain.bodies import Record
from twin.plan.constrain.reply import read_reply
from twin.plan.constrain.schema import Vocabulary
from twin.plan.ground.model_client import EndpointError, Messages, ask_model, chat

DATA = {"instruction": "put the cube away"}
QUESTION = chat("Reply with JSON.", DATA)
CUBE = Vocabulary.of_task(load_task("cube_into_box"))
PROBLEM = problem_of_test()
SECRET = "sk-very-secret-0123456789"
GOOD = json.dumps(valid_reply())
BAD = json.dumps(put(("goals", 0, "object"), "green_cube"))

Handler = Callable[[BaseHTTPRequestHandler, dict[str, Any]], None]


class Server:
    """What was asked of a server that answers as it is told to."""

    def __init__(self, url: str) -> None:
        """Nothing was asked yet."""
        self.url = url
        self.asked: list[dict[str, Any]] = []
        self.headers: list[dict[str, str]] = []
        self.paths: list[str] = []
        self.released = threading.Event()


@contextmanager
def serving(*answers: Handler) -> Iterator[Server]:
    """One handler for each request; the last one serves all later ones."""

    class Answering(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            length = int(self.headers["Content-Length"])
            body = json.loads(self.rfile.read(length))
            server.asked.append(body)
            server.headers.append(dict(self.headers))
            server.paths.append(self.path)
            handler = answers[min(len(server.asked), len(answers)) - 1]
            try:
                handler(self, body)
            except OSError:
                return  # the client has hung up

        def log_message(self, *args: Any) -> None:
            """Stay silent."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Answering) as listening:
        listening.daemon_threads = True
        server = Server(f"http://127.0.0.1:{listening.server_address[1]}/v1")
        Answering.released = server.released  # type: ignore[attr-defined]
        thread = threading.Thread(target=listening.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield server
        finally:
            server.released.set()
            listening.shutdown()
            thread.join()


def send(
    request: BaseHTTPRequestHandler,
    data: bytes,
    *,
    status: int = 200,
    kind: str = "application/json",
    **headers: str,
) -> None:
    request.send_response(status)
    request.send_header("Content-Type", kind)
    request.send_header("Content-Length", str(len(data)))
    for name, value in headers.items():
        request.send_header(name.replace("_", "-"), value)
    request.end_headers()
    request.wfile.write(data)


def says(text: str | None) -> Handler:
    """A chat completion with this text."""

    def answer(request: BaseHTTPRequestHandler, _: dict[str, Any]) -> None:
        message = {"role": "assistant", "content": text}
        send(request, json.dumps({"choices": [{"index": 0, "message": message}]}).encode())

    return answer


def sends(data: bytes, **options: Any) -> Handler:
    return lambda request, _: send(request, data, **options)


def ask(server: Server, question: Messages = QUESTION) -> tuple[Record, tuple[str, ...]]:
    config = PlanConfig(model=server.url, model_name="stub")
    return ask_model(question, config, lambda text: read_reply(text, CUBE, PROBLEM, {})[0])


def test_a_good_reply_is_the_models_answer() -> None:
    with serving(says(f"Here:\n```json\n{GOOD}\n```")) as server:
        reply, refused = ask(server)
    assert refused == ()
    assert [goal["kind"] for goal in reply["goals"]] == ["inside"]
    assert server.paths == ["/v1/chat/completions"]
    (body,) = server.asked
    assert (body["model"], body["temperature"]) == ("stub", 0)
    assert "Authorization" not in server.headers[0]


def test_a_picture_goes_along() -> None:
    with serving(says(GOOD)) as server:
        ask(server, chat("Reply with JSON.", DATA, b"\xff\xd8 picture"))
    words, picture = server.asked[0]["messages"][1]["content"]
    assert json.loads(words["text"]) == DATA
    assert picture["image_url"]["url"] == "data:image/jpeg;base64,/9ggcGljdHVyZQ=="


def test_two_repair_rounds_quote_the_errors() -> None:
    with serving(says(BAD), says("Sorry."), says(GOOD)) as server:
        _, refused = ask(server)
    *_, reply, request = server.asked[1]["messages"]
    assert reply == {"role": "assistant", "content": BAD}
    assert 'goals[0].object: "green_cube" is unknown. Known: cube.' in request["content"]
    assert "is not JSON" in server.asked[2]["messages"][-1]["content"]
    assert ["green_cube" in remark for remark in refused] == [True, False]


def test_three_bad_replies_end_it_with_the_reason() -> None:
    with serving(says(BAD)) as server, pytest.raises(UsageError) as caught:
        ask(server)
    assert len(server.asked) == 3
    assert caught.value.exit_code == 2
    assert '"green_cube" is unknown' in str(caught.value)
    assert "Nothing was planned" in str(caught.value)
    assert "\n" not in str(caught.value)


REFUSAL = {"choices": [{"message": {"content": None, "refusal": "I will not."}}]}


@pytest.mark.parametrize(
    ("handler", "told"),
    [
        (sends(b"<html><body>hello</body></html>", kind="text/html"), "completion: <html><body>"),
        (sends(b"{", status=200), "no chat completion"),
        (sends(b"[" * 100_000), "no chat completion"),
        (sends(b"\x1f\x8b\xff{}", Content_Encoding="gzip"), "no chat completion"),
        (sends(b"[]"), "no chat completion"),
        (sends(b'{"choices": []}'), "no chat completion"),
        (sends(b'{"choices": [{"message": [1]}]}'), "no chat completion"),
        (sends(b'{"error": {"message": "overloaded"}}', status=503), "status 503"),
        (sends(b"{}", status=401), "status 401"),
        (sends(json.dumps(REFUSAL).encode()), "its model refuses: I will not."),
        (says(None), "without text"),
        (sends(b"x" * 10_000_000), "more than 1000000 bytes"),
        (sends(b"", status=302, Location="http://127.0.0.1:9/v1"), "status 302"),
        (sends(b"", status=307, Location="https://example.org/"), "status 307"),
    ],
)
def test_a_server_that_is_none_is_said_to_be(handler: Handler, told: str) -> None:
    with serving(handler) as server, pytest.raises(EndpointError, match=told) as caught:
        ask(server)
    assert caught.value.exit_code == 1
    assert len(server.asked) == 1  # nothing is followed or tried again


def test_an_answer_that_ends_early_is_no_answer() -> None:
    def cut(request: BaseHTTPRequestHandler, _: dict[str, Any]) -> None:
        request.send_response(200)
        request.send_header("Content-Type", "application/json")
        request.send_header("Content-Length", "100000")
        request.end_headers()
        request.wfile.write(b'{"choices"')

    with serving(cut) as server, pytest.raises(EndpointError, match="no chat completion"):
        ask(server)


def waiting(request: BaseHTTPRequestHandler, _: dict[str, Any]) -> None:
    """Say nothing until the test is over."""
    request.released.wait()  # type: ignore[attr-defined]


def dripping(request: BaseHTTPRequestHandler, _: dict[str, Any]) -> None:
    """One byte after the other, each in time, all of them never."""
    request.send_response(200)
    request.send_header("Content-Type", "application/json")
    request.end_headers()
    while not request.released.wait(0.02):  # type: ignore[attr-defined]
        request.wfile.write(b" ")
        request.wfile.flush()


def dripping_headers(request: BaseHTTPRequestHandler, _: dict[str, Any]) -> None:
    request.wfile.write(b"HTTP/1.1 200 OK\r\nX-Slow: ")
    while not request.released.wait(0.02):  # type: ignore[attr-defined]
        request.wfile.write(b"a")
        request.wfile.flush()


@pytest.mark.parametrize("handler", [waiting, dripping, dripping_headers])
def test_a_slow_server_is_left_in_time(handler: Handler, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin.plan.ground.model_client.TOTAL_S", 0.3)
    with serving(handler) as server, pytest.raises(EndpointError, match="not answer in time"):
        ask(server)


def test_a_server_that_is_down_is_said_to_be() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(EndpointError, match="Connection refused"):
        ask(Server(f"http://127.0.0.1:{port}/v1"))


def test_a_key_comes_from_the_environment_and_is_shown_nowhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("GST_MODEL_KEY", SECRET)

    def echo(request: BaseHTTPRequestHandler, _: dict[str, Any]) -> None:
        told = {"error": f"not allowed: {request.headers['Authorization']}"}
        send(request, json.dumps(told).encode(), status=403)

    odd = json.dumps(put(("goals", 0, "object"), SECRET))
    with serving(echo, says(odd), says(GOOD), says(odd)) as server:
        with pytest.raises(EndpointError, match=r"\[redacted\]") as failed:
            ask(server)
        repaired = ask(server)
        with pytest.raises(UsageError, match=r"\[redacted\]") as refused:
            ask(server)
    assert server.headers[0]["Authorization"] == f"Bearer {SECRET}"
    assert "[redacted]" in repaired[1][0]
    assert SECRET not in repr((failed.value, repaired, refused.value))


@pytest.mark.parametrize("key", ["two words", "line\nbreak", "s\u00e4cret", "tab\tbed"])
def test_an_odd_key_is_refused_without_being_shown(
    monkeypatch: pytest.MonkeyPatch, key: str
) -> None:
    monkeypatch.setenv("GST_MODEL_KEY", key)
    with pytest.raises(UsageError, match="GST_MODEL_KEY is not a key") as caught:
        ask(Server("http://127.0.0.1:9/v1"))
    assert key not in str(caught.value)


def test_a_key_does_not_leave_unencrypted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GST_MODEL_KEY", SECRET)
    with pytest.raises(UsageError, match="without encryption") as caught:
        ask(Server("http://192.0.2.1/v1"))
    assert SECRET not in str(caught.value)


@pytest.mark.parametrize(
    "url",
    [
        *("localhost:8000", "file:///etc/passwd", "ftp://x/", "http://", "http://[::1"),
        *("http://a:b@host/v1", "http://host/v1?key=1", "http://host:99999/", "http://host/#a"),
    ],
)
def test_an_address_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(UsageError, match="address"):
        PlanConfig(model=url, model_name="stub")
