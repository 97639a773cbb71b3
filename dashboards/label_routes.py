"""Addresses of blind labelling; the only ones that write."""

import json
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
from dashboards.comparison import judge
from dashboards.errors import NotHereError

MAX_BODY = 64_000
"""Bytes of one label with its note, with a wide margin."""


class LabelPages:
    """Answers about labels."""

    def __init__(
        self, run_of: Callable[[Request], RunFolder], page: Callable[..., Response]
    ) -> None:
        """Remember whom to ask for the run, and for a page of a template and its values."""
        self._run = run_of
        self._page = page

    def routes(self) -> list[Route]:
        """Return the addresses."""
        return [Route("/label", self.label), Route("/label", self.save, methods=["POST"])]

    def label(self, request: Request) -> Response:
        """``/label?rater=&at=``: one trial, blind; without ``at`` the next to label."""
        run = self._run(request)
        query = request.query_params
        try:
            rater = labels.rater_name(query.get("rater", ""))
        except UsageError as error:
            return self._start(request, why=str(error) if "rater" in query else "")
        order = labels.trials_to_label(judge(run), rater)
        found, _ = readable_reviews(run.path)
        at = query.get("at") or None
        if at is None:
            at = labels.next_trial(order, found, rater)
            if at is None:
                return self._start(request, rater=rater, is_done=bool(order))
            address = request.url.include_query_params(at=at)
            return RedirectResponse(f"/label?{address.query}", status_code=303)
        page = labels.build_label_page(run, order, found, rater=rater, trial_id=at)
        return self._page("label.html", request, page=page, causes=labels.CAUSES)

    def _start(
        self, request: Request, *, why: str = "", rater: str = "", is_done: bool = False
    ) -> Response:
        """Ask for a name, and say how far the raters are; notes wait until nobody labels."""
        run = self._run(request)
        found, problems = readable_reviews(run.path)
        known = judge(run)
        progress = labels.progress_of(known, found)
        working = [each.rater for each in progress if each.left]
        is_over = not working or request.query_params.get("show") == "1"
        return self._page(
            "label_start.html",
            request,
            why=why,
            rater=rater,
            is_done=is_done,
            total=len(labels.trials_to_label(known, rater)),
            problems=problems,
            known=known,
            progress=progress,
            working=[] if is_over else working,
            notes=[each for each in found if each.note or each.flag] if is_over else [],
        )

    async def save(self, request: Request) -> Response:
        """``POST /label?rater=``: keep one label, and say which trial is next."""
        record = await _posted(request)
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
            return _refused(404, str(error))
        except (GstError, OSError) as error:
            return _refused(400 if isinstance(error, UsageError) else 500, str(error))
        order = labels.trials_to_label(judge(run), rater)
        found, _ = readable_reviews(run.path)
        after = labels.next_trial(order, found, rater, record["trial_id"])
        return JSONResponse({**_told(saved), "next": after})


def _told(saved: SavedReview) -> dict[str, Any]:
    parts = ("result", "cause", "note", "flag", "time")
    label = None if saved.review is None else {name: getattr(saved.review, name) for name in parts}
    return {"version": saved.version, "saved": label}


def _refused(status: int, message: str) -> Response:
    """Return a refusal that a script of the page shows."""
    return JSONResponse({"message": message}, status_code=status)


async def _posted(request: Request) -> dict[str, Any] | Response:
    """Read a JSON object that a page posts, or return the refusal."""
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > MAX_BODY:
            return _refused(413, f"a label has at most {MAX_BODY // 1000} kB.")
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        return _refused(415, "a label is sent as application/json.")
    try:
        record = json.loads(body)
    except (ValueError, RecursionError):
        record = None
    return record if isinstance(record, dict) else _refused(400, "a label is a JSON object.")
