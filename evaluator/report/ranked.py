"""Which tables and figures a report shows, by what somebody decides by them."""

from fnmatch import fnmatchcase

from evaluator.result import Results, Table

MOST_TABLES = 12
"""In a report; ``--all`` shows the rest too."""
TABLES: dict[str, str] = {
    "published": "whether a printed number may be quoted",
    "comparisons": "which candidate to use, and whether to run more trials",
    "standing": "which candidates to keep",
    "conclusions": "for which task the twin may stand in for the robot",
    "layout": "whether to run with replanning",
    "success": "which candidate to use",
    "notes": "what these numbers must not be taken for",
    "trials": "which trial to look at",
    "against": "which of two twins to use",
    "image_methods": "which reconstruction to use",
    "confusion": "whether the twin's yes may start the robot, and its no may stop it",
    "funnel": "on which stage to work",
    "failures": "which cause to remove first",
    "end_points_*": "whether the engine's friction and timing are right",
    "motion": "whether to work on the controller or on the calibration",
    "final_states": "whether the localisation is good enough for the task",
    "views_0": "whether the scene is good enough to look at",
    "raters": "whether the labels can be trusted",
}
"""What each table decides, the most urgent first."""
FIGURES: dict[str, str] = {
    "success": "which candidate to use",
    "scatter": "whether the twin's rates may stand in for recorded ones",
}


def shown_tables(results: Results, *, everything: bool = False) -> list[Table]:
    """Return the tables that a report shows, in their own order."""
    if everything:
        return list(results.tables)
    places = {table.id: _place(table.id) for table in results.tables if table.rows}
    ranked = sorted((place, name) for name, place in places.items() if place is not None)
    chosen = {name for _, name in ranked[:MOST_TABLES]}
    return [table for table in results.tables if table.id in chosen]


def _place(table_id: str) -> int | None:
    return next((i for i, name in enumerate(TABLES) if fnmatchcase(table_id, name)), None)


def decides(table_id: str) -> str:
    """Say what a table decides; empty where it only informs."""
    place = _place(table_id)
    return "" if place is None else list(TABLES.values())[place]
