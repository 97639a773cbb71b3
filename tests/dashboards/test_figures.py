"""Drawings put values where they belong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dashboards import figures


def signal(values: np.ndarray) -> figures.Signal:
    return figures.Signal(
        name="a", style="recorded", t_s=np.linspace(0, 1, len(values)), values=np.asarray(values)
    )


@given(
    st.floats(-1e6, 1e6, allow_nan=False),
    st.floats(1e-6, 1e6),
    st.integers(2, 10),
)
def test_ticks_are_inside_few_and_evenly_spaced(low: float, span: float, wanted: int) -> None:
    high = low + span
    ticks = figures.nice_ticks(low, high, wanted)
    rounding = 4 * np.spacing(max(abs(low), abs(high)))
    margin = 1e-6 * span + rounding
    assert len(ticks) <= wanted + 1
    assert all(low - margin <= tick <= high + margin for tick in ticks)
    if len(ticks) > 2:
        steps = np.diff(ticks)
        assert np.allclose(steps, steps[0], rtol=1e-6, atol=rounding)


def test_tick_labels_tell_neighbours_apart() -> None:
    drawn = figures.axis(-0.02, 0.05, 0, 100)
    labels = [tick.label for tick in drawn.ticks]
    assert len(set(labels)) == len(labels)
    assert "−0.02" in labels
    assert "0.00" in labels


def test_thinning_keeps_a_single_spike() -> None:
    values = np.zeros(50_000)
    values[31_234] = 7.0
    plot = figures.time_plot("t", "m", [signal(values)], span_s=(0, 1))
    assert plot is not None
    points = plot.lines[0].pieces[0].split()
    assert len(points) < 1000
    heights = [float(point.split(",")[1]) for point in points]
    assert min(heights) == pytest.approx(plot.y.px(7.0), abs=0.02)


def test_nothing_to_draw_is_none_and_not_an_empty_plot() -> None:
    assert figures.time_plot("t", "m", [], span_s=(0, 1)) is None
    assert figures.time_plot("t", "m", [signal(np.full(3, np.nan))], span_s=(0, 1)) is None
    assert figures.stage_chart([("planned", [])], [], span_s=(0, 1)) is None


def test_stage_bars_keep_their_order_and_lose_labels_that_do_not_fit() -> None:
    spans = [
        figures.Span(start_s=0, end_s=5, label="approach", style="stage-0"),
        figures.Span(start_s=5, end_s=5.05, label="grasp", style="stage-1"),
    ]
    chart = figures.stage_chart([("planned", spans)], [(11.0, "late", "failure")], span_s=(0, 10))
    assert chart is not None
    (first, second), late = (
        map(chart.bar, spans),
        figures.Span(start_s=9, end_s=12, label="", style=""),
    )
    assert first[0] + first[1] < second[0] + second[1]
    assert (first[2], second[2]) == ("approach", "")
    assert sum(chart.bar(late)[:2]) <= chart.x.px_high
    assert chart.marks == ()


def test_a_slim_chart_has_the_same_stages_at_the_same_times() -> None:
    span = figures.Span(start_s=2, end_s=5, label="grasp", style="stage-0")
    wide = figures.stage_chart([("planned", [span])], [(3.0, "replan", "replan")], span_s=(0, 10))
    assert wide is not None
    slim = wide.at(350)
    assert (slim.lanes, slim.marks) == (wide.lanes, wide.marks)
    for chart in (wide, slim):
        start, width, label = chart.bar(span)
        scale = (chart.x.px_high - chart.x.px_low) / 10
        assert start == pytest.approx(chart.x.px_low + 2 * scale, abs=0.02)
        assert width == pytest.approx(3 * scale - 1.5, abs=0.02)
        assert label == "grasp"
        assert chart.x.px_high < chart.width
