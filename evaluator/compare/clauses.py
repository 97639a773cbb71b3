"""What each clause of a verdict said: the three factors, and every success predicate by its kind.

A clause of several objects says no as soon as one object fails it.
"""

from bridge.task.verdict import Verdict

FACTORS = ("ik", "clearance", "terminal")
Clauses = tuple[tuple[str, bool], ...]
"""Name and answer; undecided clauses are left out. Predicates are ``terminal.inside`` and so on."""


def clauses_of(verdict: Verdict | None) -> Clauses:
    """List the decided clauses of a verdict; predicates only of the replayed side."""
    if verdict is None:
        return ()
    found: dict[str, bool | None] = {name: getattr(verdict, name).value for name in FACTORS}
    for finding in verdict.findings:
        if finding.get("side", "replayed") != "replayed":
            continue
        name = f"terminal.{finding.get('kind', 'unnamed')}"
        found[name] = (
            _both(found[name], finding.get("value")) if name in found else (finding.get("value"))
        )
    return tuple((name, value) for name, value in found.items() if isinstance(value, bool))


def _both(first: bool | None, second: bool | None) -> bool | None:
    """And, in three-valued logic."""
    if first is False or second is False:
        return False
    return None if first is None or second is None else True
