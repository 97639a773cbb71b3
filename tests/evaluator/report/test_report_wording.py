"""How a number is written: value, count and interval in one unit, said once."""

import pytest

from evaluator.report.wording import measurement_text
from evaluator.result import Interval, Measurement


def measurement(name: str, value: float, unit: str, low: float, high: float) -> Measurement:
    interval = Interval(low=low, high=high, level=0.95, method="wilson", worst_coverage=0.897)
    k, n = (5, 6) if unit == "1" else (None, 6)
    return Measurement(
        id=name,
        value=value,
        unit=unit,
        definition="d",
        interval=interval,
        k=k,
        n=n,
        counted="group",
    )


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (("x", 5 / 6, "1", 0.436, 0.97), "5/6 = 83.3 % [43.6, 97.0]"),
        (("agreement.bias_pp", 12.0, "pp", -1.0, 25.0), "+12.0 pp (n = 6 groups) [-1.0, +25.0]"),
        (("agreement.mae_pp", 12.0, "pp", 3.0, 25.0), "12.0 pp (n = 6 groups) [3.0, 25.0]"),
        (("x", 0.0123, "m", 0.01, 0.02), "12.30 mm (n = 6 groups) [10.00, 20.00]"),
    ],
)
def test_a_number_says_its_unit_once_and_its_interval_in_it(
    shown: tuple[str, float, str, float, float], text: str
) -> None:
    written = measurement_text(measurement(*shown))
    assert written == f"{text} (95 % Wilson; guaranteed coverage at this n: 89.7 %)"


def test_a_relative_gain_says_what_it_rests_on() -> None:
    gain = Measurement(
        id="gain.relative.recorded.average",
        value=0.4458,
        unit="1",
        definition="d",
        n=3,
        counted="task",
    )
    assert measurement_text(gain) == "+44.6 % relative (n = 3 tasks)"


@pytest.mark.parametrize(("value", "text"), [(1e300, "1e+300"), (1.25e8, "1.25e+08")])
def test_numbers_nobody_reads_digit_by_digit_are_short(value: float, text: str) -> None:
    assert measurement_text(Measurement(id="x", value=value, unit="1", definition="d")) == text
