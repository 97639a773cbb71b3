"""The websocket protocol, against a server written from its description with ``msgpack``."""

import threading
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.sync.server import ServerConnection, serve

from twin.policies.errors import PolicyError
from twin.policies.openpi import KEY_VARIABLE, ServedPolicy, decode, encode

Answer = Callable[[bytes], bytes | str | Iterator[bytes]]


def pack(value: Any) -> bytes:
    """As openpi's server packs: arrays are maps with keys of bytes."""

    def array(item: Any) -> Any:
        return {
            b"__ndarray__": True, b"data": item.tobytes(), b"dtype": item.dtype.str,
            b"shape": item.shape,
        }  # fmt: skip

    return bytes(msgpack.packb(value, default=array))


def unpack(data: bytes) -> Any:
    def array(item: dict[Any, Any]) -> Any:
        if b"__ndarray__" not in item:
            return item
        return np.ndarray(buffer=item[b"data"], dtype=item[b"dtype"], shape=item[b"shape"])

    return msgpack.unpackb(data, object_hook=array)


@contextmanager
def listening(talk: Callable[[ServerConnection], None]) -> Iterator[str]:
    """A server on the loopback address; yields its address."""
    with serve(talk, "127.0.0.1", 0, compression=None, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def served(
    answer: Answer, metadata: bytes | str | None = b"\x80"
) -> Iterator[tuple[str, list[str]]]:
    """A server that answers; yields its address and the keys that were sent."""
    keys: list[str] = []

    def talk(socket: ServerConnection) -> None:
        assert socket.request is not None
        keys.append(socket.request.headers.get("Authorization", ""))
        if metadata is not None:
            socket.send(metadata)
        for message in socket:
            assert isinstance(message, bytes)
            socket.send(answer(message))

    with listening(talk) as address:
        yield address, keys


def test_a_thousand_frames_there_and_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEY_VARIABLE, "s3cret")
    rng = np.random.default_rng(0)
    sent: list[Any] = []

    def answer(data: bytes) -> bytes:
        sent.append(unpack(data))
        return pack({"actions": sent[-1]["state"] * 2, "server_timing": {"infer_ms": 1.5}})

    with served(answer, pack({"name": "stub", "chunk": 8})) as (address, keys):
        policy = ServedPolicy(address, 5.0)
        assert policy.metadata == {"name": "stub", "chunk": 8}
        assert keys == ["Api-Key s3cret"]
        for number in range(1000):
            state = rng.normal(size=(number % 5, 7)).astype(np.float32)
            image = rng.integers(0, 255, (12, 16, 3), dtype=np.uint8)
            found = policy.infer({"state": state, "image": image, "prompt": "put", "n": number})
            np.testing.assert_array_equal(found["actions"], state * 2)
            np.testing.assert_array_equal(sent[-1]["image"], image)
            assert sent[-1]["prompt"] == "put"
            assert sent[-1]["n"] == number
        policy.close()


def array(**change: object) -> bytes:
    fields = {"__ndarray__": True, "data": b"\0" * 24, "dtype": "<f8", "shape": [3]} | change
    return bytes(msgpack.packb({"actions": {k.encode(): v for k, v in fields.items()}}))


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\xc1", b"\x81", b"\x80\x80", b"\xdd\xff\xff\xff\xff", b"\x91" * 5000 + b"\x90",
        array(dtype="O"), array(dtype="|V8"), array(dtype="<c16"), array(dtype="<m8[ns]"),
        array(dtype="no type"), array(dtype=3), array(shape=[4]), array(shape=[-1, -1]),
        array(shape="3"), array(shape=[2**40]), array(data=b"\0" * 23), array(data=7),
        bytes(msgpack.packb({b"__ndarray__": True})), bytes(msgpack.packb([[[[]]]])) * 2,
    ],
)  # fmt: skip
def test_what_is_no_answer_is_refused(data: bytes) -> None:
    with pytest.raises(PolicyError):
        decode(data)


def test_every_cut_of_an_answer_is_refused() -> None:
    whole = pack({"actions": np.arange(14.0).reshape(2, 7), "t": 1})
    np.testing.assert_array_equal(decode(whole)["actions"], np.arange(14.0).reshape(2, 7))
    for end in range(len(whole)):
        with pytest.raises(PolicyError):
            decode(whole[:end])


def test_what_cannot_be_sent_is_not() -> None:
    for value in (np.array([None]), np.array([1j]), object()):
        with pytest.raises(TypeError):
            encode({"x": value})


def test_a_gigabyte_in_pieces_is_not_taken() -> None:
    sent = list[int]()

    def pieces(_: bytes) -> Iterator[bytes]:
        for number in range(1024):
            sent.append(number)
            yield bytes(1 << 20)

    tracemalloc.start()
    with served(pieces) as (address, _):
        policy = ServedPolicy(address, 20.0)
        for _ in range(2):
            with pytest.raises(PolicyError, match="closed the connection"):
                policy.infer({})
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(sent) < 128
    assert most < 160 << 20  # what is sent included


def test_an_answer_that_comes_in_drops_is_not_waited_for() -> None:
    gone = threading.Event()

    def drops(_: bytes) -> Iterator[bytes]:
        while not gone.wait(0.1):
            yield b"\x81"

    with served(drops) as (address, _):
        policy = ServedPolicy(address, 0.5)
        with pytest.raises(PolicyError, match=r"said nothing for 0\.5 s"):
            policy.infer({})
        gone.set()
        policy.close()


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        (None, r"said nothing for 0\.5 s"),
        ("no such key\n", "failed: no such key"),
        (b"\xc1", "that are no msgpack"),
        (bytes(65 << 20), "closed the connection"),
    ],
)
def test_a_server_that_does_not_say_who_it_is_is_left(
    metadata: bytes | str | None, words: str
) -> None:
    with served(lambda _: b"\x80", metadata) as (address, _):
        with pytest.raises(PolicyError, match=words):
            ServedPolicy(address, 0.5)
        left = [t for t in threading.enumerate() if "recv_events" in t.name]
        for thread in left:
            thread.join(10.0)
            assert not thread.is_alive()


def test_nobody_there() -> None:
    with served(lambda _: b"\x80") as (address, _):
        pass
    with pytest.raises(PolicyError, match="no policy answers at"):
        ServedPolicy(address, 2.0)
