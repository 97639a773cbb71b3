"""The rows of the recorder's table: each scenario measures, prints and stores its own."""

import statistics
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import Target, report_targets

from record.cell import CellSpec
from record.frames import source_name
from record.kill import kill_ours, kill_reference
from record.stall import run_stall
from record.throughput import Recording, median_core, record_ours, record_reference

SHARED_MB = 256


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How long and how often."""

    folder: Path
    """Where episodes go; the notes say what kind of disk that is."""
    where: str
    depth: str = "noisy"
    repeats: int = 5
    seconds: float = 60.0
    long_s: float = 600.0
    kills: int = 100
    kill_s: float = 4.0

    @property
    def spec(self) -> CellSpec:
        """The ordinary cell: 480p."""
        return CellSpec(depth=self.depth)  # type: ignore[arg-type]

    def note(self, text: str) -> str:
        """What a number was measured on."""
        return f"{text}; {self.depth} depth from {source_name()}; episodes on {self.where}"


def ratio(plan: Plan) -> None:
    """480p, lossless: our processor time and the reference's, turn by turn.

    Transports as in the recorder study, section 2: ours through shared memory, the reference over
    TCP; ours over TCP stands beside it.
    """
    ours: list[Recording] = []
    over_tcp: list[Recording] = []
    compact: list[Recording] = []
    reference: list[Recording] = []
    for index in range(plan.repeats):
        folder = plan.folder / f"ratio{index}"
        reference.append(record_reference(plan.spec, plan.seconds, folder / "reference"))
        ours.append(
            record_ours(plan.spec, plan.seconds, folder / "ours", shared_memory_mb=SHARED_MB)
        )
        short_s = min(plan.seconds, 20.0)
        over_tcp.append(record_ours(plan.spec, short_s, folder / "tcp"))
        compact.append(
            record_ours(
                plan.spec,
                short_s,
                folder / "compact",
                shared_memory_mb=SHARED_MB,
                depth="compact",
            )
        )
    core, slow, tcp = median_core(ours), median_core(reference), median_core(over_tcp)
    kept = statistics.median(run.kept_of_wanted for run in reference)
    beside = (
        f"mcap Writer zstd + PNG: {slow:.3f} core, {kept:.1%} of the frames; "
        f"ours over tcp: {tcp:.3f}, {tcp / slow:.2f} of it"
    )
    lost = sum(run.total("lost") for run in [*ours, *over_tcp])
    report_targets(
        "record_480p",
        [
            Target(what="480p core", measured=core, limit=0.40, unit="core", reference=beside),
            Target(what="480p core / reference", measured=core / slow, limit=0.45),
            Target(
                what="480p CPU time per image kept / reference",
                measured=_cpu_per_image(ours) / _cpu_per_image(reference),
                limit=0.45,
                reference="the reference slows its publisher where it falls behind",
            ),
            Target(
                what="480p core, compact depth",
                measured=median_core(compact),
                limit=0.40,
                unit="core",
                reference=f"{compact[0].file_mb / compact[0].seconds:.1f} MB/s against "
                f"{ours[0].file_mb / ours[0].seconds:.1f} MB/s",
            ),
            Target(what="480p messages lost, all repeats", measured=lost, limit=0),
            _inexact("480p topics altered or misdeclared", [*ours, *over_tcp, *compact]),
        ],
        note=plan.note(f"2 x 640x480 RGB-D, {plan.repeats} x {plan.seconds:g} s, shared memory"),
        ours=_records(ours),
        over_tcp=_records(over_tcp),
        compact=_records(compact),
        reference=_records(reference),
    )


def long(plan: Plan) -> None:
    """480p for a long time: nothing lost."""
    run = record_ours(plan.spec, plan.long_s, plan.folder / "long", shared_memory_mb=SHARED_MB)
    sent, wanted = run.total("sent"), run.total("wanted")
    report_targets(
        "record_long",
        [
            Target(
                what=f"480p {plan.long_s:g} s: messages lost",
                measured=run.total("lost"),
                limit=0,
                reference=f"{sent} sent of {wanted} due, peak {run.peak_rss_mb:.0f} MB",
            ),
            Target(
                what=f"480p {plan.long_s:g} s: core", measured=run.core, limit=0.40, unit="core"
            ),
            _inexact("480p long: topics altered or misdeclared", [run]),
        ],
        note=plan.note(f"2 x 640x480 RGB-D, lossless, {plan.long_s:g} s, shared memory"),
        ours=_records([run]),
    )


def hd(plan: Plan) -> None:
    """720p, compact depth, shared memory."""
    spec = replace(plan.spec, width=1280, height=720, pool=8)
    ours = [
        record_ours(
            spec,
            plan.seconds,
            plan.folder / f"hd{index}",
            shared_memory_mb=2 * SHARED_MB,
            depth="compact",
        )
        for index in range(plan.repeats)
    ]
    reference = record_reference(spec, min(plan.seconds, 20.0), plan.folder / "hd-reference")
    beside = f"mcap Writer zstd + PNG: {reference.kept_of_wanted:.1%}, {reference.core:.3f} core"
    of_sent = [
        run.total("kept", images_only=True) / run.total("sent", images_only=True) for run in ours
    ]
    report_targets(
        "record_720p",
        [
            Target(
                what="720p frames kept of those due",
                measured=statistics.median(run.kept_of_wanted for run in ours),
                limit=0.995,
                at_most=False,
                reference=beside,
            ),
            Target(
                what="720p frames kept of those sent",
                measured=statistics.median(of_sent),
                limit=0.995,
                at_most=False,
            ),
            Target(what="720p core", measured=median_core(ours), limit=0.75, unit="core"),
            _inexact("720p topics altered or misdeclared", ours),
        ],
        note=plan.note(
            f"2 x 1280x720 RGB-D, compact, shared memory, {plan.repeats} x {plan.seconds:g} s"
        ),
        ours=_records(ours),
        reference=_records([reference]),
    )


def _inexact(what: str, runs: list[Recording]) -> Target:
    count = sum(not verdict.is_exact for run in runs for verdict in run.verdicts.values())
    return Target(what=what, measured=count, limit=0, unit="topics")


def _cpu_per_image(runs: list[Recording]) -> float:
    return statistics.median(run.cpu_s / run.total("kept", images_only=True) for run in runs)


def _records(runs: list[Recording]) -> list[dict[str, Any]]:
    return [run.to_record() for run in runs]


def stall(plan: Plan) -> None:
    """A recorder that stands still must not slow a controller."""
    free, stalled = [], []
    for index in range(plan.repeats):
        free.append(run_stall(plan.spec, plan.folder / f"free{index}", stall=False))
        stalled.append(run_stall(plan.spec, plan.folder / f"stalled{index}", stall=True))
    usual, worst = (statistics.median(run.put_max_ms for run in runs) for runs in (free, stalled))
    report_targets(
        "record_stall",
        [
            Target(
                what="joints' slowest put, recorder stopped 5 s / running",
                measured=worst / usual,
                limit=1.2,
                reference=f"{worst:.2f} ms against {usual:.2f} ms, medians of the maxima",
            ),
            Target(
                what="joint messages the controller left out",
                measured=sum(run.joints_wanted - run.joints_sent for run in stalled),
                limit=sum(run.joints_wanted - run.joints_sent for run in free),
            ),
            Target(
                what="stalled runs whose ledger differs from the sender's",
                measured=sum(not run.is_exact for run in stalled),
                limit=0,
                reference=f"{sum(run.lost for run in stalled)} messages lost in all",
            ),
        ],
        note=plan.note(f"joints at 500 Hz in a process of their own, {plan.repeats} pairs"),
        running=[asdict(run) for run in free],
        stopped=[asdict(run) for run in stalled],
    )


def kill(plan: Plan) -> None:
    """Kill -9 at random instants, in four mixes: joints only or all, recording or finalising."""
    rng = np.random.default_rng(11)
    joints = replace(plan.spec, streams="joints")
    runs: dict[str, list[Any]] = {}
    for index in range(plan.kills):
        finalising = index % 4 == 3
        spec = joints if index % 2 else plan.spec
        name = f"{spec.streams}, {'finalising' if finalising else 'recording'}"
        folder = plan.folder / f"kill{index}"
        run = kill_ours(spec, folder, rng, seconds=plan.kill_s, finalising=finalising)
        runs.setdefault(name, []).append(run)
    sent, found = kill_reference(joints, plan.folder / "kill-reference", seconds=plan.kill_s)
    every = [run for group in runs.values() for run in group]
    tails = [max(run.tail_s.values(), default=float("inf")) for run in every]
    report_targets(
        "record_kill",
        [
            Target(
                what=f"kill -9 x {plan.kills}: recovered",
                measured=sum(run.recovered for run in every) / len(every),
                limit=1.0,
                at_most=False,
                reference=f"joints only, mcap Writer: {found} of {sent} messages left",
            ),
            Target(what="longest tail lost on any topic", measured=max(tails), limit=0.5, unit="s"),
            Target(
                what="messages missing before the tail",
                measured=sum(run.holes for run in every),
                limit=0,
            ),
        ],
        note=plan.note(
            ", ".join(
                f"{name}: {len(group)} ({sum(run.finished for run in group)} too late)"
                for name, group in runs.items()
            )
        ),
        median_tail_s=statistics.median(tails),
        runs={name: [asdict(run) for run in group] for name, group in runs.items()},
    )


SCENARIOS = {"ratio": ratio, "long": long, "hd": hd, "stall": stall, "kill": kill}
