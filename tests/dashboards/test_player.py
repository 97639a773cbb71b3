"""The player opens at the divergence and shows recorded, twin and difference, by any clock."""

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from headless import CHROMIUM, NO_CHROMIUM, chromium
from serving import dashboard, judged

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from dashboards import frames
from dashboards.episode_page import EpisodePage, build_page
from dashboards.recording import PageClock, Recording, read_recording

ID = "trial_0002"
DROPPED_S = 1 + 2.8
"""Page time at which the twin drops the cube: the plan starts after one second."""


@pytest.fixture
def run(synthetic: ModuleType, disagreement: RunFolder) -> RunFolder:
    """Return one trial whose planned replay was drawn too, from 1 s to 4 s."""
    for trajectory in ("planned", "executed"):
        synthetic.write_drawn(disagreement, synthetic.TRIALS[1], trajectory, range(20, 80, 5))
    return disagreement


def page(run: RunFolder, t_s: float | None = None) -> EpisodePage:
    return build_page(run, ID, judged(run).row(ID), t_s)


def test_a_trial_opens_where_recording_and_twin_part(run: RunFolder) -> None:
    opened = page(run)
    assert opened.divergence_t_s == pytest.approx(DROPPED_S)
    assert opened.t_s == pytest.approx(DROPPED_S)
    assert page(run, 1.25).t_s == 1.25


def test_pictures_of_the_twin_are_found_at_the_instants_of_recorded_ones(run: RunFolder) -> None:
    cameras = {camera.id: camera for camera in page(run, 2.01).cameras}
    assert sorted(cameras) == ["side", "wrist"]
    assert cameras["wrist"].twin is None
    twin = cameras["side"].twin
    assert twin is not None
    assert twin.trajectory == "planned"
    assert set(twin.times_s) < set(cameras["side"].times_s)  # one clock, to the millisecond
    assert twin.times_s[twin.shown] == cameras["side"].shown_s == 2.0


def test_all_pictures_of_a_camera_come_in_one_answer(
    run: RunFolder, synthetic: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser = synthetic.browser_of(run)
    track = page(run).cameras[0]
    packed = unpacked(browser.get(f"/episode/{ID}/frames/{track.id}").content)
    assert sorted(packed) == list(range(len(track.times_s)))
    for index in (0, 7):
        one = browser.get(f"/episode/{ID}/frame/{track.id}?t={track.times_s[index]}")
        assert packed[index] == ("image/jpeg", one.content)
    monkeypatch.setattr(frames, "MAX_PACKED", 20)
    step = -(-len(packed) // 20)
    thin = unpacked(browser.get(f"/episode/{ID}/frames/{track.id}").content)
    assert sorted(thin) == list(range(0, len(packed), step))
    assert browser.get(f"/episode/{ID}/frames/nobody").status_code == 404
    outside = browser.get(f"/episode/{ID}/frames/side?file=../episodes/{ID}.mcap")
    assert outside.status_code == 404


def unpacked(data: bytes) -> dict[int, tuple[str, bytes]]:
    length = int.from_bytes(data[:4], "little")
    head, rest = json.loads(data[4 : 4 + length]), data[4 + length :]
    found = {}
    for index, size, kind in zip(head["indices"], head["sizes"], head["types"], strict=True):
        found[index] = (kind, rest[:size])
        rest = rest[size:]
    assert not rest
    return found


def test_lanes_say_what_is_apart_from_when_on_and_why_plans_were_sent_back(
    run: RunFolder, synthetic: ModuleType
) -> None:
    planned = next(p for p in run.derived(f"{ID}.replay.planned.*") if "drawn" not in p.name)
    write_touches(planned, synthetic)
    row = judged(run).row(ID)
    assert row is not None
    failed = replace(row, stages=(("carry", False), ("release", None)))
    chart = build_page(run, ID, failed, None).stages
    assert chart is not None
    lanes = dict(chart.lanes)
    assert [span.label for span in lanes["recorded"] if span.style == "apart"] == ["✗ carry"]
    (apart,) = lanes["object apart"]
    assert apart.start_s == pytest.approx(1 + 2.0)  # the plan starts after one second
    assert chart.bar(apart)[0] == pytest.approx(chart.x.px(3.0))
    assert apart.label == "planned – recorded: 69.00\u00a0mm"
    assert "grip apart" not in lanes
    (touch,) = lanes["touch, planned"]
    assert (touch.label, touch.start_s) == ("cube", pytest.approx(1 + 1.5, abs=0.01))


def write_touches(planned: Path, synthetic: ModuleType) -> None:
    """Add touches and a divergence to a replay: it is written again, and is then the newest."""
    opened = Episode.open(planned)
    with EpisodeWriter(planned.with_name(f"{ID}.replay.planned.dynamic.judged.mcap")) as writer:
        writer.describe(opened.info, derived=opened.derived)
        synthetic.copy_messages(opened, writer)
        start_ns = opened.start_ns
        for first_s, last_s, bodies in (
            (1.5, 2.0, ["left_finger", "cube"]),
            (1.8, 3.0, ["right_finger", "cube"]),
            (0.0, 4.0, ["cube", "table"]),
        ):
            record = {
                "schema_version": 1,
                "stamp_ns": start_ns + round(first_s * 1e9),
                "end_ns": start_ns + round(last_s * 1e9),
                "bodies": bodies,
                "allowed": True,
                "min_distance_m": 0.0,
                "source": "distance",
            }
            writer.write(
                "/standin/replay/contact", record, type_name=schema.CONTACT, log_time_ns=start_ns
            )
        plan_id = synthetic.make_plan(synthetic.TRIALS[1]).id
        synthetic.write_divergence(writer, plan_id, ("planned", "recorded"), 2_000_000_000)


def test_each_joint_is_drawn_as_planned_recorded_and_replayed_and_how_far_apart(
    run: RunFolder, synthetic: ModuleType
) -> None:
    *joints, apart = page(run).joint_plots
    assert len(joints) == 6
    t_s = np.arange(0, 6, 0.05)  # the recording
    recorded = [synthetic._joints(min(max(t - 1.12, 0.0), 4.5)) for t in t_s]
    t_twin_s = np.arange(110) / 20 + 1.0  # the replay begins with its plan
    replayed = np.array([synthetic._joints(min(t - 1.0, 4.5)) for t in t_twin_s])
    both = (t_s >= t_twin_s[0]) & (t_s <= t_twin_s[-1] + 1e-9)
    for index, plot in enumerate(joints):
        assert [line.name for line in plot.lines] == ["commanded", "twin, planned", "recorded"]
        assert all(line.pieces for line in plot.lines)
        twin = np.interp(t_s[both], t_twin_s, replayed[:, index])
        most = np.abs(np.array(recorded)[both, index] - twin).max()
        assert f"at most {1000 * most:.1f} mrad, planned" in plot.note
    assert [line.name for line in apart.lines] == ["to twin, planned"]
    assert apart.unit == "mrad"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_keys_move_all_pictures_and_they_never_differ_in_time(
    run: RunFolder, tmp_path: Path
) -> None:
    shown = "[...document.querySelectorAll('figure:not(.beside) .frame-time')].map(o => o.value)"
    hidden = "document.querySelector('.beside .apart').hidden"
    judged(run)
    with dashboard(run) as (_, url), chromium(tmp_path) as tab:
        tab.show(f"{url}episode/{ID}", width=1280, dark=False)
        assert not tab.complaints
        assert float(tab.ask("document.getElementById('clock').value")) == pytest.approx(DROPPED_S)
        assert tab.ask(hidden) is True
        for key in ["ArrowLeft"] * 7 + ["d"]:
            tab.press(key)
            tab.ask_when("frames.every((f) => !f.loading && f.shown === f.wanted)")
            times = tab.ask(shown)
            assert times[0] == times[1]
        tab.press("j")
        values = "[...document.querySelectorAll('.joints output')].map(o => o.value).join(' ')"
        angles = tab.ask(values)
        assert tab.ask("document.querySelector('.joints .cursor').getBBox().height") > 50
        tab.press("ArrowRight")
        assert tab.ask(values) != angles
        tab.press("ArrowLeft")
        tab.press("j")
        before = tab.picture()
        for _ in range(3):
            tab.press("ArrowRight")
        tab.ask_when("frames.every((f) => !f.loading && f.shown === f.wanted)")
        assert tab.ask(hidden) is False  # the twin's pictures end here
        assert tab.picture() != before
        tab.ask("window.scrollTo(0, 1500)")
        box = tab.ask("document.getElementById('clock').getBoundingClientRect().top")
        assert 0 < box < 900
        assert not tab.complaints


@pytest.fixture
def recording(shared_run: RunFolder) -> Recording:
    return read_recording(shared_run.episodes_dir / "trial_0001.mcap")


def test_time_on_the_page_goes_there_and_back(recording: Recording, synthetic: ModuleType) -> None:
    clock = PageClock.of(recording)
    assert clock.seconds(synthetic.EXECUTION_NS) == pytest.approx(1.0)
    assert clock.stamp_ns(clock.seconds(synthetic.EXECUTION_NS)) == synthetic.EXECUTION_NS
    assert clock.clamp(-3) == 0
    assert clock.clamp(99) == clock.end_s


def test_the_pages_zero_is_where_every_command_counts_from(recording: Recording) -> None:
    zero_ns = streams.first_stamp_ns(Episode.open(recording.path))
    assert PageClock.of(recording).zero_ns == zero_ns


def test_a_replay_from_zero_is_laid_from_the_start_of_its_execution(
    recording: Recording, shared_run: RunFolder
) -> None:
    clock = PageClock.of(recording)
    replay = read_recording(shared_run.derived("trial_0001.replay.planned.*")[0])
    t_s = clock.replay_seconds(replay, np.array([0, 2_800_000_000]))
    assert t_s == pytest.approx([1.0, 3.8])


def test_a_replay_of_a_plan_that_never_ran_has_no_place(
    recording: Recording, shared_run: RunFolder
) -> None:
    clock = PageClock.of(recording)
    other = read_recording(shared_run.derived("trial_0002.replay.planned.*")[0])
    assert clock.replay_seconds(other, np.array([0])) is None
    assert clock.of_plan_time("never", 0) is None
