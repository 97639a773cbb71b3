"""Addresses of pages about many trials at once. What reads episodes is imported when asked for."""

from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, MissingDependencyError, UsageError
from dashboards.answers import kept
from dashboards.clips import clip, picture
from dashboards.comparison import judge
from dashboards.config import DashboardConfig, ShareConfig
from dashboards.errors import NotHereError
from dashboards.failures_page import PART_WORDS, build_failures
from dashboards.loading import LOADING
from dashboards.share_file import build_share
from evaluator.review_index import FailureSelection
from evaluator.trial_row import TrialRow

if TYPE_CHECKING:
    from dashboards.live_page import LiveFeed

PARTS = ("summary", "topics", "clocks", "verdicts")
"""Of the page Live that change by themselves."""
_SHARING = Lock()
RunOf = Callable[[Request], RunFolder]
Page = Callable[..., Response]


class StudyPages:
    """Answers about many trials at once, and about the recording under way."""

    def __init__(
        self,
        run_of: RunOf,
        page: Page,
        part: Callable[[str, object], str],
        config: DashboardConfig,
    ) -> None:
        """Remember whom to ask.

        Args:
            part: Fills in a part of the page Live, by name, with what is heard.
        """
        self._run, self._page, self._part = run_of, page, part
        self._config = config
        self._feed: LiveFeed | None = None
        self._making = Lock()
        self.is_ending: Callable[[], bool] = lambda: False
        """Whether the server ends: a viewer of the page Live would hold it up."""

    def routes(self) -> list[Route]:
        """Return the addresses."""
        return [
            Route("/failures", self.failures),
            Route("/failures/picture/{id}", self.picture),
            Route("/failures/clip/{id}", self.clip),
            Route("/share", self.share),
            Route("/live", self.live),
            Route("/live/events", self.events),
            Route("/live/preview/{camera}", self.preview),
        ]

    def end(self) -> None:
        """Stop listening to a recorder."""
        with self._making:
            if self._feed is not None:
                self._feed.end()

    def _live(self) -> "LiveFeed":
        with LOADING:
            from dashboards.live_page import feed_of  # noqa: PLC0415  # loads zenoh

        with self._making:
            self._feed = self._feed or feed_of(self._config)
            return self._feed

    def failures(self, request: Request) -> Response:
        """``/failures?cause=&stage=&bodies=&start=&by=``: what goes wrong, and its pictures."""
        run = self._run(request)
        known = judge(run)
        found = build_failures(run, known, FailureSelection.of(request.query_params))
        return self._page("failures.html", request, page=found, known=known, part_words=PART_WORDS)

    def picture(self, request: Request) -> Response:
        """``/failures/picture/<id>``: a trial at its moment, recorded beside twin."""
        return kept(picture(self._run(request), self._trial(request)), "image/jpeg")

    def clip(self, request: Request) -> Response:
        """``/failures/clip/<id>``: a trial around its moment, as MP4."""
        try:
            data = clip(self._run(request), self._trial(request))
        except MissingDependencyError as error:
            raise NotHereError(str(error)) from error
        return kept(data, "video/mp4")

    def share(self, request: Request) -> Response:
        """``/share?trial=ID&trial=ID``: these trials in one file, to be saved and sent."""
        named = tuple(request.query_params.getlist("trial"))
        try:
            with _SHARING:  # it takes seconds: one at a time
                made = build_share(self._run(request), ShareConfig(trials=named))
        except UsageError as error:
            raise NotHereError(str(error)) from error
        headers = {"Content-Disposition": 'attachment; filename="trials.html"'}
        return Response(made.text, media_type="text/html", headers=headers)

    def live(self, request: Request) -> Response:
        """``/live``: the recording under way."""
        feed, why = None, ""
        try:
            feed = self._live()
        except GstError as error:
            why = f"Nothing can be heard here: {error}"
        state = None if feed is None else feed.state()
        return self._page(
            "live.html",
            request,
            state=state,
            why=why,
            config=self._config,
            parts={} if state is None else {name: self._part(name, state) for name in PARTS},
        )

    async def events(self, request: Request) -> Response:
        """``/live/events``: parts of the page that changed, as server-sent events."""
        with LOADING:
            from dashboards.live_page import LiveState, told  # noqa: PLC0415  # loads zenoh

        def render(state: LiveState) -> dict[str, object]:
            parts: dict[str, object] = {name: self._part(name, state) for name in PARTS}
            return parts | {"previews": state.previews}

        async def is_gone() -> bool:
            return self.is_ending() or await request.is_disconnected()

        feed = await run_in_threadpool(self._live)
        return StreamingResponse(told(feed, render, is_gone), media_type="text/event-stream")

    def preview(self, request: Request) -> Response:
        """``/live/preview/<camera>``: its last picture."""
        data = self._live().preview(request.path_params["camera"])
        if data is None:
            message = "no picture of that camera was heard."
            raise NotHereError(message)
        return Response(data, media_type="image/jpeg")

    def _trial(self, request: Request) -> TrialRow:
        row = judge(self._run(request)).row(request.path_params["id"])
        if row is None or not row.file:
            message = "no such recorded trial in this run."
            raise NotHereError(message)
        return row
