"""Quality of service, shared memory, liveliness, caches and zenoh's own numbers."""

import pytest
from patience import wait_until

from bridge.episode import schema
from bridge.wire import publisher as publishing
from bridge.wire.config import WireConfig
from bridge.wire.errors import WireConfigError
from bridge.wire.publisher import SharedPool
from bridge.wire.qos import Qos
from bridge.wire.session import WireSample, WireSession, open_session

PRESETS = (Qos.CAMERA, Qos.CONTROL, Qos.RELIABLE, Qos.PREVIEW)
TYPE_HASH = "RIHS01_" + "a" * 64


@pytest.mark.parametrize("qos", PRESETS, ids=lambda qos: qos.name)
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
            made = session.publisher(f"/a/{qos.name}", schema.IMAGE, qos=qos)
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
