"""What the tables of ``robot-gst replay`` count: verdicts, and what was said against the label."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError

WORDS = {True: "accepted", False: "rejected", None: "undecided"}
LABELS = ("success", "failure", "unknown")
PLANNED, EXECUTED, SEEN = "planned in twin", "executed in twin", "executed as seen"
TELLINGS = ((PLANNED, "planned"), (EXECUTED, "executed"), (SEEN, "recorded_predicates"))
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
        if "+attach" in (row.get("engine") or ""):
            key += ", attached grasp"
        counts.setdefault(key, Counter())["failed" if row["error"] else WORDS[row["accepted"]]] += 1
        counts[key]["n"] += 1
    words = ("n", "accepted", "rejected", "undecided", "failed")
    return {key: {word: counter[word] for word in words} for key, counter in counts.items()}


def recorded_labels(run: RunFolder, episode_ids: Sequence[str]) -> dict[str, str]:
    """What the operator said of each episode: success, failure or unknown."""
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
    said = [event.get("outcome") for event in streams.events(episode) if event["type"] == "label"]
    last = said[-1] if said else None
    return str(last.get("result", "unknown")) if isinstance(last, dict) else "unknown"


def executions_of(rows: Rows, labels: Mapping[str, str]) -> list[dict[str, Any]]:
    """One entry per executed plan: what each side says, and where they part first."""
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
                "apart": None,
            },
        )
        if row["mode"] == "kinematic":
            entry["recorded_predicates"] = row.get("predicates")
        else:
            entry[row["trajectory"]] = row["accepted"]
        if row.get("divergence"):
            entry["apart"], entry["lag_s"] = row["divergence"]["first"], row["divergence"]["lag_s"]
    return list(found.values())


def cross_table(executions: Rows) -> dict[str, dict[str, dict[str, int]]]:
    """Planned, executed and seen, by what they said, against the recorded label."""
    return {
        name: {
            word: {
                label: sum(
                    entry[key] is value and entry["recorded"] == label for entry in executions
                )
                for label in LABELS
            }
            for value, word in WORDS.items()
        }
        for name, key in TELLINGS
    }


def agreement_of(executions: Rows) -> dict[str, dict[str, int]]:
    """How often what was said is the operator's label, of the executions where both are decided."""
    found = {}
    for name, key in TELLINGS:
        both = [
            entry[key] is (entry["recorded"] == "success")
            for entry in executions
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
