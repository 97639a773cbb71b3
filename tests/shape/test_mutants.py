"""Mutations are drawn from the whole code, change one place, and have tests near by."""

import ast
import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "mutants"))
SPEC = importlib.util.spec_from_file_location("mutants", ROOT / "tests/mutants/mutants.py")
assert SPEC is not None
assert SPEC.loader is not None
mutants = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(mutants)
from draw import draw, near_tests, places  # noqa: E402

CODE = """
def decide(a: float = 1.0) -> bool:
    \"\"\"More than 2.\"\"\"
    if not a > 2 and all([a]):
        raise ValueError(f"{a + 1}")
    return bool(np.mean(-a) + a[0] in (3,))
"""


def test_each_place_is_changed_once_and_no_text_is() -> None:
    found = {(mutant.old, mutant.new) for mutant in places("x.py", CODE)}
    assert found == {
        ("not ", ""),
        (">", ">="),
        ("2", "4"),
        ("and", "or"),
        ("all", "any"),
        ("mean", "median"),
        ("-", ""),
        ("+", "-"),
        ("0", "1"),
        ("in", "not in"),
        ("3", "6"),
    }
    for mutant in places("x.py", CODE):
        ast.parse(mutant.applied(CODE))


def test_a_draw_is_that_of_its_seed_and_its_files_have_tests() -> None:
    drawn = draw("a/1", 20)
    assert drawn == draw("a/1", 20) != draw("a/2", 20)
    assert len({mutant.id for mutant in drawn}) == 20
    assert {mutant.path.split("/")[0] for mutant in drawn} > {"twin"}
    assert "tests/bridge/test_gone.py" in near_tests("bridge/gone.py")
    near = [mutant for mutant in drawn if near_tests(mutant.path)]
    assert len(near) >= 18


@pytest.mark.parametrize(
    ("code", "output", "said"),
    [
        (0, "3 passed", ("survived", "")),
        (
            1,
            "FAILED tests/a/test_b.py::test_c - AssertionError",
            ("caught", "tests/a/test_b.py::test_c"),
        ),
        (None, "", ("error", "it took too long")),
        (5, "3 deselected", ("error", "no test was chosen")),
        (2, "ImportError: x\n", ("error", "pytest ended with 2: ImportError: x")),
    ],
)
def test_only_a_failing_test_counts_as_caught(
    code: int | None, output: str, said: tuple[str, str]
) -> None:
    assert mutants.judged(code, output) == said
