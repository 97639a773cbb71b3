"""Whether the replays that count were made alike: in one scene, with the same settings."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

from evaluator.compare.remarks import Remark
from evaluator.compare.replays import DerivedFile
from evaluator.compare.trial import Trial

ABOUT = "replays"
CHANGES_NO_VERDICT = ("mode", "samples", "seed")
"""Settings that one evaluation may well find in several values."""
NO_SCENE = "no scene"
HASH_DIGITS = 12


def replay_remarks(trials: Sequence[Trial], derived: Sequence[DerivedFile]) -> list[Remark]:
    """Say what a reader of one rate over all trials would not expect of the replays behind it.

    Args:
        trials: Each with the dynamic replays that count.
        derived: All derived episodes of the run.
    """
    used = [file for trial in trials for file in trial.replays.values()]
    if not used:
        return []
    found = chain(_scenes(used, derived), _settings(used), _tried(used, derived))
    return [(ABOUT, text) for text in found]


def _scenes(used: Sequence[DerivedFile], derived: Iterable[DerivedFile]) -> Iterable[str]:
    scenes = Counter(_scene(file.derived.scene_hash) for file in used)
    if len(scenes) > 1:
        yield (
            f"those that count were made in different scenes ({_counted(scenes)}), so trials are "
            "judged by different twins; robot-gst replay RUN makes those of the scene there is now"
        )
        return
    views = [each.derived.scene_hash for each in derived if each.derived.kind == "views"]
    shown = {_scene(scene_hash) for scene_hash in views if scene_hash}
    if shown and not shown & scenes.keys():
        yield (
            f"made in {next(iter(scenes))}, while the held-out views are of "
            f"{' and '.join(sorted(shown))}: numbers of trials and of images are of different "
            "twins; robot-gst replay RUN replays in the scene there is now"
        )


def _scene(scene_hash: str | None) -> str:
    return f"scene {scene_hash[:HASH_DIGITS]}" if scene_hash else NO_SCENE


def _counted(values: Counter[str]) -> str:
    return ", ".join(f"{count} in {value}" for value, count in values.most_common())


def _settings(used: Sequence[DerivedFile]) -> Iterable[str]:
    """Name the first setting in which replays that count differ."""
    known = [settings for settings in map(_settings_of, used) if settings]
    for name in dict.fromkeys(chain.from_iterable(known)):
        values = Counter(str(settings.get(name)) for settings in known)
        if len(values) > 1:
            shown = ", ".join(f"{value} in {count}" for value, count in values.most_common())
            yield (
                f"those that count were made with different settings ({name} {shown}), so trials "
                "are judged by different twins"
            )
            return


def _tried(used: Sequence[DerivedFile], derived: Iterable[DerivedFile]) -> Iterable[str]:
    """Say that a replay with other settings lies beside one that counts, and why it does not."""
    beside: dict[tuple[str | None, ...], list[DerivedFile]] = {}
    for file in derived:
        if file.derived.kind == "replay" and file.derived.mode == "dynamic":
            beside.setdefault(_trajectory(file), []).append(file)
    differ = [
        (mine, others)
        for file in used
        if len(beside.get(_trajectory(file), ())) > 1
        for mine in (_settings_of(file),)
        for others in (_others(mine, beside[_trajectory(file)]),)
        if others
    ]
    if differ:
        mine, other = differ[0][0], differ[0][1]
        name = next((name for name in mine if mine[name] != other.get(name)), "a newer setting")
        yield (
            f"{len(differ)} of the {len(used)} that count were also made with other settings "
            f"({name} {mine.get(name)} in what counts, {other.get(name)} beside it): the newest "
            "file of each trajectory counts"
        )


def _trajectory(file: DerivedFile) -> tuple[str | None, ...]:
    """Whose replay it is, of which bytes and in which scene."""
    made = file.derived
    return made.source_episode, made.source_sha256, made.plan_id, made.trajectory, made.scene_hash


def _others(mine: Mapping[str, Any], files: Iterable[DerivedFile]) -> Mapping[str, Any] | None:
    """Settings of a replay that only the user's wish sets apart, None where there is none.

    A newer program or calibration leaves older files behind, which surprises nobody.
    """
    for settings in map(_settings_of, files):
        same = all(mine.get(name) == settings.get(name) for name in MADE_BY)
        if settings and same and settings != mine:
            return settings
    return None


MADE_BY = ("replay_version", "calibration_id")


def _settings_of(file: DerivedFile) -> dict[str, Any]:
    """Settings by their dotted names; none of a replay that another program made."""
    config = file.derived.settings.get("config")
    if not isinstance(config, dict):
        return {}
    kept = {name: config[name] for name in config if name not in CHANGES_NO_VERDICT}
    made_by = {name: file.derived.settings.get(name) for name in MADE_BY}
    return made_by | dict(_leaves(kept))


def _leaves(values: Mapping[str, Any], before: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value
