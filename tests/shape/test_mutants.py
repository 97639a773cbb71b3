"""The list of mutations fits the code and the tests as they are (``make mutants`` runs it)."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("mutants", ROOT / "tests/mutants/mutants.py")
assert SPEC is not None
assert SPEC.loader is not None
mutants = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(mutants)


def test_every_mutation_fits_the_code_and_has_tests_near_by() -> None:
    listed, texts = mutants.load(), mutants.sources(ROOT)
    assert len(listed) >= 60
    assert len({mutant.id for mutant in listed}) == len(listed)
    wrong = {}
    for mutant in listed:
        try:
            mutants.applied(mutant, texts)
            mutants.test_files(mutant, ROOT)
        except mutants.EntryError as error:
            wrong[mutant.id] = str(error)
    assert wrong == {}, "adapt tests/mutants/mutants.toml to the new text"


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
