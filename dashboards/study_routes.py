"""Addresses of pages about many trials at once. What reads episodes is imported when asked for."""

from collections.abc import Callable, Mapping
from threading import Lock

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from bridge.episode.run_folder import RunFolder
from bridge.errors import MissingDependencyError, UsageError
from dashboards.comparison import judge
from dashboards.config import ShareConfig
from dashboards.errors import NotHereError
from dashboards.review_routes import Page, RunOf
from evaluator.review_index import FailureSelection, IndexedTrial

_SHARING = Lock()
OthersOf = Callable[[RunFolder], Mapping[str, RunFolder]]
"""Gives the runs that one may be compared with, by name."""


def study_routes(run_of: RunOf, page: Page, others_of: OthersOf) -> list[Route]:
    """Return the addresses of failures and comparisons.

    Args:
        run_of: The run that a request is about.
        page: Fills in a template.
        others_of: The runs that one may be compared with.
    """
    pages = _StudyPages(run_of, page, others_of)
    return [
        Route("/failures", pages.failures),
        Route("/failures/picture/{id}", pages.picture),
        Route("/failures/clip/{id}", pages.clip),
        Route("/compare", pages.compare),
        Route("/share", pages.share),
    ]


class _StudyPages:
    def __init__(self, run_of: RunOf, page: Page, others_of: OthersOf) -> None:
        self._run = run_of
        self._page = page
        self._others = others_of

    def failures(self, request: Request) -> Response:
        """``/failures?cause=&stage=&bodies=&start=&by=``: what goes wrong, and its pictures."""
        from dashboards.failures_page import PART_WORDS, build_failures  # noqa: PLC0415

        run = self._run(request)
        found = build_failures(run, judge(run), FailureSelection.of(request.query_params))
        return self._page("failures.html", request, page=found, part_words=PART_WORDS)

    def picture(self, request: Request) -> Response:
        """``/failures/picture/<id>``: a trial at its moment, recorded beside twin."""
        from dashboards.clips import picture  # noqa: PLC0415  # reads episodes

        return _kept(picture(self._run(request), self._trial(request)), "image/jpeg")

    def clip(self, request: Request) -> Response:
        """``/failures/clip/<id>``: a trial around its moment, as MP4."""
        from dashboards.clips import clip  # noqa: PLC0415  # reads episodes

        try:
            data = clip(self._run(request), self._trial(request))
        except MissingDependencyError as error:
            raise NotHereError(str(error)) from error
        return _kept(data, "video/mp4")

    def compare(self, request: Request) -> Response:
        """``/compare?with=RUN`` or ``?by=condition&a=&b=``: only what differs."""
        from dashboards.compare_page import build_compare  # noqa: PLC0415  # loads the evaluator

        run = self._run(request)
        others = self._others(run)
        name = request.query_params.get("with", "")
        if name and name not in others:
            message = f"no run {name!r} to compare with. There are: {', '.join(others) or 'none'}."
            raise NotHereError(message)
        judged = {each: judge(other) if each == name else None for each, other in others.items()}
        found = build_compare(run, judge(run), judged, request.query_params)
        return self._page("compare.html", request, page=found)

    def share(self, request: Request) -> Response:
        """``/share?trial=ID&trial=ID``: these trials in one file, to be saved and sent."""
        from dashboards.share_file import build_share  # noqa: PLC0415  # loads the evaluator

        named = tuple(request.query_params.getlist("trial"))
        try:
            with _SHARING:  # it takes seconds: one at a time
                made = build_share(self._run(request), ShareConfig(trials=named))
        except UsageError as error:
            raise NotHereError(str(error)) from error
        headers = {"Content-Disposition": 'attachment; filename="trials.html"'}
        return Response(made.text, media_type="text/html", headers=headers)

    def _trial(self, request: Request) -> IndexedTrial:
        row = judge(self._run(request)).row(request.path_params["id"])
        if row is None or not row.file:
            message = "no such recorded trial in this run."
            raise NotHereError(message)
        return row


def _kept(data: bytes, media_type: str) -> Response:
    headers = {"Cache-Control": "private, max-age=600"}
    return Response(data, media_type=media_type, headers=headers)
