"""What a reader should know before using a number."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

from evaluator.cache import packed
from evaluator.compare.agreement import sides, usable_groups
from evaluator.compare.conclusions import CLOSE_PP, counted
from evaluator.compare.measure import grouped
from evaluator.compare.rows import RateGroup
from evaluator.compare.success import of_group
from evaluator.compare.trial import Trial
from evaluator.errors import UndefinedStatisticError
from evaluator.measurements import BLIND_GROUP
from evaluator.result import Measurement, Table
from evaluator.run_reader.episodes import MADE_BY, DerivedFile
from evaluator.statistics.agreement import within_and_between
from evaluator.statistics.differences import points_of
from evaluator.statistics.intervals import LEVEL

Note = tuple[str, str]
"""About what, and the sentence."""
FAR_HERE = "the twin's rate is far from the recorded one here"


def notes(groups: Sequence[RateGroup], measurements: Sequence[Measurement]) -> list[Note]:
    """Collect what follows from the groups and the numbers alone."""
    by_id = {measurement.id: measurement for measurement in measurements}
    level = 1 - (1 - LEVEL) / max(1, len(groups))  # one error in all of them
    why = [(group.label, _points_off(group, level) or _blind(group, by_id)) for group in groups]
    far = [(label, f"{FAR_HERE}: {words}") for label, words in why if words]
    return [*_opposed(groups, by_id), *_units(groups), *far]


def _blind(group: RateGroup, by_id: Mapping[str, Measurement]) -> str:
    m = by_id.get(of_group(BLIND_GROUP, (group.task, group.condition, group.policy)).id)
    return "" if m is None or m.value is None else f"blind with probability {m.value:.2f}"


def _points_off(group: RateGroup, level: float) -> str:
    """Say how far off, where it is surely more than ``CLOSE_PP``."""
    stratum, sim, recorded = counted(group), group.sim_rate, group.recorded_rate
    if stratum is None or group.unit != "trial" or sim is None or recorded is None:
        return ""
    _, found = points_of([stratum], level=level)
    shown = f"{100 * float(sim):.0f} against {100 * float(recorded):.0f} %"
    return shown if max(found.low, -found.high) > CLOSE_PP else ""


def notes_table(found: Iterable[Note]) -> tuple[Table, ...]:
    """Lay notes out as a table; none without notes."""
    rows = tuple(dict.fromkeys(found))
    if not rows:
        return ()
    return (Table(id="notes", title="Notes", columns=("about", "note"), rows=rows),)


def with_notes(tables: Iterable[Table], found: Iterable[Note]) -> tuple[Table, ...]:
    """Put notes before those that are among some tables already."""
    kept, found = tuple(tables), list(found)
    if not found:
        return kept
    old = [(str(a), str(b)) for table in kept if table.id == "notes" for a, b in table.rows]
    return (*(table for table in kept if table.id != "notes"), *notes_table([*found, *old]))


def _units(groups: Sequence[RateGroup]) -> list[Note]:
    found = {group.task: group for group in groups if group.unit != "trial"}
    notes = []
    for task, group in found.items():
        n = group.recorded.n or group.sim.n
        count = f" (n = {n})" if n else ""
        words = (
            f"counted in {group.unit}s{count}, not in trials: {group.unit}s of one trial are not "
        )
        words += "independent, so intervals and tests claim more than the trials justify"
        notes.append((task, words))
    units = sorted({group.unit for group in groups})
    if len(units) > 1:
        words = f"averages and r mix rates counted in {' and in '.join(f'{u}s' for u in units)}"
        notes.append(("averages", words))
    return notes


def _opposed(groups: Sequence[RateGroup], by_id: dict[str, Measurement]) -> list[Note]:
    """Say that r within tasks tells another story than r over all groups (Simpson 1951)."""
    usable = usable_groups(groups)
    tasks = grouped(usable, lambda group: group.task)
    if not 1 < len(tasks) < len(usable):
        return []
    try:
        pairs = [list(zip(*sides(members), strict=True)) for members in tasks.values()]
        within, between = within_and_between(pairs)
    except UndefinedStatisticError:
        return []
    r = by_id.get("agreement.pearson_r")
    over_all = between if r is None or r.value is None else r.value
    if within * over_all >= 0:
        return []
    text = "" if r is None else f"r = {over_all:.2f} over all groups hides this: "
    text += f"inside tasks r = {within:.2f}, between tasks r = {between:.2f} (Simpson's paradox)"
    if within < 0:
        text += ". Inside a task, what the twin ranks higher did worse: do not choose by it"
    return [("agreement.pearson_r", text)]


CHANGES_NO_VERDICT = ("mode", "samples", "seed")
"""Settings that one evaluation may well find in several values."""
HASH_DIGITS = 12


def check_settings(trials: Sequence[Trial], derived: Sequence[DerivedFile]) -> list[Note]:
    """Say what a reader of one rate over all trials would not expect of the replays behind it."""
    used = [file for trial in trials for file in trial.replays.values()]
    passed_over = Counter(file.why_not_counted for file in derived if file.derived.kind == "replay")
    found = [f"{count} that never count were {why}" for why, count in passed_over.items() if why]
    found += [text for text in (_scenes(used, derived), _settings(used)) if text]
    return [("replays", text) for text in found]


def _scenes(used: Sequence[DerivedFile], derived: Iterable[DerivedFile]) -> str:
    """Say that replays, or replays and views, are of different scenes."""
    scenes = Counter(_scene(file.derived.scene_hash) for file in used)
    views = [each.derived.scene_hash for each in derived if each.derived.kind == "views"]
    shown = {_scene(scene_hash) for scene_hash in views if scene_hash}
    if len(scenes) > 1:
        counted = ", ".join(f"{count} in {name}" for name, count in scenes.most_common())
        return (
            f"those that count were made in different scenes ({counted}), so trials are "
            "judged by different twins; robot-gst replay RUN makes those of the scene there is now"
        )
    if not scenes or not shown or shown & scenes.keys():
        return ""
    return (
        f"made in {next(iter(scenes))}, while the held-out views are of "
        f"{' and '.join(sorted(shown))}: numbers of trials and of images are of different "
        "twins; robot-gst replay RUN replays in the scene there is now"
    )


def _scene(scene_hash: str | None) -> str:
    return f"scene {scene_hash[:HASH_DIGITS]}" if scene_hash else "no scene"


def _settings(used: Sequence[DerivedFile]) -> str:
    """Name the first setting in which replays that count differ."""
    # Nearly always all are equal, and equal ones are laid flat once.
    kinds = grouped(used, lambda file: packed(file.derived.settings)).values()
    made = [(found, len(k)) for k in kinds if (found := dict(_leaves(_made_with(k[0]))))]
    for name in dict.fromkeys(chain.from_iterable(found for found, _ in made)):
        values: Counter[str] = Counter()
        for found, count in made:
            values[str(found.get(name))] += count
        if len(values) > 1:
            shown = ", ".join(f"{value} in {count}" for value, count in values.most_common())
            return (
                f"those that count were made with different settings ({name} {shown}), so trials "
                "are judged by different twins"
            )
    return ""


def _made_with(file: DerivedFile) -> dict[str, Any]:
    """Settings that may change a verdict; none of a replay that another program made."""
    config = file.derived.settings.get("config")
    if not isinstance(config, dict):
        return {}
    kept = {name: config[name] for name in config if name not in CHANGES_NO_VERDICT}
    return {name: file.derived.settings.get(name) for name in MADE_BY} | kept


def _leaves(values: Mapping[str, Any], before: str = "") -> Iterable[tuple[str, Any]]:
    """Settings by their dotted names."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value
