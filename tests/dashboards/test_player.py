"""The player of a trial: opens at the divergence, and shows recorded, twin and difference."""

import re
from pathlib import Path
from types import ModuleType

import pytest
from headless import CHROMIUM, NO_CHROMIUM, chromium
from serving import dashboard

from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.provenance import hash_file
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from dashboards.comparison import judge
from dashboards.episode_page import EpisodePage, build_page

ID = "trial_0002"
DROPPED_S = 1 + 2.8
"""Page time at which the twin drops the cube: the plan starts after one second."""


@pytest.fixture
def run(synthetic: ModuleType, tmp_path: Path) -> RunFolder:
    """Return one trial whose planned replay was drawn too, from 1 s to 4 s."""
    run = RunFolder.create(tmp_path / "run")
    trial = synthetic.TRIALS[1]
    source = synthetic.write_trial(run, trial)
    synthetic.write_replay(run, trial, "planned", False)
    plan = synthetic.make_plan(trial)
    for trajectory in ("planned", "executed"):
        path = run.derived_dir / f"{ID}.replay.{trajectory}.dynamic.drawn.mcap"
        with EpisodeWriter(path) as writer:
            writer.describe(
                EpisodeInfo(id=ID, kind="trial", stand_in=True),
                derived=Derived(
                    kind="replay",
                    source_episode=ID,
                    source_sha256=hash_file(source),
                    plan_id=plan.id,
                    trajectory=trajectory,
                    mode="kinematic",
                    engine="splat",
                    seed=0,
                ),
            )
            log = synthetic._Log(writer)  # the same writer as the trials'
            for step in range(20, 80, 5):
                t_s = step / 20
                drawn = synthetic.picture(t_s - 1, 0)  # the cube lags behind: a difference
                ns = synthetic.START_NS + round(t_s * 1e9)
                log.image("/standin/cam/side/rendered/image", drawn, ns)
    return run


def page(run: RunFolder, t_s: float | None = None) -> EpisodePage:
    return build_page(run, ID, judge(run).row(ID), t_s)


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


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)
def test_keys_move_all_pictures_and_they_never_differ_in_time(
    run: RunFolder, tmp_path: Path
) -> None:
    shown = "[...document.querySelectorAll('figure:not(.beside) .frame-time')].map(o => o.value)"
    hidden = "document.querySelector('.beside .apart').hidden"
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
        before = tab.picture()
        for _ in range(3):
            tab.press("ArrowRight")
        tab.ask_when("frames.every((f) => !f.loading && f.shown === f.wanted)")
        assert tab.ask(hidden) is False  # the twin's pictures end here
        assert tab.picture() != before
        tab.ask("window.scrollTo(0, 1500)")
        box = tab.ask("document.getElementById('clock').getBoundingClientRect().top")
        assert 0 < box < 900
        addresses = [address for address in tab.asked if "/rendered/" in address]
        assert all(re.search(r"stamp=\d{19}$", address) for address in addresses)
        assert len(set(addresses)) > 2
