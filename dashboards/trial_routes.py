"""Addresses behind a trial's page: its 3D scene, pictures of a camera, and what-if."""

import hashlib
import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from dashboards.answers import kept, posted, refused
from dashboards.episode_page import read_replays, sent_plan_of
from dashboards.errors import NotHereError
from dashboards.frames import RENDERED, pack_frames
from dashboards.library import derived_path, derived_paths, episode_path
from dashboards.loading import LOADING
from dashboards.queue_page import drawn_once
from dashboards.recording import Problems, read_recording
from dashboards.trial_plots import shown_replays
from dashboards.what_if import QUANTITIES, BusyError, Question, WhatIfJobs, read_change

if TYPE_CHECKING:  # loads the twin
    from dashboards.trial_scene import TrialScene

RunOf = Callable[[Request], RunFolder]
MAX_BODY = 4_000
"""Bytes of one question, with a wide margin."""
PICTURES = "scene_pictures"
"""Folder in the run's ``results/``."""
SHOWN = ("replay", "localised")
"""Derived episodes that the 3D view shows."""
_GATHERING = threading.Lock()
"""Robot models keep scratch memory: one answer at a time uses them."""


class TrialPages:
    """Answers behind a trial's page; one object, because it has the one job of what-if."""

    def __init__(self, run_of: RunOf) -> None:
        """``run_of``: the run that a request is about."""
        self._run = run_of
        self._jobs = WhatIfJobs()

    def scene(self, request: Request) -> Response:
        """``/episode/<id>/scene``: Gaussians, poses and ways for the 3D view."""
        run = self._run(request)
        path = episode_path(run, request.path_params["id"])
        with _GATHERING:
            data = _packed(path, run.path, _stamps(run, path, *SHOWN))
        return Response(data, media_type="application/octet-stream")

    def frames(self, request: Request) -> Response:
        """``/episode/<id>/frames/<camera>?file=``: all pictures of a camera, or of the twin's."""
        run = self._run(request)
        path = episode_path(run, request.path_params["id"])
        camera_id, name = request.path_params["camera"], request.query_params.get("file")
        if name:
            path, camera_id = derived_path(run, name), RENDERED + camera_id
        return kept(pack_frames(path, camera_id), "application/octet-stream")

    def what_if(self, request: Request) -> Response:
        """``/episode/<id>/what_if``: what was answered, and whether a job runs."""
        run = self._run(request)
        path = episode_path(run, request.path_params["id"])
        return JSONResponse(self._jobs.state(run.path, path.stem, _basis(run, path)))

    async def ask(self, request: Request) -> Response:
        """``POST /episode/<id>/what_if``: replay the plan otherwise."""
        record = await posted(request, "a question", MAX_BODY)
        if isinstance(record, Response):
            return record
        if not set(record) <= {"change", "sweep", "plan"}:
            return refused(400, "a question has change, sweep and plan.")
        return await run_in_threadpool(self._ask, request, record)

    def _ask(self, request: Request, record: dict[str, Any]) -> Response:
        try:
            run = self._run(request)
            path = episode_path(run, request.path_params["id"])
            sweep, plan_id = record.get("sweep", ""), record.get("plan")
            if sweep not in ("", *QUANTITIES):
                message = f"no quantity {sweep!r}. There are: {', '.join(QUANTITIES)}."
                raise UsageError(message)
            if plan_id not in [plan.id for _, plan in read_recording(path).plans]:
                raise UsageError("the trial has no such plan.")
            question = Question(
                run_path=run.path,
                episode_id=path.stem,
                plan_id=plan_id,
                basis=_basis(run, path),
                change=read_change(record.get("change", {})),
                sweep=sweep,
            )
            return JSONResponse(self._jobs.start(question), status_code=202)
        except BusyError as error:
            return refused(409, str(error))
        except NotHereError as error:
            return refused(404, str(error))
        except GstError as error:
            return refused(400, str(error))

    def cancel(self, request: Request) -> Response:
        """``POST /episode/<id>/what_if/cancel``: end the job, whichever it is."""
        episode_path(self._run(request), request.path_params["id"])
        self._jobs.cancel()
        return JSONResponse({})

    def picture(self, request: Request) -> Response:
        """``/episode/<id>/scene.jpg?t=``: the recorded state, before or without the 3D view."""
        run = self._run(request)
        path = episode_path(run, request.path_params["id"])
        try:
            t_s = round(float(request.query_params.get("t", "0")), 2)
        except ValueError:
            t_s = 0.0
        stamps = _stamps(run, path, *SHOWN)
        what = (path.stem, stamps, t_s)

        def draw() -> bytes:
            with _GATHERING:
                return _drawn(path, run.path, stamps, t_s)

        return kept(drawn_once(run.results_dir / PICTURES, path.stem, what, draw), "image/jpeg")


Stamps = tuple[tuple[str, int, int], ...]


def _basis(run: RunFolder, path: Path) -> str:
    """Name what a replay of a trial is made of: recording, scene and calibration."""
    return hashlib.sha256(repr(_stamps(run, path)).encode()).hexdigest()[:16]


def _stamps(run: RunFolder, path: Path, *kinds: str) -> Stamps:
    """Names, times of writing and sizes of what a trial's scene is made of.

    Args:
        run: The run folder.
        path: The recorded episode.
        kinds: Of derived episodes that count too.
    """
    files = [path, run.scene_dir / "scene.json", run.scene_dir / "calibration.json"]
    for kind in kinds:
        files += derived_paths(run, path.stem, kind)
    found = [(file.name, file.stat()) for file in files if file.is_file()]
    return tuple((name, status.st_mtime_ns, status.st_size) for name, status in found)


@lru_cache(maxsize=2)
def _packed(path: Path, run_path: Path, stamps: Stamps) -> bytes:
    with LOADING:
        from dashboards.scene_file import pack_scene  # noqa: PLC0415  # loads the twin

    return pack_scene(_gathered(path, run_path, stamps))


def _drawn(path: Path, run_path: Path, stamps: Stamps, t_s: float) -> bytes:
    with LOADING:
        from dashboards.scene_file import draw_picture  # noqa: PLC0415  # loads the twin

    return draw_picture(_gathered(path, run_path, stamps), t_s)


@lru_cache(maxsize=1)
def _gathered(path: Path, run_path: Path, _stamps: Stamps) -> "TrialScene":
    """Gather once for the picture and for the 3D view, which are asked for together."""
    with LOADING:
        from dashboards.trial_scene import gather_scene  # noqa: PLC0415  # loads the twin

    run = RunFolder(run_path)
    recording = read_recording(path)
    problems = Problems()
    replays = read_replays(derived_paths(run, path.stem, "replay"), recording, problems)
    sent_plan = sent_plan_of(recording)
    return gather_scene(run, recording, shown_replays(replays, sent_plan), sent_plan)
