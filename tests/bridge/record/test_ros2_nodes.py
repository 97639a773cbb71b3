"""A ROS 2 node over rmw_zenoh in a process of its own, recorded and read by others' readers."""

import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loopback import free_endpoint
from mcap.reader import make_reader
from own_process import begun
from patience import wait_until
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.record.recorder import Recorder
from bridge.record.ros2 import Ros2Graph
from bridge.wire import keys
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSample, WireSession, open_session

CHILD = Path(__file__).with_name("rmw_child.py")
STRING = "std_msgs/msg/String"

pytestmark = pytest.mark.slow


class Robot:
    """One emulated ROS 2 node."""

    def __init__(self, endpoint: str, *arguments: str) -> None:
        """Start it; it says nothing yet."""
        pipe = subprocess.PIPE
        self.process = begun(str(CHILD), endpoint, *arguments, stdin=pipe, stderr=None)

    def speak(self) -> None:
        """Send its messages and wait until they are on their way."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        assert self.process.stdout.readline().strip() == "sent"

    def leave(self) -> None:
        self.process.communicate(timeout=30.0)


class Cell:
    """A router with a recorder and the ROS 2 graph, and what reached the recorder."""

    def __init__(self, session: WireSession, endpoint: str, run: RunFolder) -> None:
        """Start recording."""
        self.session, self.endpoint, self.run = session, endpoint, run
        self.recorder = Recorder(run, now_ns=session.now_ns)
        self.got: list[WireSample] = []
        self.robots: list[Robot] = []
        self.graph: Ros2Graph | None = None

    def listen(self) -> Ros2Graph:
        take = self.recorder.receive
        self.recorder.receive = lambda each: (self.got.append(each), take(each))  # type: ignore[method-assign]
        self.session.subscribe("**", self.recorder.receive)
        self.graph = Ros2Graph(self.session, self.recorder)
        return self.graph

    def robot(self, *arguments: str) -> Robot:
        self.robots.append(Robot(self.endpoint, *arguments))
        return self.robots[-1]


@pytest.fixture
def cell(run: RunFolder) -> Iterator[Cell]:
    endpoint = free_endpoint()
    with open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as session:
        made = Cell(session, endpoint, run)
        yield made
        for robot in made.robots:
            robot.process.kill()
            robot.process.communicate()
        if made.graph is not None:
            made.graph.close()
        made.recorder.close()


def read(path: Path) -> list[tuple[Any, Any, Any]]:
    with path.open("rb") as stream:
        return [
            each
            for each in make_reader(stream, validate_crcs=True).iter_messages()
            if each[1].topic == "/chatter"
        ]


@pytest.mark.parametrize("form", ["33", "77", "0"])
def test_a_topic_is_recorded_so_that_others_can_decode_it(cell: Cell, form: str) -> None:
    graph = cell.listen()
    cell.recorder.start(EpisodeInfo(id="t1", kind="trial"))
    robot = cell.robot(form, "20")
    robot.speak()
    wait_until(lambda: len(cell.got) == 20, "the messages")
    wait_until(lambda: bool(graph._publishers), "the token")
    answer = cell.recorder.stop()
    found = read(cell.run.episodes_dir / "t1.mcap")
    assert (len(found), answer["lost"]) == (20, 0)
    schema, channel, _ = found[0]
    assert (schema.name, schema.encoding, channel.message_encoding) == (STRING, "ros2msg", "cdr")
    # Decoded by the definition in the file, not by one that rosbags has.
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.data.decode(), schema.name))
    texts = [store.deserialize_cdr(each.data, schema.name).data for _, _, each in found]
    assert texts == [f"hello {number}" for number in range(20)]
    if form == "33":  # what Jazzy sent at first (77) is kept by its arrival
        assert [each.sequence for _, _, each in found] == list(range(20))
        assert [each.publish_time for _, _, each in found] == [1_000 + n for n in range(20)]
    robot.leave()
    wait_until(lambda: not graph._publishers, "the end of the token")


@pytest.mark.parametrize("flag", ["latched", "old-latched"])
def test_what_was_said_before_we_came_is_recorded_once(cell: Cell, flag: str) -> None:
    robot = cell.robot("33", "5", flag)
    robot.speak()
    cell.recorder.start(EpisodeInfo(id="t1", kind="trial"))
    cell.listen()
    wait_until(lambda: len(cell.got) == 5, "the history")
    robot.speak()
    wait_until(lambda: len(cell.got) >= 10, "the news")
    time.sleep(0.2)
    answer = cell.recorder.stop()
    assert [sample.sequence for sample in cell.got] == list(range(10))
    assert {sample.type_name for sample in cell.got} == {STRING}
    found = read(cell.run.episodes_dir / "t1.mcap")
    assert [each.sequence for _, _, each in found] == list(range(10))
    assert answer["lost"] == 0


def test_what_a_transient_local_publisher_said_last_begins_the_next_episode(cell: Cell) -> None:
    cell.listen()
    robot = cell.robot("33", "3", "latched")
    wait_until(lambda: "/chatter" in cell.recorder.input_queue.latched, "the token")
    robot.speak()
    wait_until(lambda: len(cell.got) == 3, "the messages")
    cell.recorder.start(EpisodeInfo(id="t1", kind="trial"))
    cell.recorder.stop()
    found = read(cell.run.episodes_dir / "t1.mcap")
    assert [each.sequence for _, _, each in found] == [2]


def test_a_publisher_that_comes_later_is_not_recorded_twice(cell: Cell) -> None:
    graph = cell.listen()
    robot = cell.robot("33", "50", "latched")
    for _ in range(10):
        robot.speak()
    wait_until(lambda: len(cell.got) >= 500, "the messages")
    graph.close()
    numbers = [sample.sequence for sample in cell.got]
    assert sorted(numbers) == list(range(500))


def test_another_definition_is_flagged_and_kept_apart(cell: Cell) -> None:
    cell.listen()
    cell.recorder.start(EpisodeInfo(id="t1", kind="trial"))
    cell.robot("33", "3").speak()
    cell.robot("33", "3", "other-hash").speak()
    wait_until(lambda: len(cell.got) == 6, "the messages of both")
    wait_until(lambda: bool(cell.recorder.status()["warnings"]), "the warning")
    said = " ".join(cell.recorder.status()["warnings"])
    cell.recorder.stop()
    assert "/chatter: std_msgs/msg/String was built from another definition (RIHS01_555" in said
    found = read(cell.run.episodes_dir / "t1.mcap")
    assert len(found) == 6
    assert len({channel.id for _, channel, _ in found}) == 2
    assert {schema.encoding for schema, _, _ in found} == {"ros2msg", ""}


def test_an_unknown_type_is_recorded_by_its_name_and_flagged(cell: Cell) -> None:
    cell.listen()
    cell.recorder.start(EpisodeInfo(id="t1", kind="trial"))
    cell.robot("33", "3", "unknown").speak()
    wait_until(lambda: len(cell.got) == 3, "the messages")
    wait_until(lambda: bool(cell.recorder.status()["warnings"]), "the warning")
    (said,) = cell.recorder.status()["warnings"]
    cell.recorder.stop()
    assert said.startswith("/chatter: my_msgs/msg/Grip is not known here")
    found = read(cell.run.episodes_dir / "t1.mcap")
    assert [each.sequence for _, _, each in found] == [0, 1, 2]
    assert {(schema.name, schema.encoding) for schema, _, _ in found} == {("my_msgs/msg/Grip", "")}


def test_a_killed_robot_is_noticed(cell: Cell) -> None:
    graph = cell.listen()
    robot = cell.robot("33", "1")
    wait_until(lambda: bool(graph._publishers), "the token")
    robot.process.kill()
    wait_until(lambda: not graph._publishers, "the end of the token")


def test_hostile_tokens_change_nothing(cell: Cell) -> None:
    graph = cell.listen()
    with open_session(WireConfig(connect=(cell.endpoint,))) as other:
        other.declare_alive("@ros2_lv/0/z/0/1/MP/%/%/n/%$*/a::msg::B_/RIHS01_x/:1:,1")
        other.declare_alive("@ros2_lv/nonsense")
        node = "n" * 10_000
        other.declare_alive(
            f"@ros2_lv/0/z/0/1/MP/%/%/{node}/%a/std_msgs::msg::dds_::String_/{keys.NO_HASH}/:1:,1"
        )
        wait_until(lambda: [*graph._publishers.values()] == ["/a"], "the long name")
    wait_until(lambda: not graph._publishers, "its end")
