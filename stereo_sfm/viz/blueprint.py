"""The initial layout of the viewer."""

from __future__ import annotations

from pathlib import Path

import rerun.blueprint as rrb

LEGEND = rrb.Corner2D.LeftTop
BACKGROUND = (17, 19, 24)
GRID = (60, 64, 74)
STAGES = ("track", "map", "loop")  # the stages; other times are steps inside them
LEVELS = ("CRITICAL", "ERROR", "WARN", "INFO")  # rejected loop candidates are DEBUG


def blueprint(name: str) -> rrb.Blueprint:
    """A large view of the map, both images, the matches, and time series.

    Args:
        name: of the source; a path is cut to its last part.
    """
    title = Path(name).name if "/" in name else name
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(_map(title), _log(), row_shares=[5, 1]),
            rrb.Vertical(_images(), _matches(), _plots(), row_shares=[5, 3, 5]),
            column_shares=[10, 9],
        ),
        rrb.TimePanel(state="collapsed", timeline="seconds"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _map(title: str) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="/map",
        contents=["+ $origin/**", "- /map/camera/left/features"],
        name=f"{title}: map blue, odometry orange, ground truth green, loops red",
        background=rrb.Background(color=BACKGROUND),
        line_grid=rrb.LineGrid3D(color=GRID, stroke_width=0.6),
    )


def _images() -> rrb.Horizontal:
    return rrb.Horizontal(
        rrb.Spatial2DView(
            origin="/map/camera/left", name="left: tracks by age, new blue, old red", background=BACKGROUND
        ),
        rrb.Tabs(
            rrb.Spatial2DView(origin="/right", name="right: disparity, far blue, near red", background=BACKGROUND),
            rrb.Spatial2DView(origin="/depth", name="live depth", background=BACKGROUND),
        ),
    )


def _matches() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin="/matches", name="matches: last keyframe and this frame", background=BACKGROUND)


def _plots() -> rrb.Vertical:
    stages = [f"+ /ms/{stage}" for stage in STAGES]
    steps = ["+ /ms/**", *(f"- /ms/{stage}" for stage in (*STAGES, "latency"))]
    return rrb.Vertical(
        rrb.TimeSeriesView(origin="/points", name="points", plot_legend=LEGEND),
        rrb.Tabs(
            rrb.TimeSeriesView(origin="/ms", contents=stages, name="milliseconds per stage", plot_legend=LEGEND),
            rrb.TimeSeriesView(origin="/ms", contents=steps, name="steps of the stages"),
            rrb.TimeSeriesView(origin="/ms", contents=["+ /ms/latency"], name="latency"),
            rrb.TimeSeriesView(origin="/rate", name="frames per second"),
        ),
    )


def _log() -> rrb.TextLogView:
    return rrb.TextLogView(
        origin="/log",
        name="log",
        columns=rrb.TextLogColumns(timeline_columns=["seconds"], text_log_columns=["LogLevel", "Body"]),
        rows=rrb.TextLogRows(filter_by_log_level=list(LEVELS)),
    )
