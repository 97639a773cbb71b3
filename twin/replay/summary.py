"""The tables of ``robot-gst replay``: verdicts counted, and held against the operator's labels.

Every answer that is not a yes is listed with its reason.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.verdict import SAME_ENGINE
from twin.replay.failure import WORDS

SIDES = {
    ("planned", "dynamic"): "planned in twin",
    ("executed", "dynamic"): "executed in twin",
    ("executed", "kinematic"): "executed as seen",
}
"""What is held against the operator's label: two replays, and the success predicates on the objects
as they were localised before and after the execution."""

Rows = Sequence[Mapping[str, Any]]


def count_verdicts(rows: Rows) -> dict[str, dict[str, int]]:
    """Accepted, rejected, undecided and failed per trajectory and mode, and how many in all."""
    counts: dict[str, Counter[str]] = {}
    for row in rows:
        key = f"{row['trajectory']} {row['mode']}"
        if key == "planned dynamic" and not row["executed"]:
            key = "planned dynamic, never executed"
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


def against_recorded(rows: Rows, labels: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """By task and side, how often what was said is the label, of those where both are decided."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        label = labels.get(row["episode"])
        answer = row["predicates" if row["mode"] == "kinematic" else "accepted"]
        if row["executed"] and answer is not None and label in ("success", "failure"):
            sides = found.setdefault(row["task"], {})
            side = sides.setdefault(SIDES[row["trajectory"], row["mode"]], {"k": 0, "n": 0})
            side["k"] += answer is (label == "success")
            side["n"] += 1
    return found


def describe_run(summary: Mapping[str, Any]) -> str:
    """The final tables as text."""
    skipped = _skipped_lines(summary.get("skipped_episodes", {}), "cannot be replayed")
    skipped += _skipped_lines(summary.get("nothing_to_replay", {}), "with nothing to replay")
    imported = _motion_lines(summary.get("imported", []))
    if not summary["rows"]:
        return "\n".join([*(imported or ["No trial to replay."]), *skipped])
    lines = imported + _count_lines(summary["counts"])
    for task, sides in sorted(summary.get("against_recorded", {}).items()):
        told = ", ".join(f"{side} {each['k']} of {each['n']}" for side, each in sides.items())
        lines += ["", f"{task}, as the operator's labels say: {told}"]
    lines += _divergence_lines(summary["rows"])
    if any(SAME_ENGINE in row.get("warnings", ()) for row in summary["rows"]):
        lines += ["", f"{SAME_ENGINE}: these verdicts are shown and never counted by evaluate"]
    lines += _sample_lines(summary["rows"])
    lines += _reason_lines(summary["rows"])
    lines += skipped
    kept = sum(row["skipped"] for row in summary["rows"])
    if kept:
        lines.append(f"{kept} of {len(summary['rows'])} were there already; --force redoes them.")
    return "\n".join(lines)


def _reason_lines(rows: Rows) -> list[str]:
    """Why: of each rejection, of what was left undecided, and of what was not evaluated.

    A kinematic replay leaves objects alone and decides nothing by itself, which needs no list.
    """
    opened = [row for row in rows if row["accepted"] is None and row["mode"] == "dynamic"]
    lists = (
        ("rejected:", [row for row in rows if row["accepted"] is False]),
        ("undecided:", [row for row in opened if not row["error"]]),
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
    lines = [f"  {name}: {why}" for name, why in sorted(skipped.items())]
    return ["", f"episodes {what}:", *lines] if lines else []


def _sample_lines(rows: Rows) -> list[str]:
    """How sure each verdict is, where varied replays were asked for."""
    lines = []
    for row in rows:
        p = row.get("p_success")
        if p is not None:
            lines.append(
                f"  {row['episode']} {row['plan']} {row['trajectory']}: "
                f"{p['k']:g} of {p['n']:g}, p {p['value']:.0%} [{p['low']:.0%}, {p['high']:.0%}]"
            )
            lines += [f"    {text}" for text in row.get("decides", ())]
    return ["", "varied replays that succeed:", *lines] if lines else []


def _count_lines(counts: Mapping[str, Mapping[str, int]]) -> list[str]:
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


def _divergence_lines(rows: Rows) -> list[str]:
    """Where each execution that was compared diverges from plan and recording."""
    lines = []
    for row in rows:
        if row.get("divergence"):
            first, lag_s = row["divergence"]["first"], row["divergence"]["lag_s"]
            text = "nowhere"
            if first is not None:
                at = f"{first['first_t_ns'] * 1e-9:.2f} s"
                text = f"{at}: {first['detail']} ({first['attribution']})"
            lag = "" if lag_s is None else f", lag {lag_s * 1e3:.0f} ms"
            lines.append(f"  {row['episode']} {row['plan']}: {text}{lag}")
    return ["", "where the twin and the recording diverge first:", *lines] if lines else []


def _motion_lines(rows: Rows) -> list[str]:
    """Say how many replays there are of imported recordings."""
    counts = Counter(row["trajectory"] for row in rows)
    lines = [
        f"imported recordings, {trajectory} ({words}): {counts[trajectory]} replays"
        for trajectory, words in (("planned", "joint schedule"), ("executed", "measured tool"))
        if trajectory in counts
    ]
    return [*lines, "Compare: robot-gst evaluate RUN"] if lines else []
