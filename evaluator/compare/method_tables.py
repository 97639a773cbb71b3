"""Tables of several methods on the same views, the first laid out as the paper's Table I."""

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files

from evaluator.compare.image_measurements import StampedMeasurement
from evaluator.compare.image_tables import (
    StampedValue,
    cell_of,
    rounded,
    stamp_table,
    stamped_table,
)
from evaluator.compare.methods import MethodReport
from evaluator.compare.variants import RAW
from evaluator.metrics.scores import METRICS
from evaluator.metrics.stamp import UNSTATED, Stamp
from evaluator.result import Table

HEADLINE = ("psnr_db", "ssim_zero", "lpips_vgg_01")
"""Metrics of the first table, by the conventions of 3D Gaussian splatting papers."""
_NOTE = (
    "Means over the views that every method has. SSIM with zeros beyond the border and LPIPS of "
    "images in 0..1, as papers on 3D Gaussian splatting compute them; the next table has the other "
    "conventions, which give other numbers. LPIPS is not computed without a backbone."
)
_PAPER_NOTE = (
    "Printed in the paper, not measured here. Other scenes; resolution, split, masks, SSIM padding "
    "and LPIPS input are not stated, and the rows may come from different papers. So no number "
    "above can be called better or worse than one of these. A masked or plain background alone can "
    "lift SSIM from 0.55 to 0.92."
)


def method_tables(report: MethodReport, origin: str) -> tuple[Table, ...]:
    """Return the headline table, the paper's own beside it, every number, and the protocols.

    Args:
        report: What was found.
        origin: Where the images came from, for the note.
    """
    everything = [number for numbers in report.numbers.values() for number in numbers]
    return (
        _headline(report.numbers, origin),
        paper_table(),
        _all_metrics(report.numbers),
        _per_view(report),
        stamp_table("image_protocol", "Protocols of the image numbers", everything),
    )


def _headline(numbers: Mapping[str, Sequence[StampedMeasurement]], origin: str) -> Table:
    rows = []
    for method, found in numbers.items():
        raw = {number.metric.id: number for number in found if number.variant == RAW}
        rows.append(((method,), [_cell(raw, metric) for metric in HEADLINE]))
    return stamped_table(
        "image_methods",
        "Rendering quality on the same views",
        ("method",),
        ("PSNR (dB)", "SSIM", "LPIPS (vgg)"),
        rows,
        note=f"{_NOTE} Images: {origin}.",
    )


def _cell(found: Mapping[str, StampedMeasurement], metric: str) -> StampedValue:
    if metric in found:
        return cell_of(found[metric])
    # Without a backbone there is no measurement; the protocol of the row's others still holds.
    return StampedValue(value="not computed", stamp=found["psnr_db"].stamp)


def paper_table() -> Table:
    """Return Table I of the Robot-GST paper as printed, with the protocol it does not state."""
    path = files("evaluator.compare").joinpath("robot_gst_table_1.json")
    printed = json.loads(path.read_text(encoding="utf-8"))
    rows = [
        (
            (name,),
            [
                StampedValue(value=value, stamp=_unstated(column))
                for column, value in zip(printed["columns"], values, strict=True)
            ],
        )
        for name, *values in printed["rows"]
    ]
    return stamped_table(
        "image_paper", printed["title"], ("method",), printed["columns"], rows, note=_PAPER_NOTE
    )


def _unstated(column: str) -> Stamp:
    return Stamp(
        metric=column,
        implementation=UNSTATED,
        values=UNSTATED,
        window=UNSTATED,
        padding=UNSTATED,
        mask=UNSTATED,
        resolution=UNSTATED,
        crop=UNSTATED,
        alignment=UNSTATED,
        clamp=UNSTATED,
        split=UNSTATED,
        stored=UNSTATED,
        mean=UNSTATED,
        n=0,
    )


def _all_metrics(numbers: Mapping[str, Sequence[StampedMeasurement]]) -> Table:
    """Every metric of every method in every variant."""
    rows, columns = [], [metric for metric in METRICS if _has(numbers, metric)]
    for method, found in numbers.items():
        for variant in dict.fromkeys(n.variant for n in found):
            mine = {n.metric.id: n for n in found if n.variant == variant}
            rows.append(((method, variant.name), [_or_none(mine, metric) for metric in columns]))
    return stamped_table(
        "image_all",
        "Every image metric",
        ("method", "variant"),
        [METRICS[metric].column for metric in columns],
        rows,
        note="Empty: undefined, or not defined over single pixels of a mask. Gain and affine fit "
        "brightness to the recorded image: an exposure offset costs PSNR and hardly SSIM.",
    )


def _has(numbers: Mapping[str, Sequence[StampedMeasurement]], metric: str) -> bool:
    return any(number.metric.id == metric for found in numbers.values() for number in found)


def _or_none(mine: Mapping[str, StampedMeasurement], metric: str) -> StampedValue:
    if metric in mine:
        return cell_of(mine[metric])
    return StampedValue(value=None, stamp=next(iter(mine.values())).stamp)


def _per_view(report: MethodReport) -> Table:
    columns = [m for m in METRICS if any(m in view.values for view in report.views)]
    shown = sorted(report.views, key=lambda v: (v.values.get("psnr_db", float("inf")), v.view_id))
    return Table(
        id="image_views",
        title="Every view of every method, worst first",
        columns=("view", "method", *(METRICS[metric].column for metric in columns)),
        rows=tuple(
            (view.view_id, view.method, *(rounded(view.values.get(m)) for m in columns))
            for view in shown
        ),
        note=f"Raw. Protocols: the table of protocols, variant {RAW.name}. No PSNR: identical "
        "images.",
    )
