"""Failures by cause, stage, bodies and start region, with a wall of pictures and short clips."""

from dataclasses import dataclass

from bridge.episode.run_folder import RunFolder
from dashboards.clips import can_film
from dashboards.comparison import Judgement
from dashboards.moments import Moment, moment_of
from dashboards.overview_page import Screen, group_facets, has_picture
from evaluator.review_index import (
    FAILED,
    NOT_KNOWN,
    FailureGroup,
    FailureSelection,
    ReviewIndex,
    Selection,
)
from evaluator.trial_row import TrialRow

GROUPS, SHOWN, ALONE = 12, 4, 24
"""Kinds on one screen; trials of each; trials on one screen where there is one kind alone."""
PART_WORDS = {
    "cause": "cause in the twin",
    "stage": "stage",
    "bodies": "bodies",
    "start": "start region",
}


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One trial on the wall."""

    row: TrialRow
    moment: Moment | None
    has_picture: bool


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of failure with its trials."""

    group: FailureGroup
    words: tuple[tuple[str, str], ...]
    """What is known of it: name of the part, and its words."""
    narrowed: dict[str, str]
    """The query that shows this kind alone."""
    shots: tuple[Shot, ...]


@dataclass(frozen=True, kw_only=True)
class FailuresPage(Screen):
    """Everything the template needs."""

    selection: FailureSelection
    can_film: bool
    kinds: tuple[Kind, ...] = ()
    num_kinds: int = 0
    num_trials: int = 0
    failed: tuple[tuple[str, str, int], ...] = ()
    """Value, words and number of each choice of who failed."""


def build_failures(
    run: RunFolder, judgement: Judgement, selection: FailureSelection
) -> FailuresPage:
    """Gather one screen of failures."""
    index = judgement.index
    if index is None:
        return FailuresPage(selection=selection, can_film=can_film())
    groups = index.failure_groups(selection)
    count = sum(group.count for group in groups)
    is_alone = len(groups) == 1
    pages = max(1, -(-count // ALONE) if is_alone else -(-len(groups) // GROUPS))
    page = min(Selection(page=selection.page).page_number, pages)
    shown = groups if is_alone else groups[(page - 1) * GROUPS : page * GROUPS]
    limit, offset = (ALONE, ALONE * (page - 1)) if is_alone else (SHOWN, 0)
    return FailuresPage(
        selection=selection,
        kinds=tuple(_kind(run, index, selection, group, limit, offset) for group in shown),
        num_kinds=len(groups),
        selected=count,
        of=_count(index, FailureSelection()),
        num_trials=index.count(Selection()),
        facets=group_facets(index),
        failed=tuple(
            (value, words, _count(index, FailureSelection(**selection.query(failed=value))))
            for value, words in FAILED.items()
        ),
        page=page,
        pages=pages,
        can_film=can_film(),
    )


def _count(index: ReviewIndex, selection: FailureSelection) -> int:
    return sum(group.count for group in index.failure_groups(selection))


def _kind(
    run: RunFolder,
    index: ReviewIndex,
    selection: FailureSelection,
    group: FailureGroup,
    limit: int,
    offset: int,
) -> Kind:
    narrowed = selection.query(**{name: text or NOT_KNOWN for name, text in group.parts.items()})
    trials = index.trials(FailureSelection(**narrowed), limit=limit, offset=offset)
    return Kind(
        group=group,
        words=tuple(
            (PART_WORDS[name], text.replace("_", " ")) for name, text in group.parts.items() if text
        ),
        narrowed=narrowed,
        shots=tuple(
            Shot(row=row, moment=moment_of(run, row), has_picture=has_picture(run, row))
            for row in trials
        ),
    )
