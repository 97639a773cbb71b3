"""What the pages say of a run that changed after it was evaluated."""

import os
import re
import shutil
from types import ModuleType

import pytest
from visible import words

from bridge.episode import schema
from bridge.episode.catalogue import label_episode
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.task.scripted_motion import RECORD_NAME
from evaluator.compare import compare_run
from evaluator.report.review import refresh
from evaluator.result import write_results

OLDER = "The stored results and the report are older than the run"


def overview(synthetic: ModuleType, run: RunFolder) -> str:
    return words(synthetic.browser_of(run).get("/").text)


def test_numbers_that_still_hold_are_not_called_old(synthetic: ModuleType, copy: RunFolder) -> None:
    assert OLDER not in overview(synthetic, copy)


@pytest.mark.parametrize("change", ["label", "deleted", "replay"])
def test_numbers_older_than_the_run_are_called_so(
    synthetic: ModuleType, copy: RunFolder, change: str
) -> None:
    if change == "label":
        label_episode(copy, "trial_0003", Outcome(result="failure", by="reviewer"))
    elif change == "deleted":
        (copy.episodes_dir / "trial_0001.mcap").unlink()
    else:
        copy.derived("trial_0001.replay.planned*")[0].unlink()
    text = overview(synthetic, copy)
    assert OLDER in text
    assert "robot-gst evaluate" in text


def test_a_label_given_afterwards_names_who_gave_it(synthetic: ModuleType, copy: RunFolder) -> None:
    given = Outcome(result="failure", by="reviewer", detail="it was the wrong box")
    label_episode(copy, "trial_0003", given)
    text = words(synthetic.browser_of(copy).get("/episode/trial_0003").text)
    assert "✗ failure labelled by reviewer: it was the wrong box" in text
    assert "stand-in operator" not in text


def test_commands_on_the_pages_can_be_pasted_into_a_shell(
    synthetic: ModuleType, copy: RunFolder
) -> None:
    shutil.rmtree(copy.results_dir)
    copy.derived("*.views.*")[0].unlink()
    browser = synthetic.browser_of(copy)
    for address in ("/", "/twin", "/episode/trial_0001"):
        text = words(browser.get(address).text).replace("&#39;", "'")
        assert f"'{copy.path}" in text, address


def test_of_a_trajectory_replayed_twice_the_last_replay_counts_on_the_page(
    synthetic: ModuleType, copy: RunFolder
) -> None:
    (first,) = copy.derived("trial_0002.replay.planned*")
    os.utime(first, ns=(10**18, 10**18))
    first.rename(first.with_name(first.name.replace("a1b2c3d4", "ffffffff")))
    last = synthetic.write_replay(copy, synthetic.TRIALS[1], "planned", True)
    assert copy.derived("trial_0002.replay.planned*")[0] == last  # by name it is the first
    text = words(synthetic.browser_of(copy).get("/episode/trial_0002").text)
    assert "Twin, planned ✓ success" in text
    assert text.index("✓ accepted") < text.index("dynamic, redone since ✗ refused")


def test_a_replay_in_the_engine_of_the_cell_is_shown_and_does_not_count(
    synthetic: ModuleType, copy: RunFolder
) -> None:
    last = synthetic.write_replay(copy, synthetic.TRIALS[1], "planned", True, engine="mujoco")
    os.utime(last, ns=(2 * 10**18, 2 * 10**18))
    text = words(synthetic.browser_of(copy).get("/episode/trial_0002").text)
    assert "Twin, planned ✗ failure" in text
    assert "dynamic, made in mujoco, the same engine as the cell ✓ accepted" in text
    assert "redone since" not in text


def next_command(synthetic: ModuleType, run: RunFolder) -> str:
    """What the first page says is next for a run whose results are those of now."""
    write_results(compare_run(run).results(), run.results_dir / "results.json")
    refresh(run)
    page = synthetic.browser_of(run).get("/").text
    return re.findall(r'class="notice".*?data-copy="robot-gst (\w+) ', page, re.DOTALL)[0]


def add(run: RunFolder, name: str, topic: str, *, motion: bool = False) -> None:
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        writer.describe(EpisodeInfo(id=name, kind="imported"))
        if motion:
            writer.add_metadata(RECORD_NAME, {"a": "1"})
        writer.write(topic, b"", type_name=schema.IMAGE, log_time_ns=1)


def test_what_is_next_can_be_done_with_what_was_recorded(
    synthetic: ModuleType, own_run: RunFolder
) -> None:
    assert next_command(synthetic, own_run) == "open"
    page = overview(synthetic, own_run)
    assert "No camera recorded depth, so there is nothing to rebuild or replay." in page
    add(own_run, "trial_0002", "/lab/cam/side/depth/image")
    assert next_command(synthetic, own_run) == "rebuild"
    own_run.scene_dir.mkdir()
    (own_run.scene_dir / "scene.json").write_text("{}")
    assert next_command(synthetic, own_run) == "replay"


def test_an_imported_motion_needs_no_scene(synthetic: ModuleType, own_run: RunFolder) -> None:
    add(own_run, "motion", "/lab/cam/side/color/image", motion=True)
    assert next_command(synthetic, own_run) == "replay"


def test_a_scene_is_offered_where_depth_was_recorded(
    synthetic: ModuleType, own_run: RunFolder
) -> None:
    rebuild = f"robot-gst rebuild {own_run.path}"
    assert rebuild not in synthetic.browser_of(own_run).get("/twin").text
    add(own_run, "scan", "/lab/cam/side/depth/image")
    assert rebuild in synthetic.browser_of(own_run).get("/twin").text


def test_long_names_in_a_notice_may_break_behind_their_joints(
    synthetic: ModuleType, copy: RunFolder
) -> None:
    copy.derived("trial_0001.replay.planned*")[0].unlink()
    page = synthetic.browser_of(copy).get("/").text
    assert "replay.<wbr>planned" in page
