"""How the view opens: the place in 3D, the cameras, the series, and what was said."""

from collections.abc import Sequence
from dataclasses import dataclass

import rerun.blueprint as rrb

from dashboards.rerun_file import TIMELINE
from dashboards.rerun_side import MIN_CLEARANCE

EYE_M, TARGET_M = (1.5, -1.1, 0.9), (0.35, 0.0, 0.15)
"""Looking at the table in front of the robot from its left."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What a file holds, as far as the layout depends on it."""

    name: str
    sides: tuple[str, ...]
    camera_entities: tuple[str, ...]
    robot: bool
    splats: bool
    clearance: bool
    stages: bool


def layout(shown: Shown) -> rrb.Blueprint:
    """Place 3D view and cameras on the left, series and text on the right."""
    left: list[rrb.View | rrb.Container] = [_space(shown)]
    if shown.camera_entities:
        left.append(rrb.Grid(*(_image(entity) for entity in shown.camera_entities)))
    right: list[rrb.View | rrb.Container] = [
        _series("joints [rad]", [f"{side}/joints/**" for side in shown.sides], legend=False),
        _series("gripper width [m]", [f"{side}/gripper_width_m" for side in shown.sides]),
    ]
    if shown.clearance:
        right.append(_series("clearance [m]", [f"{side}/{MIN_CLEARANCE}" for side in shown.sides]))
    if shown.stages:
        contents = [f"+ /{side}/stage" for side in shown.sides]
        right.append(rrb.StateTimelineView(origin="/", contents=contents, name="stages"))
    said = [f"+ /{side}/{leaf}" for side in shown.sides for leaf in ("events", "verdicts")]
    right.append(
        rrb.Tabs(
            rrb.TextLogView(origin="/", contents=said, name="events and verdicts"),
            rrb.TextDocumentView(origin="/about", name="about"),
        )
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[3, 2][: len(left)]),
            rrb.Vertical(*right, row_shares=[*([2] * (len(right) - 1)), 3]),
            column_shares=[3, 2],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        auto_views=False,
    )


def _space(shown: Shown) -> rrb.Spatial3DView:
    """Show all poses; depth as points only where there are no splats, which show the same."""
    contents = ["+ /**"]
    if shown.splats:
        contents += [f"- /{entity}/**" for entity in shown.camera_entities if _is_depth(entity)]
    eye = rrb.EyeControls3D(position=EYE_M, look_target=TARGET_M, eye_up=(0.0, 0.0, 1.0))
    return rrb.Spatial3DView(
        origin="/", contents=contents, name=shown.name, eye_controls=eye if shown.robot else None
    )


def _is_depth(entity: str) -> bool:
    return entity.endswith("/depth")


def _image(entity: str) -> rrb.Spatial2DView:
    camera_id, kind = entity.split("/")[-2:]
    return rrb.Spatial2DView(origin=f"/{entity}", name=f"{camera_id} {kind}")


def _series(name: str, entities: Sequence[str], *, legend: bool = True) -> rrb.TimeSeriesView:
    contents = [f"+ /{entity}" for entity in entities]
    return rrb.TimeSeriesView(
        origin="/", contents=contents, name=name, plot_legend=rrb.PlotLegend(visible=legend)
    )
