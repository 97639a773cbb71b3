"""Addresses of the queue, of blind labelling and of its summary; the only ones that write."""

from collections.abc import Callable
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.exchange.reviews import ReviewConflictError, SavedReview, readable_reviews
from dashboards import label_page as labels
from dashboards.answers import kept, posted, refused
from dashboards.comparison import judge
from dashboards.errors import NotHereError
from dashboards.queue_page import SHOW, build_queue, thumbnail

MAX_BODY = 64_000
"""Bytes of one label with its note, with a wide margin."""
RunOf = Callable[[Request], RunFolder]
Page = Callable[..., Response]
"""Called with a template, the request and the template's values."""


def review_routes(run_of: RunOf, page: Page) -> list[Route]:
    """Return the addresses of queue and labels."""
    pages = _ReviewPages(run_of, page)
    return [
        Route("/queue", pages.queue),
        Route("/queue/thumbnail/{id}", pages.thumbnail),
        Route("/label", pages.label),
        Route("/label", pages.save, methods=["POST"]),
        Route("/reviews", pages.summary),
    ]


class _ReviewPages:
    def __init__(self, run_of: RunOf, page: Page) -> None:
        self._run = run_of
        self._page = page

    def queue(self, request: Request) -> Response:
        """``/queue?show=&page=``: trials, worst first."""
        run = self._run(request)
        query = request.query_params
        number = query.get("page", "1")
        page = build_queue(
            run,
            known := judge(run),
            readable_reviews(run.path),
            show=query.get("show", ""),
            page=int(number) if number.isascii() and number.isdigit() and len(number) < 9 else 1,
        )
        shown = {"page": page, "known": known, "shows": SHOW, "sets": labels.SETS}
        return self._page("queue.html", request, **shown)

    def thumbnail(self, request: Request) -> Response:
        """``/queue/thumbnail/<id>``: the moment of its divergence."""
        run = self._run(request)
        row = judge(run).row(request.path_params["id"])
        if row is None:
            message = "no such trial in this run."
            raise NotHereError(message)
        return kept(thumbnail(run, row), "image/jpeg")

    def label(self, request: Request) -> Response:
        """``/label?rater=&set=&at=``: one trial, blind; without ``at`` the next to label."""
        run = self._run(request)
        query = request.query_params
        chosen = query.get("set", "") if query.get("set", "") in labels.SETS else ""
        shared = {"chosen": chosen, "sets": labels.SETS}
        try:
            rater = labels.rater_name(query.get("rater", ""))
        except UsageError as error:
            why = str(error) if "rater" in query else ""
            return self._page("label_start.html", request, why=why, rater="", done=None, **shared)
        order = labels.trials_to_label(judge(run), chosen, rater)
        found, _ = readable_reviews(run.path)
        at = query.get("at") or None
        if at is None:
            at = labels.next_unrated(order, labels.rated_by(found, rater), None)
            if at is None:
                return self._page(
                    "label_start.html", request, why="", rater=rater, done=len(order), **shared
                )
            address = request.url.include_query_params(at=at)
            return RedirectResponse(f"/label?{address.query}", status_code=303)
        page = labels.build_label_page(run, order, found, rater=rater, trial_id=at)
        return self._page("label.html", request, page=page, causes=labels.CAUSES, **shared)

    async def save(self, request: Request) -> Response:
        """``POST /label?rater=&set=``: keep one label, and say which trial is next."""
        record = await posted(request, "a label", MAX_BODY)
        if isinstance(record, Response):
            return record
        return await run_in_threadpool(self._keep, request, record)

    def _keep(self, request: Request, record: dict[str, Any]) -> Response:
        try:
            run = self._run(request)
            rater = labels.rater_name(request.query_params.get("rater", ""))
            saved = labels.save_label(run, record, rater=rater)
        except ReviewConflictError as error:
            return JSONResponse({"message": str(error), **_told(error.saved)}, status_code=409)
        except NotHereError as error:
            return refused(404, str(error))
        except (GstError, OSError) as error:
            return refused(400 if isinstance(error, UsageError) else 500, str(error))
        order = labels.trials_to_label(judge(run), request.query_params.get("set", ""), rater)
        found, _ = readable_reviews(run.path)
        after = labels.next_unrated(order, labels.rated_by(found, rater), record["trial_id"])
        return JSONResponse({**_told(saved), "next": after})

    def summary(self, request: Request) -> Response:
        """``/reviews``: how far raters are; how far they agree, once nobody labels any more."""
        run = self._run(request)
        query = request.query_params
        chosen = query.get("set", "") if query.get("set", "") in labels.SETS else ""
        page = labels.summarise(
            judge(run), readable_reviews(run.path), chosen=chosen, show=query.get("show") == "1"
        )
        return self._page("reviews.html", request, page=page, chosen=chosen, sets=labels.SETS)


def _told(saved: SavedReview) -> dict[str, Any]:
    parts = ("result", "cause", "note", "flag", "time")
    label = None if saved.review is None else {name: getattr(saved.review, name) for name in parts}
    return {"version": saved.version, "saved": label}
