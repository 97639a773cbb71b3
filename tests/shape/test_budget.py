"""The house may shrink and not grow: every row of the budget holds (``-s`` prints the table)."""

from house_budget import budget, code_lines, options, sizes, sums, table, uncounted

SOURCE = '''"""Of a module,
on two lines."""

# a comment
LIMIT = """text
# not a comment

"""
"""Of a constant."""


def find(a: int) -> int:
    """Find it."""
    return a  # trailing
'''


def test_every_row_stays_within_its_budget() -> None:
    rows = budget()["lines"]
    found = sizes() | sums()
    allowed = {row: entry["at_most"] for row, entry in rows.items()} | budget()["sums"]
    goal = {row: entry["goal"] for row, entry in rows.items() if "goal" in entry}
    print("\n" + table(found, allowed, goal | budget()["goals"]))
    over = {row: (found[row], allowed[row]) for row in allowed if found[row] > allowed[row]}
    assert over == {}, "what needs more room removes something first (rows: now, budget)"


def test_every_file_that_may_hold_code_is_counted() -> None:
    assert uncounted() == []


def test_code_is_counted_without_docstrings_comments_and_blanks() -> None:
    assert code_lines(SOURCE) == 6


def test_flags_are_counted_by_command() -> None:
    by_command = {name: shown for name, _, shown in options()}
    assert "--force" in by_command["rebuild"]
    assert "--json" not in by_command["rebuild"]
