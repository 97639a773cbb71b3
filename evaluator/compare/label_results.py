"""Does the label agree with the predicate on localised poses? Headline numbers keep the label."""

from collections.abc import Mapping, Sequence

from evaluator.compare.label import Witness
from evaluator.compare.measure import proportion, slug
from evaluator.compare.part import Part
from evaluator.compare.rows import TrialRow
from evaluator.result import Cell, Exclusion, Measurement, Table

NAMES = {True: "success", False: "failure", None: "open"}
OPEN = "the localised poses leave it open"
Pair = tuple[TrialRow, Witness]


def label_results(
    witnesses: Sequence[Witness], rows: Sequence[TrialRow], *, method: str = "wilson"
) -> Part:
    """Count the trials in which label and predicate say the same, and list the others.

    Args:
        witnesses: What the predicate says, of trials that were localised afterwards.
        rows: The trials with their labels; these alone enter every other number.
        method: Interval of rates.
    """
    if not witnesses:
        reason = "no trial of a known task was localised after its execution"
        return Part(missing=(f"label against localised predicate: no data ({reason})",))
    of_episode: Mapping[str, Witness] = {witness.episode: witness for witness in witnesses}
    pairs = [(row, of_episode[row.episode]) for row in rows if row.episode in of_episode]
    tasks = sorted({row.task for row, _ in pairs})
    measurements = [_rate("label.localised.rate", "", pairs, method)]
    measurements += [
        _rate(
            f"label.localised.{slug(task)}.rate",
            f" of {task}",
            [pair for pair in pairs if pair[0].task == task],
            method,
        )
        for task in tasks
    ]
    counted = [pair for pair in pairs if pair[0].unit == "object"]
    if counted:
        measurements.append(_counts(counted, method))
    return Part(
        measurements=tuple(measurements),
        tables=(_cross_table(pairs), *_disagreements(pairs)),
        exclusions=tuple(_left_out(pairs)),
    )


def _known(pairs: Sequence[Pair]) -> list[Pair]:
    return [(r, w) for r, w in pairs if r.recorded is not None and w.says is not None]


def _rate(measurement_id: str, where: str, pairs: Sequence[Pair], method: str) -> Measurement:
    known = _known(pairs)
    agreed = sum(row.recorded is witness.says for row, witness in known)
    skipped = sorted({kind for _, witness in known for kind in witness.not_asked})
    without = f"; clauses that one look leaves open are not asked: {', '.join(skipped)}"
    return proportion(
        measurement_id,
        agreed,
        len(known),
        definition=f"trials{where} where the operator's label and the success predicate on the "
        f"poses localised after the execution say the same / trials where both are known"
        f"{without if skipped else ''}",
        counted="trial",
        reason_if_undefined="no trial has both a label and a decided predicate",
        episodes=[row.episode for row, _ in known],
        method=method,
    )


def _counts(pairs: Sequence[Pair], method: str) -> Measurement:
    known = [(r, w) for r, w in pairs if r.k is not None and w.objects_done is not None]
    return proportion(
        "label.objects.rate",
        sum(row.k == witness.objects_done for row, witness in known),
        len(known),
        definition="trials where the operator counted as many objects as the predicate on the "
        "localised poses / trials labelled by object where both are known",
        counted="trial",
        reason_if_undefined="no trial labelled by object has a decided predicate of each object",
        episodes=[row.episode for row, _ in known],
        method=method,
    )


def _cross_table(pairs: Sequence[Pair]) -> Table:
    counts = {(label, said): 0 for label in NAMES for said in NAMES}
    for row, witness in pairs:
        counts[row.recorded, witness.says] += 1
    return Table(
        id="label_predicate",
        title="Operator's label against the predicate on localised poses",
        columns=("label", "predicate: success", "predicate: failure", "predicate: open"),
        rows=tuple(
            ("unlabelled" if label is None else NAMES[label], *(counts[label, s] for s in NAMES))
            for label in NAMES
        ),
        note="The same predicate that judges replays, asked of the poses localised after the "
        "execution. A second witness: headline numbers use the label.",
    )


def _disagreements(pairs: Sequence[Pair]) -> tuple[Table, ...]:
    rows: list[tuple[Cell, ...]] = [
        (
            row.episode,
            row.task,
            row.condition.replace("_", " "),
            NAMES[row.recorded],
            NAMES[witness.says],
            witness.detail,
        )
        for row, witness in _known(pairs)
        if row.recorded is not witness.says
    ]
    if not rows:
        return ()
    return (
        Table(
            id="label_disagreements",
            title="Trials in which label and predicate disagree",
            columns=("episode", "task", "condition", "label", "predicate", "what it found"),
            rows=tuple(rows),
            note="Look at these: a wrong label, a wrong localisation, or a predicate that does not "
            "mean what people mean.",
        ),
    )


def _left_out(pairs: Sequence[Pair]) -> list[Exclusion]:
    return [
        Exclusion(
            episode=row.episode, scope="label against predicate", reason=f"{OPEN}: {witness.detail}"
        )
        for row, witness in pairs
        if witness.says is None
    ]
