"""What constraints cost: states of each kind, and hostile replies of a model."""

import statistics
import sys
import time
import tracemalloc

import numpy as np
from measure import ROOT, Target, cpu_seconds, report_targets

NUM_STATES = 1000


def main() -> None:
    """Time every kind, and every hostile reply."""
    sys.path.insert(0, str(ROOT / "tests" / "twin" / "plan" / "constrain"))
    kinds, details = evaluated()
    replies = judged()
    report_targets(
        "plan_constrain",
        [*kinds, *replies],
        note=f"{NUM_STATES} states of each kind; CPU time, one thread",
        microseconds_per_state=details,
    )


def evaluated() -> tuple[list[Target], dict[str, float]]:
    from block_scene import EXAMPLES, around, blocks

    from twin.plan.constrain.kinds import compile_constraint

    details = {}
    for name, (record, start, _) in EXAMPLES.items():
        constraint = compile_constraint(record, blocks())
        states = around(start, NUM_STATES, np.random.default_rng(0))
        plain = cpu_seconds(lambda c=constraint, s=states: c.violation(s), repeats=5)
        details[name] = statistics.median(plain) * 1e6 / NUM_STATES
    slowest = max(details, key=lambda name: details[name])
    middle = statistics.median(details.values())
    return [
        Target(what="median kind", measured=middle, limit=5.0, unit="us"),
        Target(what=f"slowest kind ({slowest})", measured=details[slowest], limit=200.0, unit="us"),
    ], details


def judged() -> list[Target]:
    from hostile_replies import TASK, hostile_replies

    from bridge.task.task_file import load_task
    from twin.plan.constrain.reply import ReplyError, read_reply
    from twin.plan.constrain.schema import Vocabulary

    vocabulary = Vocabulary.of_task(load_task("cube_into_box"))
    replies = list(hostile_replies())

    def refused(reply: str) -> tuple[str, ...]:
        try:
            read_reply(reply, vocabulary, TASK)
        except ReplyError as error:
            return error.problems
        return ()

    unplaced = [name for name, reply, place in replies if not told_place(refused(reply), place)]
    seconds, peaks = [], []
    for _, reply, _ in replies:
        begin = time.process_time()
        refused(reply)
        seconds.append(time.process_time() - begin)
    tracemalloc.start()
    for _, reply, _ in replies:
        tracemalloc.reset_peak()
        refused(reply)
        peaks.append(tracemalloc.get_traced_memory()[1])
    tracemalloc.stop()
    return [
        Target(what="hostile replies", measured=len(replies), limit=140, at_most=False),
        Target(what="not refused with their place", measured=len(unplaced), limit=0),
        Target(what="slowest reply", measured=max(seconds) * 1e3, limit=50, unit="ms"),
        Target(what="largest reply", measured=max(peaks) / 1e6, limit=50, unit="MB"),
    ]


def told_place(problems: tuple[str, ...], place: str) -> bool:
    return any(text.startswith(f"{place}: ") for text in problems)


if __name__ == "__main__":
    main()
