"""The application: addresses to pages. All state is in the address but labels."""

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlencode

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, MissingDependencyError, UsageError
from bridge.media.palette import style_sheet
from dashboards import wording
from dashboards.clips import clip, picture
from dashboards.comparison import judge
from dashboards.config import DashboardConfig, ShareConfig
from dashboards.episode_page import build_page
from dashboards.errors import NotHereError
from dashboards.failures_page import PART_WORDS, build_failures
from dashboards.frames import RENDERED, pack_frames, read_frame
from dashboards.guard import Admission, Guard
from dashboards.label_routes import LabelPages
from dashboards.library import Library, derived_path, episode_path, scene_stamps
from dashboards.loading import LOADING
from dashboards.overview_page import build_overview
from dashboards.recording import PageClock, read_recording
from dashboards.share_file import build_share
from dashboards.twin_page import build_twin, view_image
from evaluator.report.page import breakable
from evaluator.report.wording import minus
from evaluator.result import Measurement
from evaluator.review_index import SHOW, FailureSelection, Selection
from evaluator.trial_row import TrialRow

if TYPE_CHECKING:
    from dashboards.live_page import LiveFeed

HERE = Path(__file__).parent
SMALL = [Middleware(GZipMiddleware, minimum_size=2000, compresslevel=5)]
"""Text is compressed; images and episodes are already."""
LIVE_PARTS = ("summary", "topics", "clocks", "verdicts")
"""Of the page Live that change by themselves."""
_SHARING = Lock()


def create_app(
    library: Library,
    admission: Admission | None = None,
    live: DashboardConfig | None = None,
) -> Starlette:
    """Build the application over some run folders.

    Args:
        admission: Which host and token are answered; None answers only on the loopback address.
        live: Where the page Live finds the recorder; None asks at the usual place.
    """
    admission = admission or Admission()
    live = live or DashboardConfig()
    pages = Pages(library, live)
    routes = [
        Route("/", pages.overview, middleware=SMALL),
        Route("/numbers", pages.numbers, middleware=SMALL),
        Route("/episode/{id}", pages.episode, middleware=SMALL),
        Route("/episode/{id}/frame/{camera}", pages.frame),
        Route("/episode/{id}/frames/{camera}", pages.frames),
        Route("/episode/{id}/scene", pages.scene, middleware=SMALL),
        Route("/episode/{id}/file", pages.episode_file),
        Route("/derived/{name}/file", pages.derived_file),
        Route("/failures", pages.failures),
        Route("/failures/picture/{id}", pages.failure_picture),
        Route("/failures/clip/{id}", pages.failure_clip),
        Route("/share", pages.share),
        *pages.labels.routes(),
        Route("/live", pages.live),
        Route("/live/events", pages.live_events),
        Route("/live/preview/{camera}", pages.live_preview),
        Route("/twin", pages.twin, middleware=SMALL),
        Route("/twin/{name}/{side}/{camera}", pages.twin_image),
        Route("/static/colours.css", colours, middleware=SMALL),
        Mount("/static", StaticFiles(directory=HERE / "static"), middleware=SMALL),
    ]
    app = Starlette(
        routes=routes,
        middleware=[Middleware(Guard, admission=admission)],
        exception_handlers={
            GstError: pages.failed,
            HTTPException: pages.http_failed,
        },
    )
    app.state.pages = pages
    return app


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("dashboards"),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for function in (
        wording.outcome_word,
        wording.verdict_word,
        wording.verdict_text,
        wording.factor_word,
        wording.tone,
        wording.measured,
        wording.evidence,
        wording.size_text,
        wording.condition_word,
        wording.image_title,
        wording.success_share,
        wording.answer_tone,
        wording.length_text,
        breakable,
    ):
        environment.filters[function.__name__] = function
    environment.filters |= {"minus": minus, "quoted": lambda path: shlex.quote(str(path))}
    environment.globals |= {"link": link, "share": share_link, "SHOW": SHOW}
    return environment


def link(path: str, **query: object) -> str:
    """Build an address; empty values are left out of the query."""
    kept = {key: value for key, value in query.items() if value not in (None, "")}
    return quote(path) + (f"?{urlencode(kept)}" if kept else "")


def share_link(run: str | None, episodes: Sequence[str]) -> str:
    """Build the address of a file with some trials."""
    named = [*([] if run is None else [("run", run)]), *(("trial", name) for name in episodes)]
    return f"/share?{urlencode(named)}"


def colours(_request: Request) -> Response:
    """``/static/colours.css``: the palette that report and Rerun have too."""
    return Response(style_sheet(), media_type="text/css")


def kept(data: bytes, media_type: str) -> Response:
    """Return what the browser may keep for ten minutes, for its address says which it is."""
    headers = {"Cache-Control": "private, max-age=600"}
    return Response(data, media_type=media_type, headers=headers)


def _seconds(request: Request) -> float | None:
    text = request.query_params.get("t")
    try:
        value = None if text is None else float(text)
    except ValueError:
        return None
    return value if value is not None and abs(value) < 1e9 else None


def _download(path: Path) -> Response:
    return FileResponse(path, media_type="application/octet-stream", filename=path.name)


class Pages:
    """Answers for one library of runs. Plain functions: Starlette runs them in threads."""

    def __init__(self, library: Library, config: DashboardConfig) -> None:
        """Remember the runs and load the templates."""
        self._library = library
        self._environment = _environment()
        self.labels = LabelPages(self._run, self._page)
        self._config = config
        self._feed: LiveFeed | None = None
        self._making = Lock()
        self.is_ending: Callable[[], bool] = lambda: False
        """Whether the server ends: a viewer of the page Live would hold it up."""

    def _part(self, name: str, state: object) -> str:
        return self._environment.get_template(f"live_{name}.html").render(state=state)

    def _page(self, template: str, request: Request, status: int = 200, **values: Any) -> Response:
        name = request.query_params.get("run", "")
        named = name if name in self._library.runs else next(iter(self._library.runs))
        several = len(self._library.runs) > 1
        text = self._environment.get_template(template).render(
            runs=list(self._library.runs),
            run_name=named,
            run_query=named if several else None,
            run_path=self._library.runs[named].path,
            **values,
        )
        return HTMLResponse(text, status_code=status)

    def _run(self, request: Request) -> RunFolder:
        return self._library.pick(request.query_params.get("run"))

    def overview(self, request: Request) -> Response:
        """``/``: agreement of twin and recording, and every trial."""
        run = self._run(request)
        known = judge(run)
        page = build_overview(run, known, Selection.of(request.query_params))
        return self._page("overview.html", request, page=page, known=known)

    def numbers(self, request: Request) -> Response:
        """``/numbers``: every measurement of the evaluation, by what it is about."""
        known = judge(self._run(request))
        asked = request.query_params.get("q", "")[:200]
        words = asked.lower().split()
        parts: dict[str, list[Measurement]] = {}
        for each in known.measurements:
            if all(word in f"{each.id} {each.definition}".lower() for word in words):
                parts.setdefault(each.id.partition(".")[0], []).append(each)
        return self._page("numbers.html", request, parts=parts, known=known, asked=asked)

    def episode(self, request: Request) -> Response:
        """``/episode/<id>``: one trial and its replays."""
        run = self._run(request)
        episode_id = request.path_params["id"]
        known = judge(run)
        page = build_page(run, episode_id, known.row(episode_id), _seconds(request))
        selection = Selection.of(request.query_params)
        index = known.index
        around = None if index is None else index.neighbours(selection, episode_id)
        before, after = around or (None, None)
        return self._page(
            "episode.html",
            request,
            page=page,
            known=known,
            selection=selection,
            before=before,
            after=after,
        )

    def frame(self, request: Request) -> Response:
        """``/episode/<id>/frame/<camera>?t=``: the nearest camera image, as recorded."""
        path = episode_path(self._run(request), request.path_params["id"])
        clock = PageClock.of(read_recording(path))
        stamp_ns = clock.stamp_ns(clock.clamp(_seconds(request) or 0.0))
        data, media_type = read_frame(path, request.path_params["camera"], stamp_ns)
        return kept(data, media_type)

    def frames(self, request: Request) -> Response:
        """``/episode/<id>/frames/<camera>?file=``: all pictures of a camera, or of the twin's."""
        run = self._run(request)
        path = episode_path(run, request.path_params["id"])
        camera_id, name = request.path_params["camera"], request.query_params.get("file")
        if name:
            path, camera_id = derived_path(run, name), RENDERED + camera_id
        return kept(pack_frames(path, camera_id), "application/octet-stream")

    def scene(self, request: Request) -> Response:
        """``/episode/<id>/scene``: Gaussians, poses and ways for the 3D view."""
        with LOADING:
            from dashboards.scene_file import packed  # noqa: PLC0415  # loads the twin

        run = self._run(request)
        path = episode_path(run, request.path_params["id"])
        data = packed(path, run.path, scene_stamps(run, path))
        return Response(data, media_type="application/octet-stream")

    def episode_file(self, request: Request) -> Response:
        """``/episode/<id>/file``: the recorded file itself."""
        return _download(episode_path(self._run(request), request.path_params["id"]))

    def derived_file(self, request: Request) -> Response:
        """``/derived/<file>/file``: a derived episode."""
        return _download(derived_path(self._run(request), request.path_params["name"]))

    def twin(self, request: Request) -> Response:
        """``/twin``: held-out views, recorded beside rendered."""
        run = self._run(request)
        known = judge(run)
        return self._page("twin.html", request, page=build_twin(run, known), known=known)

    def twin_image(self, request: Request) -> Response:
        """``/twin/<file>/<side>/<camera>?stamp=``: one held-out image."""
        run = self._run(request)
        path = derived_path(run, request.path_params["name"])
        stamp = request.query_params.get("stamp", "0")
        if not stamp.isascii() or not stamp.isdigit() or len(stamp) > 19:
            message = "stamp is a whole number of nanoseconds."
            raise NotHereError(message)
        data, media_type = view_image(
            run, path, request.path_params["side"], request.path_params["camera"], int(stamp)
        )
        return kept(data, media_type)

    def failures(self, request: Request) -> Response:
        """``/failures?cause=&stage=&bodies=&start=&by=``: what goes wrong, and its pictures."""
        run = self._run(request)
        known = judge(run)
        found = build_failures(run, known, FailureSelection.of(request.query_params))
        return self._page("failures.html", request, page=found, known=known, part_words=PART_WORDS)

    def failure_picture(self, request: Request) -> Response:
        """``/failures/picture/<id>``: a trial at its moment, recorded beside twin."""
        return kept(picture(self._run(request), self._trial(request)), "image/jpeg")

    def failure_clip(self, request: Request) -> Response:
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

    def _trial(self, request: Request) -> TrialRow:
        row = judge(self._run(request)).row(request.path_params["id"])
        if row is None or not row.file:
            message = "no such recorded trial in this run."
            raise NotHereError(message)
        return row

    def end_live(self) -> None:
        """Stop listening to a recorder."""
        with self._making:
            if self._feed is not None:
                self._feed.end()

    def _heard(self) -> "LiveFeed":
        with LOADING:
            from dashboards.live_page import feed_of  # noqa: PLC0415  # loads zenoh

        with self._making:
            self._feed = self._feed or feed_of(self._config)
            return self._feed

    def live(self, request: Request) -> Response:
        """``/live``: the recording under way."""
        feed, why = None, ""
        try:
            feed = self._heard()
        except GstError as error:
            why = f"Nothing can be heard here: {error}"
        state = None if feed is None else feed.state()
        return self._page(
            "live.html",
            request,
            state=state,
            why=why,
            config=self._config,
            parts={} if state is None else {name: self._part(name, state) for name in LIVE_PARTS},
        )

    async def live_events(self, request: Request) -> Response:
        """``/live/events``: parts of the page that changed, as server-sent events."""
        with LOADING:
            from dashboards.live_page import LiveState, told  # noqa: PLC0415  # loads zenoh

        def render(state: LiveState) -> dict[str, object]:
            parts: dict[str, object] = {name: self._part(name, state) for name in LIVE_PARTS}
            return parts | {"previews": state.previews}

        async def is_gone() -> bool:
            return self.is_ending() or await request.is_disconnected()

        feed = await run_in_threadpool(self._heard)
        return StreamingResponse(told(feed, render, is_gone), media_type="text/event-stream")

    def live_preview(self, request: Request) -> Response:
        """``/live/preview/<camera>``: its last picture."""
        data = self._heard().preview(request.path_params["camera"])
        if data is None:
            message = "no picture of that camera was heard."
            raise NotHereError(message)
        return Response(data, media_type="image/jpeg")

    def failed(self, request: Request, error: Exception) -> Response:
        """Show one of our errors as a page: 404 for what is not there, else 500."""
        missing = isinstance(error, NotHereError)
        title = "Not found" if missing else "This cannot be read"
        return self._page(
            "error.html", request, 404 if missing else 500, title=title, message=str(error)
        )

    def http_failed(self, request: Request, error: Exception) -> Response:
        """Show a wrong address as a page."""
        status = error.status_code if isinstance(error, HTTPException) else 500
        title = "Not found" if status == 404 else f"Request refused ({status})"
        message = "No page of this dashboard has that address."
        return self._page("error.html", request, status, title=title, message=message)
