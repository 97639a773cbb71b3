"""Sessions over real TCP: what they publish and how, and what their errors keep secret."""

import queue
import threading
from pathlib import Path

import pytest
from patience import wait_until

from bridge.episode import schema
from bridge.errors import GstError, UsageError
from bridge.wire import errors, session
from bridge.wire import publisher as publishing
from bridge.wire.config import WireConfig
from bridge.wire.errors import NoPeerError, PortTakenError, WireConfigError
from bridge.wire.publisher import SharedPool
from bridge.wire.qos import Qos
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
    router: WireSession, client: WireSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "MAX_WAITING", 1)
    working, release = threading.Event(), threading.Event()

    def slow(payload: bytes) -> bytes:
        working.set()
        release.wait(10.0)
        return payload

    router.serve("cell/slow", slow)
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


SECRET = "hunter2secret"
USER = "transport: {auth: {usrpwd: {user: 'u', password: "


def everything_said(error: BaseException | None) -> str:
    """The error and all that a traceback would show with it."""
    said = []
    while error is not None:
        said.append(f"{error}")
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return "\n".join(said)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (f"{{{USER}'{SECRET}}}}}}}}}", "line 1, column"),
        (f"{{\n{USER}\n'{SECRET}' oops}}}}}}}}", "line 3, column"),
        (f"{{transport: {{auth: {{usrpwd: '{SECRET}'}}}}}}", "line 1: invalid type: string, exp"),
        (f"{{{USER}['{SECRET}']}}}}}}}}", "invalid type: sequence"),
        ("{" + USER + "31337}}}}", "invalid type: integer, expected a string"),
        (f"{{transport: {{link: {{tls: {{enable_mtls: '{SECRET}'}}}}}}}}", "expected a boolean"),
        (f'{{transport: {{link: {{tls: {{enable_mtls: "a\\"{SECRET}"}}}}}}}}', "invalid type"),
    ],
)
def test_a_configuration_file_is_not_quoted(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(text)
    with pytest.raises(WireConfigError, match=match) as caught:
        open_session(WireConfig(config=path))
    assert SECRET not in everything_said(caught.value)
    assert "31337" not in everything_said(caught.value)


def test_queues_hold_an_image_unless_the_file_says_otherwise(tmp_path: Path) -> None:
    from bridge.wire.zenoh_config import zenoh, zenoh_config

    def room_bytes(config: WireConfig, name: str) -> int:
        made = zenoh_config(config)
        batch_bytes = int(made.get_json("transport/link/tx/batch_size"))
        return batch_bytes * int(made.get_json(f"transport/link/tx/queue/size/{name}"))

    for name in (Qos.CONTROL.priority, Qos.CAMERA.priority):
        assert room_bytes(WireConfig(), name) > 480 * 640 * 3 + 1000
    path = tmp_path / "zenoh.json5"
    path.write_text("{transport: {link: {tx: {queue: {size: {data_low: 3}}}}}}")
    assert room_bytes(WireConfig(config=path), "data_low") == 3 * 65_535
    usual = zenoh.Config().get_json("transport/link/tx/queue/size/real_time")
    assert room_bytes(WireConfig(config=path), "real_time") == int(usual) * 65_535


def test_settings_of_an_endpoint_are_not_shown(
    router: WireSession, endpoint: str, tmp_path: Path
) -> None:
    settings = f"#connect_private_key_base64={SECRET}"
    cases: list[tuple[type[GstError], WireConfig]] = [
        (NoPeerError, WireConfig(connect=(f"tls/127.0.0.1:1{settings}",), connect_timeout_s=0.2)),
        (
            PortTakenError,
            WireConfig(mode="router", connect=(), listen=(f"{endpoint}{settings}",)),
        ),
        (WireConfigError, WireConfig(connect=(f"127.0.0.1:1{settings}",))),
    ]
    for kind, config in cases:
        with pytest.raises(kind) as caught:
            open_session(config)
        assert SECRET not in str(caught.value)


PRESETS = (Qos.CAMERA, Qos.CONTROL, Qos.RELIABLE, Qos.PREVIEW)
TYPE_HASH = "RIHS01_" + "a" * 64


@pytest.mark.parametrize("qos", PRESETS, ids=lambda qos: qos.priority)
def test_every_preset_delivers_and_keeps_its_word(
    router: WireSession, client: WireSession, qos: Qos
) -> None:
    from zenoh import CongestionControl

    got: list[WireSample] = []
    router.subscribe("a/b", got.append)
    made = client.publisher("/a/b", schema.IMAGE, qos=qos)
    wait_until(made.has_subscribers, "the subscription")
    made.put(b"x" * 10_000, source_ns=5)
    wait_until(lambda: len(got) == 1, "the message")
    assert (got[0].data, got[0].source_ns, got[0].sequence) == (b"x" * 10_000, 5, 0)
    inner = made._inner
    assert str(inner.priority).lower().endswith(qos.priority)
    waits = inner.congestion_control == CongestionControl.BLOCK
    assert waits is qos.block is (qos is Qos.RELIABLE)


def test_without_a_subscriber_nothing_need_be_made(
    router: WireSession, client: WireSession
) -> None:
    made = client.publisher("/rec/main/preview/a", schema.COMPRESSED_IMAGE, qos=Qos.PREVIEW)
    assert not made.has_subscribers()
    subscriber = router.subscribe("rec/*/preview/*", lambda sample: None)
    wait_until(made.has_subscribers, "the subscription")
    subscriber.close()
    wait_until(lambda: not made.has_subscribers(), "its end")


def test_images_travel_through_shared_memory_and_arrive_as_plain_bytes(
    router: WireSession, endpoint: str
) -> None:
    got: list[WireSample] = []
    shared: list[bool] = []
    router.subscribe("cell/**", got.append)
    router._inner.declare_subscriber(
        "cell/**", lambda sample: shared.append(sample.payload.as_shm() is not None)
    )
    with open_session(WireConfig(connect=(endpoint,), shared_memory_mb=4)) as session:
        image = session.publisher("/cell/image", schema.IMAGE, qos=Qos.CAMERA)
        small = session.publisher("/cell/joints", schema.JOINT_STATE, qos=Qos.CAMERA)
        wait_until(image.has_subscribers, "the subscription")
        for number in range(20):
            image.put(bytes([number]) * 300_000, source_ns=number)
            small.put(bytes([number]) * 300, source_ns=number)
            wait_until(lambda: len(got) == 2 * number + 2, "both messages")  # noqa: B023
    frames = [sample for sample in got if sample.topic == "/cell/image"]
    assert [sample.data for sample in frames] == [bytes([n]) * 300_000 for n in range(20)]
    assert [type(sample.data) for sample in frames] == [bytes] * 20
    assert sum(shared) == 20
    assert image.not_shared == 0


def test_a_full_pool_falls_back_to_the_network_and_never_waits(
    router: WireSession, endpoint: str
) -> None:
    """A receiver that keeps the sender's memory must cost a copy, not the frame, not the loop."""
    kept: list[object] = []
    got: list[WireSample] = []
    router._inner.declare_subscriber("cell/image", lambda sample: kept.append(sample.payload))
    router.subscribe("cell/image", got.append)
    with open_session(WireConfig(connect=(endpoint,), shared_memory_mb=1)) as session:
        image = session.publisher("/cell/image", schema.IMAGE, qos=Qos.CAMERA)
        wait_until(image.has_subscribers, "the subscription")
        for number in range(10):
            image.put(bytes([number]) * 300_000, source_ns=number)
            wait_until(lambda: len(got) == number + 1, "the message")  # noqa: B023
        assert image.not_shared >= 7  # three of them fill the megabyte
        image.put(b"y" * 2_000_000, source_ns=10)  # larger than the pool
        wait_until(lambda: len(got) == 11, "the large message")
    assert [sample.data[0] for sample in got] == [*range(10), ord("y")]
    assert [sample.sequence for sample in got] == list(range(11))


def test_only_cameras_use_the_pool(router: WireSession, endpoint: str) -> None:
    with open_session(WireConfig(connect=(endpoint,), shared_memory_mb=1)) as session:
        for qos in PRESETS:
            made = session.publisher(f"/a/{qos.priority}", schema.IMAGE, qos=qos)
            assert (made._pool is not None) is (qos is Qos.CAMERA)


def test_more_shared_memory_than_there_is_is_wrong_use(
    endpoint: str, router: WireSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(WireConfigError, match=r"100000000 MB of shared memory are not to be had"):
        open_session(WireConfig(connect=(endpoint,), shared_memory_mb=100_000_000))
    monkeypatch.setattr(publishing, "_free_bytes", lambda: 1_000_000)
    with pytest.raises(WireConfigError, match=r"2 MB .* not to be had: /dev/shm has 1 MB left"):
        SharedPool(2_000_000)


def test_who_comes_and_goes_is_seen(router: WireSession, client: WireSession) -> None:
    early = client.declare_alive("rec/one/alive")
    seen: list[tuple[str, bool]] = []
    wait_until(lambda: bool(router.query_alive("rec/*/alive")), "the token")
    router.watch_alive("rec/*/alive", lambda key, alive: seen.append((key, alive)))
    wait_until(lambda: seen == [("rec/one/alive", True)], "the history")
    client.declare_alive("rec/two/alive")
    wait_until(lambda: len(seen) == 2, "the second token")
    early.close()
    wait_until(lambda: ("rec/one/alive", False) in seen, "the goodbye")
    client.close()
    wait_until(lambda: ("rec/two/alive", False) in seen, "the end of the session")


@pytest.mark.parametrize("key", ["", "/a", "a//b"])
def test_a_bad_key_is_one_sentence(client: WireSession, key: str) -> None:
    with pytest.raises(WireConfigError, match="cannot be seen as"):
        client.declare_alive(key)
    with pytest.raises(WireConfigError, match="cannot watch"):
        client.watch_alive(key, lambda key, alive: None)


def test_a_cache_is_asked_for_what_it_kept(router: WireSession, client: WireSession) -> None:
    router.serve("cache/a", lambda payload: b"one")
    router.serve("cache/b", lambda payload: b"two")
    answers = client.query_all("cache/**", timeout_s=5.0)
    assert {(sample.topic, sample.data) for sample in answers} == {
        ("/cache/a", b"one"),
        ("/cache/b", b"two"),
    }
    assert client.query_all("nobody/**", timeout_s=5.0) == []
    router.serve("large/a", lambda payload: bytes(1_500_000))
    assert client.query_all("large/**", timeout_s=5.0, max_mb=1) == []


def test_a_topic_is_followed_whoever_publishes_it(router: WireSession, endpoint: str) -> None:
    import zenoh
    from zenoh.ext import CacheConfig, declare_advanced_publisher

    config = zenoh.Config.from_json5(
        f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}},'
        " timestamping: {enabled: true}, scouting: {multicast: {enabled: false}}}"
    )
    kind = "sensor_msgs::msg::dds_::{}_/" + TYPE_HASH
    got: list[WireSample] = []
    with zenoh.open(config) as node:
        key = f"0/tf_static/tf2_msgs::msg::dds_::TFMessage_/{TYPE_HASH}"
        latched = declare_advanced_publisher(node, key, cache=CacheConfig())
        latched.put(b"before")
        wait_until(lambda: router.query_all(f"{key}/@adv/**", timeout_s=5.0), "its cache")
        for topic in ("/tf_static", "/lab/joint_states", "/lab/cam/**"):
            router.follow(topic, got.append)
        node.put("0/lab/joint_states/" + kind.format("JointState"), b"ros")
        node.put("0/lab/cam/a/color/image/" + kind.format("Image"), b"ros")
        node.put("0/other/joint_states/" + kind.format("JointState"), b"no")
        node.put("lab/joint_states", b"ours")
        latched.put(b"after")
        wait_until(lambda: len(got) >= 5, "all five")
    assert [(each.topic, each.data) for each in got] == [
        ("/tf_static", b"before"),
        ("/lab/joint_states", b"ros"),
        ("/lab/cam/a/color/image", b"ros"),
        ("/lab/joint_states", b"ours"),
        ("/tf_static", b"after"),
    ]
    assert got[1].type_name == schema.JOINT_STATE


def test_numbers_of_zenoh_itself_are_read(router: WireSession, client: WireSession) -> None:
    """An AdvancedPublisher numbers its samples without any attachment of ours."""
    from zenoh.ext import MissDetectionConfig, declare_advanced_publisher

    got: list[WireSample] = []
    router.subscribe("a/**", got.append)
    missing = MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
    inner = [
        declare_advanced_publisher(client._inner, f"a/{name}", sample_miss_detection=missing)
        for name in ("x", "y")
    ]
    for number in range(3):
        for each in inner:
            each.put(bytes([number]))
    wait_until(lambda: len(got) == 6, "all six")
    by_topic = {topic: [s for s in got if s.topic == topic] for topic in ("/a/x", "/a/y")}
    for samples in by_topic.values():
        numbers = [sample.sequence for sample in samples]
        assert numbers == list(range(numbers[0] or 0, (numbers[0] or 0) + 3))
        assert len({sample.source_gid for sample in samples}) == 1
        assert len(samples[0].source_gid or b"") == 16
        assert samples[0].source_ns is None
    assert by_topic["/a/x"][0].source_gid != by_topic["/a/y"][0].source_gid


def test_a_plain_publisher_of_others_has_no_number(
    router: WireSession, client: WireSession
) -> None:
    got: list[WireSample] = []
    router.subscribe("**", got.append)
    client._inner.put(f"0/chatter/std_msgs::msg::dds_::String_/{TYPE_HASH}", b"data")
    wait_until(lambda: len(got) == 1, "the message")
    sample = got[0]
    assert (sample.topic, sample.type_name) == ("/chatter", schema.STRING)
    assert (sample.type_hash, sample.message_encoding) == (TYPE_HASH, "cdr")
    assert (sample.sequence, sample.source_gid, sample.source_ns) == (None, None, None)
