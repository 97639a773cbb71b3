"""Replays, rebuilds and evaluations judge by the task file an episode was recorded with."""

import pytest

from bridge.data_files import datasets_folder
from bridge.episode import streams
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.task.find import ATTACHMENT, MEDIA_TYPE, MissingTaskError, keep_task_file
from bridge.task.task_file import TaskFile, load_task
from evaluator.compare.summaries import recorded_task
from twin.scene.frames.selection import Sources
from twin.scene.objects.placement import scanned_tasks

CUBE = (datasets_folder() / "tasks" / "cube_into_box.toml").read_bytes()
MINE = TaskFile(CUBE.replace(b"cube_into_box", b"mine").replace(b"[200, 45", b"[20, 145"), "mine")
HEAVY = TaskFile(MINE.data.replace(b"mass_kg = 0.05", b"mass_kg = 0.06"), "heavy")
OTHER = TaskFile(
    (datasets_folder() / "tasks" / "sloth_into_basket.toml").read_bytes() + b"#", "other"
)


def recorded(run: RunFolder, name: str, file: TaskFile | None, task: str = "") -> Episode:
    path = run.episodes_dir / f"{name}.mcap"
    with EpisodeWriter(path) as writer:
        known = "" if file is None else file.sha256
        task = task if file is None else file.task().name
        writer.describe(EpisodeInfo(id=name, kind="scan", task=task, task_sha256=known))
        if file is not None:
            writer.attach(ATTACHMENT, file.data, media_type=MEDIA_TYPE, log_time_ns=1)
    return Episode.open(path)


def test_an_episode_of_a_task_nobody_ships_is_judged_by_its_own_file(run: RunFolder) -> None:
    episode = recorded(run, "a", MINE)
    assert streams.task_file(episode).task().objects["cube"].color_srgb == (20, 145, 40)
    assert recorded_task(episode) == MINE.task()
    assert scanned_tasks(Sources(episodes=(episode,), remark="")).task == MINE.task()


def test_an_old_episode_is_judged_by_the_runs_file_or_the_shipped_one(run: RunFolder) -> None:
    old = recorded(run, "old", None, "cube_into_box")
    assert streams.task_file(old).task() == load_task("cube_into_box")
    keep_task_file(run.tasks_dir, "cube_into_box", HEAVY.data)
    assert streams.task_file(old).data == HEAVY.data


def test_a_derived_episode_finds_the_file_in_the_run_by_its_hash(run: RunFolder) -> None:
    keep_task_file(run.tasks_dir, "mine", MINE.data)
    keep_task_file(run.tasks_dir, "mine", HEAVY.data)
    run.derived_dir.mkdir()
    path = run.derived_dir / "a.replay.mcap"
    with EpisodeWriter(path) as writer:
        info = EpisodeInfo(id="a", kind="trial", task="mine", task_sha256=HEAVY.sha256)
        writer.describe(info)
    assert streams.task_file(Episode.open(path)).data == HEAVY.data


def test_a_scene_of_several_tasks_has_the_objects_of_all(run: RunFolder) -> None:
    episodes = tuple(
        recorded(run, name, file) for name, file in (("a", MINE), ("b", OTHER), ("c", MINE))
    )
    found = scanned_tasks(Sources(episodes=episodes, remark=""))
    assert [episode.info.id for episode, _ in found.files] == ["a", "b", "c"]
    assert found.task is not None
    assert list(found.task.objects) == ["cube", "box", "sloth", "basket"]


def test_two_definitions_of_one_object_end_the_rebuild_and_name_both_episodes(
    run: RunFolder,
) -> None:
    episodes = (recorded(run, "a", MINE), recorded(run, "b", HEAVY))
    with pytest.raises(UsageError, match=r"'cube' .* a\.mcap and in task\.toml in b\.mcap"):
        _ = scanned_tasks(Sources(episodes=episodes, remark="")).task


def test_a_task_that_is_nowhere_is_no_error_for_a_scene_but_is_said(run: RunFolder) -> None:
    episodes = (recorded(run, "a", None, "gone"), recorded(run, "b", MINE))
    found = scanned_tasks(Sources(episodes=episodes, remark=""))
    assert found.task == MINE.task()
    assert "no task named 'gone'" in found.missing[0]
    assert recorded_task(episodes[0]) is None
    with pytest.raises(MissingTaskError, match=r"a\.mcap: carries no task\.toml"):
        streams.task_file(episodes[0])
