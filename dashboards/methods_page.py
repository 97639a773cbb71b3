"""What the page of methods shows: renders of several methods side by side, worst views first.

Values are those of the evaluator's table of views; only where they are drawn is worked out here.
Images come from the folders that ``evaluate --renders`` was given, or from the run's held-out
views.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.run_folder import RunFolder
from bridge.media.color import encode_jpeg
from dashboards.comparison import Judgement
from dashboards.errors import NotHereError
from dashboards.frames import media_type
from dashboards.twin_page import view_image
from dashboards.view_poses import Poses, poses_beside, poses_of_run
from evaluator.compare.images.methods import list_files, read_image
from evaluator.compare.images.renders import other_names
from evaluator.compare.images.views import TWIN
from evaluator.metrics.image_scores import METRICS
from evaluator.result import Table
from evaluator.review_index import RESULTS

VIEWS, HEADLINE = "image_views", "image_methods"
"""The evaluator's tables of every view, and of the means."""
REFERENCE = "-"
"""Stands for the recorded image in an address."""
PAGE = 50
"""Views on one screen."""
CLASSES = 5
"""Colours of the map, from the best view to the worst."""
NUMBERED = 5
"""The worst views have their rank on the map."""
MAP_PX, MARGIN_PX, LABEL_PX, ABOVE_PX = 340, 26, 18, 10
MOST_VIEWS = 5000
"""On the map."""
ARRAY_QUALITY = 95


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One image metric that the results have."""

    column: str
    id: str
    higher_is_better: bool


@dataclass(frozen=True, kw_only=True)
class View:
    """One view with what the evaluator found."""

    name: str
    rank: int
    """1 is the worst by the chosen metric of the chosen method."""
    values: Mapping[str, float | None]
    """Of the chosen metric, by method."""


@dataclass(frozen=True, kw_only=True)
class MapCamera:
    """One camera on the map, seen from above [px]."""

    view: str
    x: float
    y: float
    turn_deg: float
    """Where it looks, clockwise from the right."""
    error: int
    """0 is the best class, ``CLASSES - 1`` the worst; -1 where the metric is undefined."""
    words: str
    rank: int


@dataclass(frozen=True, kw_only=True)
class MapLabel:
    """The ranks of the worst views at one place [px]."""

    x: float
    y: float
    text: str


@dataclass(frozen=True, kw_only=True)
class CameraMap:
    """Cameras coloured by error."""

    cameras: tuple[MapCamera, ...]
    labels: tuple[MapLabel, ...]
    width: int
    height: int
    bounds: tuple[str, ...]
    """Of the classes, the best first: one more than there are."""
    where: str
    without: int
    """Views whose camera is not known."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """One image of the chosen view."""

    method: str
    title: str
    values: tuple[str, ...]
    """Every metric of it; empty for the reference."""
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What an address asks for; empty is the first that makes sense."""

    metric: str = ""
    method: str = ""
    left: str = REFERENCE
    right: str = ""
    view: str = ""
    first: int = 0
    """Of the list."""

    @staticmethod
    def of(query: Mapping[str, str]) -> "Choice":
        """Read an address; what it gets wrong is as if it were not there."""
        names = ("metric", "method", "left", "right", "view")
        text = query.get("first", "0")
        first = int(text) if text.isascii() and text.isdigit() and len(text) < 7 else 0
        return Choice(**{name: query.get(name, "") for name in names}, first=first)

    def query(self, **changed: Any) -> dict[str, str]:
        """The parts of an address that say the same, but for what is changed."""
        new = replace(self, **changed)
        return {
            "metric": new.metric,
            "method": new.method,
            "left": new.left,
            "right": new.right,
            "view": new.view,
            "first": str(new.first) if new.first else "",
        }


@dataclass(frozen=True, kw_only=True)
class MethodsPage:
    """Everything that the template needs."""

    methods: tuple[str, ...]
    metrics: tuple[Metric, ...]
    metric: Metric | None
    choice: Choice
    views: tuple[View, ...]
    """On this screen, worst first."""
    num_views: int
    before: str
    after: str
    """The views around the chosen one in the list; empty at its ends."""
    shown: tuple[Shown, ...]
    """Reference and methods, of the chosen view."""
    means: Table | None
    map: CameraMap | None
    why_no_map: str
    why_empty: str


def build_methods(run: RunFolder, judgement: Judgement, query: Mapping[str, str]) -> MethodsPage:
    """Gather the views of all methods, worst first.

    Args:
        run: The run folder.
        judgement: Its results.
        query: Of the address: metric, method, left, right, view, first.
    """
    table = _table(judgement, VIEWS)
    choice = Choice.of(query)
    if table is None or not table.rows:
        return _empty(choice)
    metrics = _metrics(table)
    means = _table(judgement, HEADLINE)
    named = [] if means is None else [str(row[0]) for row in means.rows]  # as they were given
    there = dict.fromkeys(str(row[1]) for row in table.rows)
    methods = tuple(dict.fromkeys([*(name for name in named if name in there), *there]))
    metric = next((each for each in metrics if each.id == choice.metric), metrics[0])
    method = choice.method if choice.method in methods else methods[0]
    found = _values(table, metric)
    ordered = _worst_first(found, method, metric)
    view = choice.view if choice.view in found else ordered[0].name
    place = next(index for index, each in enumerate(ordered) if each.name == view)
    choice = replace(
        choice,
        metric=metric.id,
        method=method,
        left=choice.left if choice.left in methods else REFERENCE,
        right=choice.right if choice.right in (*methods, REFERENCE) and choice.right else method,
        view=view,
        first=choice.first if choice.first < len(ordered) else 0,
    )
    drawn, why = _map(run, judgement, ordered[:MOST_VIEWS], choice, metric)
    return MethodsPage(
        methods=methods,
        metrics=metrics,
        metric=metric,
        choice=choice,
        views=tuple(ordered[choice.first : choice.first + PAGE]),
        num_views=len(ordered),
        before=ordered[place - 1].name if place else "",
        after=ordered[place + 1].name if place + 1 < len(ordered) else "",
        shown=_shown(run, judgement, table, methods, view),
        means=means,
        map=drawn,
        why_no_map=why,
        why_empty="",
    )


def _empty(choice: Choice) -> MethodsPage:
    return MethodsPage(
        methods=(),
        metrics=(),
        metric=None,
        choice=choice,
        views=(),
        num_views=0,
        before="",
        after="",
        shown=(),
        means=None,
        map=None,
        why_no_map="",
        why_empty="No renders of other methods were compared in this run.",
    )


def _table(judgement: Judgement, name: str) -> Table | None:
    tables = judgement.results.tables if judgement.results else ()
    return next((table for table in tables if table.id == name), None)


def _metrics(table: Table) -> tuple[Metric, ...]:
    by_column = {metric.column: metric for metric in METRICS.values()}
    return tuple(
        Metric(
            column=name, id=by_column[name].id, higher_is_better=by_column[name].higher_is_better
        )
        for name in table.columns
        if name in by_column
    )


def _values(table: Table, metric: Metric) -> dict[str, dict[str, float | None]]:
    """By view and method; None where the metric is undefined."""
    column = table.columns.index(metric.column)
    found: dict[str, dict[str, float | None]] = {}
    for row in table.rows:
        value = row[column]
        number = float(value) if isinstance(value, int | float) else None
        found.setdefault(str(row[0]), {})[str(row[1])] = number
    return found


def _worst_first(
    found: Mapping[str, Mapping[str, float | None]], method: str, metric: Metric
) -> list[View]:
    def badness(item: tuple[str, Mapping[str, float | None]]) -> tuple[bool, float, str]:
        value = item[1].get(method)
        if value is None:
            return True, 0.0, item[0]
        return False, value if metric.higher_is_better else -value, item[0]

    ordered = sorted(found.items(), key=badness)
    return [
        View(name=name, rank=rank, values=values) for rank, (name, values) in enumerate(ordered, 1)
    ]


def _shown(
    run: RunFolder, judgement: Judgement, table: Table, methods: Sequence[str], view: str
) -> tuple[Shown, ...]:
    rows = {str(row[1]): row for row in table.rows if str(row[0]) == view}
    scored_ns = (run.path / RESULTS).stat().st_mtime_ns
    sources = _sources(judgement)
    images = [Shown(method=REFERENCE, title="reference", values=())]
    for method in methods:
        cells = zip(table.columns[2:], rows.get(method, ())[2:], strict=False)
        values = tuple(f"{name} {_text(value)}" for name, value in cells)
        images.append(Shown(method=method, title=method, values=values))
    return tuple(
        replace(each, note=_newer(sources, each.method, view, scored_ns)) for each in images
    )


def _text(value: object) -> str:
    return (
        f"{value:.4g}" if isinstance(value, float) else "missing" if value is None else str(value)
    )


def _newer(sources: "Sources", method: str, view: str, scored_ns: int) -> str:
    folder = sources.folder(method)
    if folder is None:
        return ""
    path = _file(_files_of(folder), view)
    if path is None or not path.is_file():
        return "the image is gone"
    return "changed since it was scored" if path.stat().st_mtime_ns > scored_ns else ""


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where the images of an evaluation are."""

    reference: Path | None
    """None: the recorded side of the run's held-out views."""
    methods: Mapping[str, Path]

    def folder(self, method: str) -> Path | None:
        """The folder of a method, or of the reference; None: the run itself holds them."""
        return self.reference if method == REFERENCE else self.methods.get(method)


def _sources(judgement: Judgement) -> Sources:
    origin = judgement.results.provenance if judgement.results else {}
    reference, methods = origin.get("reference"), origin.get("methods")
    named = methods if isinstance(methods, dict) else {}
    return Sources(
        reference=Path(reference) if isinstance(reference, str) else None,
        methods={str(name): Path(str(folder)) for name, folder in named.items()},
    )


def _files_of(folder: Path) -> dict[str, Path]:
    """Image files by the name of their view; folders are listed anew when they change."""
    try:
        return _listed(folder, folder.stat().st_mtime_ns)
    except OSError:
        return {}


@lru_cache(maxsize=16)
def _listed(folder: Path, _mtime_ns: int) -> dict[str, Path]:
    return {view: paths[0] for view, paths in list_files(folder).items()}


def method_image(
    run: RunFolder, judgement: Judgement, method: str, view: str, *, looks_outside: bool
) -> tuple[bytes, str]:
    """Return one image that was scored, as it is stored; arrays as JPEG.

    Args:
        run: The run folder.
        judgement: Its results, which name the folders.
        method: Whose; ``-`` for the reference.
        view: As the results name it.
        looks_outside: Whether folders outside of the run may be shown.

    Raises:
        NotHereError: When the results do not have it, or it may not be shown.
    """
    table = _table(judgement, VIEWS)
    rows = () if table is None else table.rows
    if not any(str(row[0]) == view and method in (REFERENCE, str(row[1])) for row in rows):
        raise NotHereError("the results have no such view of such a method.")
    folder = _sources(judgement).folder(method)
    if folder is None:
        return _image_of_run(run, method, view)
    if not looks_outside and not folder.resolve().is_relative_to(run.path.resolve()):
        message = (
            "images outside of the run are shown on the loopback address alone. Copy the folders "
            "into the run and evaluate again."
        )
        raise NotHereError(message)
    path = _file(_files_of(folder), view)
    if path is None:
        raise NotHereError(f"the image of {view} is not in {folder} any more.")
    if not path.resolve().is_relative_to(folder.resolve()):
        raise NotHereError(f"the image of {view} points outside of its folder; it is not served.")
    if path.suffix.lower() == ".npy":
        values = read_image(path)
        image_u8 = values if values.dtype == np.uint8 else np.rint(values * 255).astype(np.uint8)
        return encode_jpeg(image_u8, quality=ARRAY_QUALITY), "image/jpeg"
    data = path.read_bytes()
    return data, media_type(data, path)


def _file(files: Mapping[str, Path], view: str) -> Path | None:
    """By its name, or by what else a view of a run may be called."""
    if view in files:
        return files[view]
    if not view.rpartition("/")[2].isdecimal():
        return None
    return next((files[name] for name in other_names([view]) if name in files), None)


def _image_of_run(run: RunFolder, method: str, view: str) -> tuple[bytes, str]:
    camera, _, stamp = view.rpartition("/")
    if method not in (REFERENCE, TWIN) or not stamp.isdecimal():
        raise NotHereError("the results do not say where that image is: evaluate again.")
    side = "rendered" if method == TWIN else "recorded"
    for path in sorted(run.derived("*.views.*"), key=lambda p: p.stat().st_mtime_ns, reverse=True):
        try:
            return view_image(run, path, side, camera, int(stamp))
        except NotHereError:
            continue
    raise NotHereError(f"the held-out views of the run have no {view}.")


def _map(
    run: RunFolder, judgement: Judgement, views: Sequence[View], choice: Choice, metric: Metric
) -> tuple[CameraMap | None, str]:
    names = tuple(view.name for view in views)
    sources = _sources(judgement)
    if sources.reference is None:
        poses, where = poses_of_run(run, names)
    else:
        folders = (sources.reference, *sources.methods.values())
        poses, where = _poses_beside(folders, names, (run.path / RESULTS).stat().st_mtime_ns)
    if not poses:
        return None, where
    return draw_map(poses, views, choice.method, metric, where), ""


@lru_cache(maxsize=4)
def _poses_beside(
    folders: tuple[Path, ...], names: tuple[str, ...], _scored_ns: int
) -> tuple[Poses, str]:
    return poses_beside(folders, names)


def draw_map(
    poses: Poses, views: Sequence[View], method: str, metric: Metric, where: str
) -> CameraMap:
    """Look down on the cameras, along the mean of what is up in their images.

    Args:
        poses: ``T_world_camera`` by view.
        views: Worst first.
        method: Whose values colour the cameras.
        metric: Which value.
        where: The poses are from.
    """
    known = [view for view in views if view.name in poses]
    Ts = np.stack([poses[view.name] for view in known])
    across, ahead = _ground(Ts)
    p = Ts[:, :3, 3] @ np.stack([across, ahead], axis=1)
    looks = Ts[:, :3, 2] @ np.stack([across, ahead], axis=1)
    low, span = p.min(axis=0), np.ptp(p, axis=0)
    scale = (MAP_PX - 2 * MARGIN_PX) / max(float(span.max()), 1e-9)
    height = round(float(span[1]) * scale) + 2 * MARGIN_PX
    values = [view.values.get(method) for view in known]
    classes, bounds = _classes(values, metric)
    cameras = [
        MapCamera(
            view=view.name,
            x=round(MARGIN_PX + (at[0] - low[0]) * scale, 1),
            y=round(height - MARGIN_PX - (at[1] - low[1]) * scale, 1),
            turn_deg=round(-math.degrees(math.atan2(look[1], look[0])), 1),
            error=error,
            words=f"{view.name}: {metric.column} {_text(value)}, rank {view.rank}",
            rank=view.rank,
        )
        for view, at, look, value, error in zip(known, p, looks, values, classes, strict=True)
    ]
    return CameraMap(
        cameras=tuple(reversed(cameras)),  # the worst is drawn last, over the others
        labels=tuple(_labels([each for each in cameras if each.rank <= NUMBERED])),
        width=MAP_PX,
        height=height,
        bounds=bounds,
        where=where,
        without=len(views) - len(known),
    )


def _labels(worst: Sequence[MapCamera]) -> Iterator[MapLabel]:
    """Ranks over the cameras, joined where these are too near to each other to tell."""
    groups: list[list[MapCamera]] = []
    for each in worst:
        near = (g for g in groups if math.hypot(g[0].x - each.x, g[0].y - each.y) < LABEL_PX)
        found = next(near, None)
        if found is None:
            groups.append([each])
        else:
            found.append(each)
    for group in groups:
        highest = min(each.y for each in group)
        text = ", ".join(str(each.rank) for each in group)
        yield MapLabel(x=group[0].x, y=highest - ABOVE_PX, text=text)


def _ground(
    Ts: Float[np.ndarray, "num_views 4 4"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Two axes across what is up: the first along the longest side of where the cameras are."""
    up = -Ts[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    up = up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    flat = Ts[:, :3, 3] - Ts[:, :3, 3].mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    across = np.linalg.svd(flat, full_matrices=False)[2][0]
    across = across - up * (across @ up)
    if np.linalg.norm(across) < 1e-6:  # a single camera
        across = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    across = across / np.linalg.norm(across)
    return across, np.cross(up, across)


def _classes(values: Sequence[float | None], metric: Metric) -> tuple[list[int], tuple[str, ...]]:
    """Which of the even classes between the best and the worst value each lies in."""
    there = [value for value in values if value is not None]
    if not there:
        return [-1] * len(values), ()
    best, worst = (max, min) if metric.higher_is_better else (min, max)
    start, end = best(there), worst(there)
    span = (end - start) or 1.0
    found = [
        -1 if value is None else min(int(CLASSES * (value - start) / span), CLASSES - 1)
        for value in values
    ]
    bounds = tuple(f"{start + span * step / CLASSES:.4g}" for step in range(CLASSES + 1))
    return found, bounds
