"""The tables of ``robot-gst replay``: verdicts counted, and held against the operator's labels.

Every answer that is not a yes is listed with its reason.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.executions import NO_PLAN
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.verdict import SAME_ENGINE
from twin.replay.agreement import WORDS
from twin.replay.failure import NOT_EVALUATED

LABELS = ("success", "failure", "unknown")
PLANNED, EXECUTED, SEEN = "planned in twin", "executed in twin", "executed as seen"
TRAJECTORIES = ((PLANNED, "planned"), (EXECUTED, "executed"), (SEEN, "recorded_predicates"))
"""What is held against the operator's label: two replays, and the success predicates on the objects
as they were localised before and after the execution."""

Rows = Sequence[Mapping[str, Any]]
Counts = Mapping[str, Mapping[str, int]]


def count_verdicts(rows: Rows) -> dict[str, dict[str, int]]:
    """Accepted, rejected, undecided and failed per trajectory and mode, and how many in all."""
    counts: dict[str, Counter[str]] = {}
    for row in rows:
        key = f"{row['trajectory']} {row['mode']}"
        if key == "planned dynamic" and not row["executed"]:
            key = "planned dynamic, never executed"
        if row.get("engines") == ["mujoco"]:
            key += ", mujoco"
        counts.setdefault(key, Counter())["failed" if row["error"] else WORDS[row["accepted"]]] += 1
        counts[key]["n"] += 1
    words = ("n", "accepted", "rejected", "undecided", "failed")
    return {key: {word: counter[word] for word in words} for key, counter in counts.items()}


def recorded_labels(run: RunFolder, episode_ids: Sequence[str]) -> dict[str, str]:
    """What the operator said of each episode: success, failure or unknown (unreadable too)."""
    labels = {}
    for episode_id in episode_ids:
        try:
            labels[episode_id] = _label(run, episode_id)
        except (GstError, TypeError):
            labels[episode_id] = "unknown"
    return labels


def _label(run: RunFolder, episode_id: str) -> str:
    episode = Episode.open(run.episodes_dir / f"{episode_id}.mcap")
    outcome = outcome_of(run, episode)
    if outcome is not None:
        return outcome.result
    labels = [event.get("outcome") for event in streams.events(episode) if event["type"] == "label"]
    last = labels[-1] if labels else None
    return str(last.get("result", "unknown")) if isinstance(last, dict) else "unknown"


def executions_of(rows: Rows, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """One entry per executed plan: what each side says, and where they diverge first."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        if not row["executed"]:
            continue
        key = (row["episode"], row["plan"])
        entry = found.setdefault(
            key,
            {
                "episode": row["episode"],
                "plan": row["plan"],
                "task": row.get("task", ""),
                "recorded": labels.get(row["episode"], "unknown"),
                "recorded_predicates": None,
                "planned": None,
                "executed": None,
                "lag_s": None,
                "divergence": None,
            },
        )
        if row["mode"] == "kinematic":
            entry["recorded_predicates"] = row.get("predicates")
        else:
            entry[row["trajectory"]] = row["accepted"]
        if row.get("divergence"):
            entry["divergence"] = row["divergence"]["first"]
            entry["lag_s"] = row["divergence"]["lag_s"]
    return list(found.values())


def _asked(executions: Rows) -> dict[str, tuple[str, Rows]]:
    """What is held against the labels, its key, and of whom; nobody planned what has no plan."""
    planned = [entry for entry in executions if entry["plan"] != NO_PLAN]
    asked = {name: (key, planned if key == "planned" else executions) for name, key in TRAJECTORIES}
    return {name: (key, rows) for name, (key, rows) in asked.items() if rows}


def cross_table(executions: Rows) -> dict[str, dict[str, dict[str, int]]]:
    """Planned, executed and seen, by their verdict, against the recorded label."""
    return {
        name: {
            word: {
                label: sum(entry[key] is value and entry["recorded"] == label for entry in rows)
                for label in LABELS
            }
            for value, word in WORDS.items()
        }
        for name, (key, rows) in _asked(executions).items()
    }


def agreement_of(executions: Rows) -> dict[str, dict[str, int]]:
    """How often what was said is the operator's label, of the executions where both are decided."""
    found = {}
    for name, (key, rows) in _asked(executions).items():
        both = [
            entry[key] is (entry["recorded"] == "success")
            for entry in rows
            if entry[key] is not None and entry["recorded"] in ("success", "failure")
        ]
        found[name] = {"k": sum(both), "n": len(both)}
    return found


def against_recorded(executions: Rows) -> dict[str, dict[str, Any]]:
    """Per task what was said against the recorded label: counts, and how often they agree."""
    by_task: dict[str, list[Mapping[str, Any]]] = {}
    for entry in executions:
        by_task.setdefault(entry["task"], []).append(entry)
    return {
        task: {"counts": cross_table(mine), "agreement": agreement_of(mine)}
        for task, mine in sorted(by_task.items())
    }


def describe_run(summary: Mapping[str, Any]) -> str:
    """The final tables as text."""
    skipped = _skipped_lines(summary.get("skipped_episodes", {}), "cannot be replayed")
    skipped += _skipped_lines(summary.get("nothing_to_replay", {}), "with nothing to replay")
    imported = _motion_lines(summary.get("imported", []))
    if not summary["rows"]:
        return "\n".join([*(imported or ["No trial to replay."]), *skipped])
    lines = imported + _count_lines(summary["counts"])
    executions = summary.get("executions", [])
    if executions:
        lines += ["", *_cross_lines(executions), "", *_divergence_lines(executions)]
    lines += _engine_lines(summary["rows"])
    lines += _sample_lines(summary["rows"])
    lines += _reason_lines(summary["rows"])
    lines += skipped
    kept = sum(row["skipped"] for row in summary["rows"])
    if kept:
        lines.append(f"{kept} of {len(summary['rows'])} were there already; --force redoes them.")
    return "\n".join(lines)


def _engine_lines(rows: Rows) -> list[str]:
    """Where several engines were asked: how often they agree, and what each says where not."""
    asked = [row for row in rows if len(row.get("engines") or ()) > 1 and not row["error"]]
    differing = [row for row in asked if row["engines_disagree"]]
    lines = []
    if asked:
        lines += ["", f"engines agree on {len(asked) - len(differing)} of {len(asked)} replays"]
    lines += [
        f"  {row['episode']} {row['plan']} {row['trajectory']}: {row['engines_disagree']}"
        for row in differing
    ]
    if any(SAME_ENGINE in row.get("warnings", ()) for row in rows):
        lines += ["", f"{SAME_ENGINE}: these verdicts are shown and never counted by evaluate"]
    return lines


def _reason_lines(rows: Rows) -> list[str]:
    """Why: of each rejection, of what was left undecided, and of what was not evaluated.

    A kinematic replay leaves objects alone and decides nothing by itself, which needs no list.
    """
    undecided = [
        row
        for row in rows
        if row["accepted"] is None and not row["error"] and row["mode"] == "dynamic"
    ]
    lists = (
        ("rejected:", [row for row in rows if row["accepted"] is False]),
        ("undecided:", undecided),
        ("not evaluated:", [row for row in rows if row["error"]]),
    )
    lines = []
    for title, listed in lists:
        lines += ["", title] if listed else []
        alike: dict[tuple[str, str, str | None], list[str]] = {}
        for row in listed:
            key = (row["episode"], row["plan"], row["reason"])
            alike.setdefault(key, []).append(f"{row['trajectory']} {row['mode']}")
        for (episode, plan, reason), which in alike.items():
            bare = (reason or "no reason given").removeprefix(f"{title} ")
            lines.append(f"  {episode} {plan} {', '.join(which)}: {bare}")
    return lines


def _skipped_lines(skipped: Mapping[str, str], what: str) -> list[str]:
    """Episodes of which nothing, or less, could be replayed."""
    lines = [
        f"  {name}: {NOT_EVALUATED}{why.removeprefix(NOT_EVALUATED)}"
        for name, why in sorted(skipped.items())
    ]
    return ["", f"episodes {what}:", *lines] if lines else []


def _sample_lines(rows: Rows) -> list[str]:
    """How sure each verdict is, where varied replays were asked for."""
    lines = []
    for row in rows:
        p = row.get("p_success")
        if p is not None:
            lines.append(
                f"  {row['episode']} {row['plan']} {row['trajectory']}: "
                f"{p['k']:g} of {p['n']:g}, {p['value']:.0%} [{p['low']:.0%}, {p['high']:.0%}]"
            )
    return ["", "varied replays that succeed:", *lines] if lines else []


def _count_lines(counts: Counts) -> list[str]:
    width = max(len(key) for key in counts)
    lines = [
        f"{'':{width}}  {'n':>5} {'accepted':>9} {'rejected':>9} {'undecided':>9} "
        f"{'not evaluated':>13}"
    ]
    lines += [
        f"{key:{width}}  {c['n']:>5} {c['accepted']:>9} {c['rejected']:>9} {c['undecided']:>9} "
        f"{c['failed']:>13}"
        for key, c in sorted(counts.items())
    ]
    if any("kinematic" in key and c["undecided"] for key, c in counts.items()):
        lines.append("kinematic: only the robot moves, so it can reject and never accept")
    return lines


def _cross_lines(executions: Rows) -> list[str]:
    """One table per task, because what they ask is not the same."""
    lines: list[str] = []
    tables = against_recorded(executions)
    for task, table in tables.items():
        lines += ["", f"{task}:"] if len(tables) > 1 else []
        lines += _cross_of(table["counts"], table["agreement"])
    return lines


def _cross_of(counts: Mapping[str, Counts], agreement: Counts) -> list[str]:
    lines = [
        f"{'':28}  {'recorded:':>9} {'success':>8} {'failure':>8} {'unlabelled':>10} {'agree':>9}"
    ]
    for name, rows in counts.items():
        agree = f"{agreement[name]['k']} of {agreement[name]['n']}"
        for word, cells in rows.items():
            lines.append(
                f"{name:<17} {word:<10}  {'':>9} {cells['success']:>8} {cells['failure']:>8} "
                f"{cells['unknown']:>10} {agree:>9}".rstrip()
            )
            agree = ""
    return lines


def _divergence_lines(executions: Rows) -> list[str]:
    unplanned = all(entry["plan"] == NO_PLAN for entry in executions)
    sides = "executed and recorded" if unplanned else "planned, executed and recorded"
    lines = [f"where {sides} diverge first:"]
    for entry in executions:
        first = entry["divergence"]
        if first is None:
            text = "nowhere" if entry["executed"] is not None else "not compared"
        else:
            text = f"{first['first_t_ns'] * 1e-9:.2f} s: {first['detail']} ({first['attribution']})"
        lag = "" if entry["lag_s"] is None else f", lag {entry['lag_s'] * 1e3:.0f} ms"
        lines.append(f"  {entry['episode']} {entry['plan']}: {text}{lag}")
    return lines


def _motion_lines(rows: Rows) -> list[str]:
    """Say how many replays there are of imported recordings."""
    counts = Counter(row["trajectory"] for row in rows)
    lines = [
        f"imported recordings, {trajectory} ({words}): {counts[trajectory]} replays"
        for trajectory, words in (("planned", "joint schedule"), ("executed", "measured tool"))
        if trajectory in counts
    ]
    return [*lines, "Compare: robot-gst evaluate RUN"] if lines else []
