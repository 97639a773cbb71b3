"""Sessions over real TCP on the loopback address."""

import queue
import threading
from pathlib import Path

import pytest

from bridge.episode import schema
from bridge.errors import UsageError
from bridge.wire import errors
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSample, WireSession, open_session


def test_samples_arrive_whole_and_in_order(router: WireSession, client: WireSession) -> None:
    got: list[WireSample] = []
    router.subscribe("cell/**", got.append)
    done = router.serve("cell/done", lambda payload: str(len(got)).encode())
    publisher = client.publisher("/cell/joint_states", schema.JOINT_STATE)
    for number in range(200):
        publisher.put(bytes([number]) * (number * 50), source_ns=1000 + number)
    # The request was sent after the samples, so all of them are there when it is answered.
    assert client.query("cell/done", b"", timeout_s=5.0) == b"200"
    done.close()
    assert [sample.sequence for sample in got] == list(range(200))
    assert [sample.source_ns for sample in got] == [1000 + number for number in range(200)]
    assert all(sample.data == bytes([n]) * (n * 50) for n, sample in enumerate(got))
    assert {sample.source_gid for sample in got} == {publisher.gid}
    assert {(sample.topic, sample.type_name, sample.message_encoding) for sample in got} == {
        ("/cell/joint_states", schema.JOINT_STATE, "cdr")
    }
    received = [sample.received_ns for sample in got]
    assert received == sorted(received)


def test_payloads_beyond_the_limit_are_told_of_and_not_copied(
    router: WireSession, client: WireSession
) -> None:
    got: list[WireSample] = []
    router.subscribe("cell/**", got.append, max_bytes=1000)
    done = router.serve("cell/done", lambda payload: b"")
    publisher = client.publisher("/cell/cam/a/color/image", schema.IMAGE)
    for size in (1000, 1001, 10):
        publisher.put(b"x" * size, source_ns=1)
    client.query("cell/done", b"", timeout_s=5.0)
    done.close()
    assert [(len(s.data), s.oversize_bytes, s.sequence) for s in got] == [
        (1000, 0, 0),
        (0, 1001, 1),
        (10, 0, 2),
    ]


def test_a_refusal_carries_the_message(router: WireSession, client: WireSession) -> None:
    def refuse(payload: bytes) -> bytes:
        raise UsageError(f"cannot do {payload.decode()}")

    router.serve("rec/x", refuse)
    with pytest.raises(errors.RemoteError, match="cannot do that"):
        client.query("rec/x", b"that", timeout_s=5.0)


def test_more_requests_than_may_wait_are_refused_at_once(
    router: WireSession, client: WireSession
) -> None:
    working, release = threading.Event(), threading.Event()

    def slow(payload: bytes) -> bytes:
        working.set()
        release.wait(10.0)
        return payload

    router.serve("cell/slow", slow, max_waiting=1)
    answers: list[bytes] = []
    refusals: queue.Queue[str] = queue.Queue()

    def ask() -> None:
        try:
            answers.append(client.query("cell/slow", b"plan", timeout_s=20.0))
        except errors.RemoteError as error:
            refusals.put(str(error))

    asking = [threading.Thread(target=ask) for _ in range(4)]
    asking[0].start()
    assert working.wait(5.0)
    for thread in asking[1:]:
        thread.start()
    for _ in range(2):  # one is in work, one waits: two are refused while it works
        assert "1 requests on cell/slow wait already" in refusals.get(timeout=5.0)
    release.set()
    for thread in asking:
        thread.join(10.0)
    assert answers == [b"plan", b"plan"]


def test_several_requests_are_answered_side_by_side_where_asked_for(
    router: WireSession, client: WireSession
) -> None:
    """Three handlers meet each other, which they could not one after another."""
    together = threading.Barrier(3, timeout=5.0)

    def handler(payload: bytes) -> bytes:
        together.wait()
        return payload

    service = router.serve("cell/meet", handler, side_by_side=3)
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    askers = [
        threading.Thread(
            target=lambda name=name: answers.put(client.query("cell/meet", name, timeout_s=5.0))
        )
        for name in (b"a", b"b", b"c")
    ]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join(10.0)
    assert sorted(answers.get(timeout=1.0) for _ in askers) == [b"a", b"b", b"c"]
    service.close()


def test_a_request_nobody_answers_is_reported(client: WireSession) -> None:
    with pytest.raises(errors.NoReplyError, match="nobody answered on rec/other"):
        client.query("rec/other", b"", timeout_s=0.5)


def test_no_peer_is_one_sentence(endpoint: str) -> None:
    config = WireConfig(connect=(endpoint,), connect_timeout_s=0.2)
    with pytest.raises(
        errors.NoPeerError, match=r"no zenoh peer at tcp/127.0.0.1:\d+; start robot-gst"
    ):
        open_session(config)


def test_a_taken_port_is_one_sentence(router: WireSession, endpoint: str) -> None:
    with pytest.raises(errors.PortTakenError, match="in use by another process"):
        open_session(WireConfig(mode="router", connect=(), listen=(endpoint,)))


def test_a_bad_endpoint_is_wrong_use() -> None:
    with pytest.raises(errors.WireConfigError, match="An endpoint looks like"):
        open_session(WireConfig(connect=("127.0.0.1:7447",)))


def test_a_bad_configuration_file_is_wrong_use(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    with pytest.raises(errors.WireConfigError, match="cannot be read"):
        open_session(WireConfig(config=path))
    path.write_text("{mode: 'nonsense'}")
    with pytest.raises(errors.WireConfigError, match="nonsense") as caught:
        open_session(WireConfig(config=path))
    assert ".rs:" not in str(caught.value)  # the library's own source paths help nobody


def test_a_configuration_file_does_not_turn_scouting_on(tmp_path: Path, endpoint: str) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text("{scouting: {multicast: {enabled: true}}, listen: {endpoints: ['tcp/[::]:0']}}")
    config = WireConfig(mode="router", connect=(), listen=(endpoint,), config=path)
    from bridge.wire.zenoh_config import zenoh_config

    made = zenoh_config(config)
    assert made.get_json("scouting/multicast/enabled") == "false"
    assert endpoint in made.get_json("listen/endpoints")
    assert "::" not in made.get_json("listen/endpoints")


def test_a_bad_topic_is_refused_when_announced(client: WireSession) -> None:
    with pytest.raises(errors.BadTopicError):
        client.publisher("/a//b", schema.STRING)
