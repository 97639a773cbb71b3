"""A difference is refused unless it was allowed beforehand."""

import importlib.util
from pathlib import Path

HERE = Path(__file__).parent
SPEC = importlib.util.spec_from_file_location("compare_goldens", HERE / "compare_goldens.py")
assert SPEC is not None
assert SPEC.loader is not None
goldens = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(goldens)

BEFORE = {"tables": {"layout": [1], "success": [1, 2]}, "value": 0.5, "files": 150}
AFTER = {"tables": {"success": [1, 3]}, "value": 0.5, "files": 30, "more": True}


def test_each_difference_is_told_where_it_is() -> None:
    found = list(goldens.differences(BEFORE, AFTER, "demo"))
    assert [(each.kind, each.path) for each in found] == [
        ("changed", "demo/files"),
        ("new", "demo/more"),
        ("gone", "demo/tables/layout"),
        ("changed", "demo/tables/success/1"),
    ]


def test_a_line_allows_one_kind_at_its_pattern() -> None:
    allowed = goldens.allowances(
        "# a remark\ngone */layout  # said by success\nany */files  # fewer\n"
    )
    found = list(goldens.differences(BEFORE, AFTER, "demo"))
    refused = [each.path for each in found if goldens.permitted(each, allowed) is None]
    assert refused == ["demo/more", "demo/tables/success/1"]


def test_a_truth_is_no_number_and_a_shorter_list_has_changed() -> None:
    found = list(goldens.differences({"a": True, "b": [1, 2]}, {"a": 1, "b": [1]}, "x"))
    assert [each.path for each in found] == ["x/a", "x/b"]


def test_every_line_of_the_list_gives_its_reason_and_is_no_licence_for_numbers() -> None:
    lines = goldens.allowances((HERE / "allowed_differences.txt").read_text())
    assert [line for line in lines if not line.why] == []
    assert {line.kind for line in lines} <= {"gone", "new", "changed", "any"}
    value = goldens.Difference("changed", "demo/measurements/rate.recorded.cube/value", "")
    assert goldens.permitted(value, lines) is None
