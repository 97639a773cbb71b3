"""Rules that record by themselves: what fires them, what is then recorded."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from bridge.clock import AnchoredClock
from bridge.episode import schema
from bridge.episode.cdr.batch import named
from bridge.episode.cdr.codec import encode
from bridge.episode.cdr.messages import JointSample
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.record.config import RecorderConfig
from bridge.record.recorder import Recorder
from bridge.record.triggers import Rule, TriggerError, Triggers, Watch, read_triggers
from bridge.wire.session import WireSample

MakeSample = Callable[..., WireSample]

FORCE, VERDICT, ESTOP = "/lab/tcp/wrench", "/lab/verdict", "/lab/estop"


def wrench(newtons: float) -> bytes:
    header = {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "base"}
    parts = {"force": named("xyz", (0.0, newtons, 0.0)), "torque": named("xyz", (0.0, 0.0, 0.0))}
    return encode(schema.WRENCH_STAMPED, {"header": header, "wrench": parts})


def joints(**positions: float) -> bytes:
    none = np.zeros(0)
    values = np.array(list(positions.values()))
    sample = JointSample(
        stamp_ns=1, names=tuple(positions), position=values, velocity=none, effort=none
    )
    return sample.to_cdr()


class Cell:
    """A recorder with a pre-roll, rules, and a clock that is stepped by hand."""

    def __init__(self, run: RunFolder, make_sample: MakeSample, rules: list[Rule]) -> None:
        """Arm the rules."""
        self.now_s = 100.0
        self.said: list[str] = []
        self.run = run
        self.recorder = Recorder(
            run, now_ns=AnchoredClock().now_ns, config=RecorderConfig(preroll_s=60.0)
        )
        self.triggers = Triggers(
            self.recorder, rules, say=self.said.append, now_s=lambda: self.now_s
        )
        self._make = make_sample

    def send(self, topic: str, type_name: str, data: bytes, count: int = 1) -> None:
        for _ in range(count):
            sample = self._make(topic=topic, type_name=type_name, data=data)
            self.recorder.receive(sample)
            self.triggers.receive(sample)

    def joint_states(self, count: int) -> None:
        self.send("/lab/joint_states", schema.JOINT_STATE, joints(a=0.0), count)

    def step(self, seconds: float = 0.0) -> None:
        self.now_s += seconds
        self.triggers.step()

    def episodes(self) -> list[Episode]:
        return [Episode.open(path) for path in self.run.episodes()]


@pytest.fixture
def make_cell(run: RunFolder, make_sample: MakeSample) -> Iterator[Callable[..., Cell]]:
    made: list[Cell] = []

    def make(*rules: Rule) -> Cell:
        made.append(Cell(run, make_sample, list(rules)))
        return made[-1]

    yield make
    for cell in made:
        cell.recorder.close()


def test_a_rule_records_the_time_before_and_after_and_is_armed_again(
    make_cell: Callable[..., Cell],
) -> None:
    cell = make_cell(Rule(name="push", on="force", above=40.0, post_s=2.0))
    for round_ in range(2):
        cell.joint_states(50)
        cell.send(FORCE, schema.WRENCH_STAMPED, wrench(10.0))
        cell.step()
        assert cell.recorder.recording is None
        cell.send(FORCE, schema.WRENCH_STAMPED, wrench(55.0))
        cell.step()
        assert cell.recorder.recording is not None
        cell.joint_states(30)
        cell.step(1.9)
        assert cell.recorder.recording is not None
        cell.step(0.2)
        assert cell.recorder.recording is None
        cell.send(FORCE, schema.WRENCH_STAMPED, wrench(5.0))
        cell.step()
        assert len(cell.run.episodes()) == round_ + 1
    for number, episode in enumerate(cell.episodes()):
        # Law: what lies before the second episode is in the first one or in its pre-roll.
        assert episode.topics()["/lab/joint_states"].count == 80
        assert episode.topics()[FORCE].count == 2 + (number > 0)
        assert episode.info.tags == ("trigger", "push")
        notes = [json.loads(m.data) for m in episode.messages(["/recorder/event"])]
        assert notes[0]["data"]["rule"] == "push"
        assert notes[0]["data"]["why"] == f"force 55.0 N on {FORCE}"
        assert episode.metadata_records["recorder"]["stopped_by"] == "trigger push"
    assert len({episode.info.id for episode in cell.episodes()}) == 2
    assert cell.triggers.status()[0]["fired"] == 2


def test_firing_again_meanwhile_records_longer_not_twice(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(Rule(name="stop", on="message", topic="lab/estop", post_s=3.0))
    cell.send(ESTOP, "", b"1")
    cell.step()
    cell.step(2.0)
    cell.send(ESTOP, "", b"1")
    cell.step()
    cell.step(2.0)
    assert cell.recorder.recording is not None
    cell.step(1.1)
    assert cell.recorder.recording is None
    assert len(cell.run.episodes()) == 1


def test_while_somebody_records_the_instant_is_noted_there(make_cell: Callable[..., Cell]) -> None:
    from bridge.record.control import parse_info

    cell = make_cell(Rule(name="refused", on="verdict.refused"))
    cell.recorder.start(parse_info("mine", {"cell": "lab"}))
    cell.send(VERDICT, schema.VERDICT, b'{"accepted": false, "plan_id": "p7"}')
    cell.step()
    cell.step(100.0)
    assert cell.recorder.recording == "mine"
    cell.recorder.stop()
    (episode,) = cell.episodes()
    notes = [json.loads(message.data) for message in episode.messages(["/lab/event"])]
    assert [note["text"] for note in notes] == ["trigger refused: the verdict on plan p7 is no"]


def test_an_episode_that_somebody_stopped_is_let_be(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(Rule(name="stop", on="message", topic="/lab/estop", rearm_s=10.0))
    cell.send(ESTOP, "", b"1")
    cell.step()
    cell.recorder.stop()
    cell.step(5.0)
    cell.send(ESTOP, "", b"1")
    cell.step()
    assert cell.recorder.recording is None  # not before it is armed again
    cell.step(10.1)
    cell.send(ESTOP, "", b"1")
    cell.step()
    assert cell.recorder.recording is not None


def test_a_level_fires_once_until_it_was_left(make_sample: MakeSample) -> None:
    watch = Watch(Rule(name="x", on="force", above=10.0))

    def fires(newtons: float) -> bool:
        return bool(watch.see(make_sample(topic=FORCE, data=wrench(float(newtons)))))

    assert [fires(n) for n in (9, 11, 12, 9.5, 11, 7.9, 10.1, float("nan"), 12)] == [
        *(False, True, False, False, False, False, True, False, False)
    ]


def test_joints_that_leave_their_targets_are_named(make_sample: MakeSample) -> None:
    watch = Watch(Rule(name="x", on="joint_error", above=0.1))
    assert watch.wants("/lab/joint_states")
    assert watch.wants("/lab/joint_targets")

    def see(topic: str, **positions: float) -> str:
        return watch.see(make_sample(topic=topic, data=joints(**positions)))

    assert see("/lab/joint_states", a=0.0, b=5.0) == ""  # no target yet
    assert see("/lab/joint_targets", b=0.0, a=0.0) == ""
    assert see("/lab/joint_states", a=0.05, b=0.05) == ""
    assert see("/lab/joint_states", a=0.05, b=0.3) == "b is 0.300 rad from its target"
    assert see("/other/joint_states", a=9.0) == ""  # the target of another cell


def test_silence_fires_for_the_topics_it_names(make_sample: MakeSample) -> None:
    watch = Watch(Rule(name="x", on="silence", topic="lab/**", for_s=1.0))
    assert not watch.wants("/lab/a")
    assert watch.silence({"/lab/a": 0.9, "/other": 9.0}) == ""
    assert watch.silence({"/lab/a": 1.2, "/other": 9.0}) == "/lab/a silent for 1.2 s"
    assert watch.silence({"/lab/a": 5.0}) == ""
    assert watch.silence({"/lab/a": 0.0}) == ""
    assert watch.silence({"/lab/a": 1.1}) != ""


def test_messages_that_are_not_what_they_say_fire_nothing(make_sample: MakeSample) -> None:
    for kind in ("force", "joint_error", "verdict.refused"):
        watch = Watch(Rule(name="x", on=kind, above=1e-9))
        for data in (b"", b"[]", b"{", b"\0\1\0\0", b"\xff" * 40, b'{"accepted": 0}'):
            assert watch.see(make_sample(topic="/lab/tcp/wrench", data=data)) == ""


HEAD = "schema_version = 1\n[[trigger]]\n"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "schema_version must be 1"),
        ("schema_version = 1", "it has no rule"),
        (HEAD, "name must be a text"),
        (HEAD + 'name = "a"\non = "verdict.refuse"', "Did you mean verdict.refused"),
        (HEAD + 'name = "a"\non = "force"', "on = 'force' needs above"),
        (HEAD + 'name = "a"\non = "silence"\ntopic = "/x"', "needs for_s"),
        (HEAD + 'name = "a"\non = "force"\nabove = "5"', "above must be a number"),
        (HEAD + 'name = "../a"\non = "force"\nabove = 5', "names files"),
        (HEAD + 'name = "a"\non = "force"\nabov = 5', "Did you mean above"),
        (HEAD + 'name = "a"\non = "message"\ntopic = "/x"\npost_s = inf', "post_s must be"),
        ("schema_version = 1\ntrigger = 5", "it has no rule"),
        ("a = [", "are no TOML"),
    ],
)
def test_a_file_of_rules_that_cannot_be_says_why(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "t.toml").write_text(text)
    with pytest.raises(TriggerError, match=match):
        read_triggers(tmp_path / "t.toml")


def test_rules_are_read_as_they_stand_in_the_guide(tmp_path: Path) -> None:
    guide = Path(__file__).parents[3] / "docs" / "recording.md"
    text = guide.read_text().split("<!-- triggers -->")[1].split("```toml\n")[1].split("```")[0]
    (tmp_path / "t.toml").write_text(text)
    rules = read_triggers(tmp_path / "t.toml")
    assert {rule.on for rule in rules} == {
        "verdict.refused",
        "force",
        "joint_error",
        "silence",
        "message",
    }


def test_without_a_preroll_there_are_no_triggers(run: RunFolder) -> None:
    recorder = Recorder(run, now_ns=AnchoredClock().now_ns)
    with pytest.raises(TriggerError, match="--preroll-s"):
        Triggers(recorder, [Rule(name="a", on="verdict.refused")])
    recorder.close()
