"""One line for each trial, the state in a few lines, and the same as records for other programs."""

from dataclasses import asdict
from typing import Any

from evaluator.live.ledger import Change, LiveTrial
from evaluator.live.next_start import NextStart
from evaluator.live.standing import GainStanding, RateStanding, Standing
from evaluator.statistics.sequential import Advice

SCHEMA_VERSION = 1


def outcome_word(trial: LiveTrial) -> str:
    """success, failure or unknown."""
    return {True: "success", False: "failure", None: "unknown"}[trial.recorded]


def label(task: str, condition: str, policy: str) -> str:
    """Return a cell in a reader's words."""
    return ", ".join(part.replace("_", " ") for part in (task, condition, policy) if part)


def what_happened(change: Change) -> str:
    """trial_0007: success; or what was corrected, or labelled late."""
    trial, before = change.trial, change.before
    text = f"{trial.episode}: {outcome_word(trial)}"
    if before is None or before.recorded == trial.recorded:
        return text
    if before.recorded is None:
        return f"{text} (labelled late)"
    return f"{text} (corrected, was {outcome_word(before)})"


def advice_words(advice: Advice | None, changed: str, stop: str) -> str:
    """Stop, or continue: about n more."""
    if changed:
        return f"stop: {changed}"
    if advice is None:
        return "continue: no --goal to decide"
    if advice.stop:
        return f"stop: {stop}"
    if advice.more_trials is None:
        return "continue: no end in sight at these rates"
    return f"continue: about {advice.more_trials} more"


def rate_words(rate: RateStanding, goal: float | None) -> str:
    """One cell's rate, its interval at any time, and what follows."""
    percent = 0.0 if goal is None else 100 * goal
    answer = rate.advice.answer if rate.advice else ""
    words = advice_words(rate.advice, rate.changed, f"{answer} {percent:g} %")
    return (
        f"{label(rate.task, rate.condition, rate.policy)} {rate.k}/{rate.n} "
        f"[{100 * rate.low:.1f}, {100 * rate.high:.1f}] %: {words}"
    )


def gain_words(gain: GainStanding) -> str:
    """One paired gain, its interval at any time, and what follows."""
    better = {"above": "replanning helps", "below": "replanning harms"}
    words = advice_words(gain.advice, gain.changed, better.get(gain.advice.answer, ""))
    value = 100 * (gain.improved - gain.worsened) / gain.n
    return (
        f"gain {label(gain.task, '', gain.policy)} {value:+.0f} pp "
        f"[{100 * gain.low:+.1f}, {100 * gain.high:+.1f}] over {gain.n} pairs "
        f"({gain.improved} improved, {gain.worsened} worsened): {words}"
    )


def next_words(proposal: NextStart | None) -> str:
    """What to run next."""
    if proposal is None:
        return "next: nothing, every question is settled"
    start = "a start not tried yet" if proposal.start_id is None else f"start {proposal.start_id}"
    cell = label(proposal.task, proposal.condition, proposal.policy)
    return f"next: {cell}, {start} ({proposal.reason})"


def change_line(
    change: Change, standing: Standing, proposal: NextStart | None, goal: float | None
) -> str:
    """Return the line of one trial."""
    trial = change.trial
    rate, gain = standing.rate(trial.key), standing.gain(trial.task, trial.policy)
    parts = [what_happened(change)]
    parts += [rate_words(rate, goal)] if rate is not None else []
    parts += [gain_words(gain)] if gain is not None else []
    return "; ".join([*parts, next_words(proposal)])


def state_lines(standing: Standing, proposal: NextStart | None, goal: float | None) -> list[str]:
    """Everything that is known, one line for each cell and gain."""
    if not standing.rates:
        return [f"no trial with a known outcome yet ({standing.unknown} without)"]
    lines = [rate_words(rate, goal) for rate in standing.rates]
    lines += [gain_words(gain) for gain in standing.gains]
    if standing.unknown:
        lines.append(f"{standing.unknown} trials without a known outcome are part of nothing")
    return [*lines, next_words(proposal)]


def record(
    *,
    run: str,
    stamp_ns: int,
    text: str,
    change: Change | None,
    standing: Standing,
    proposal: NextStart | None,
    goal: float | None,
) -> dict[str, Any]:
    """Return what is published, as ``advice.schema.json`` describes it.

    Args:
        run: Name of the run folder.
        stamp_ns: When [ns].
        text: The line that is printed.
        change: The trial it is about; None for the state at the start and at the end.
        standing: All cells and gains.
        proposal: What to run next.
        goal: The success rate asked about.
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "stamp_ns": stamp_ns,
        "run": run,
        "text": text,
        "episode": None if change is None else change.trial.episode,
        "outcome": None if change is None else outcome_word(change.trial),
        "goal": goal,
        "rates": [asdict(rate) for rate in standing.rates],
        "gains": [asdict(gain) for gain in standing.gains],
        "unknown": standing.unknown,
        "next": None if proposal is None else asdict(proposal),
    }
