"""The arrangement of the viewer's panels, and their common colours."""

from __future__ import annotations

from typing import Final

import rerun.blueprint as rrb

__all__ = ["CRITERIA", "EYE", "FAILURE", "LINES", "MEAN", "NEUTRAL", "SUCCESS", "layout", "shade"]

PATHS_SHOWN: Final = 30  # trials whose paths stay in view
EYE: Final = "eye"  # the camera of the 3D view; outside "world", so no worker can have the name

# 0xRRGGBBAA
SUCCESS: Final = 0x3DDC84FF
FAILURE: Final = 0xFF5A4FFF
MEAN: Final = 0xFFCA28FF  # visible on dark and light backgrounds
NEUTRAL: Final = 0x9AA5B1FF
CRITERIA: Final = (0x4FC3F7FF, 0xFFB74DFF, 0xCE93D8FF, 0xAED581FF)
LINES: Final = (
    0x4FC3F7FF,
    0xFFB74DFF,
    0xCE93D8FF,
    0xAED581FF,
    0xFF8A80FF,
    0x80CBC4FF,
    0xF48FB1FF,
    0xFFF176FF,
)


def shade(colour: int, alpha: float) -> int:
    """The colour with another opacity in [0, 1]."""
    return (colour & 0xFFFFFF00) | round(255 * alpha)


def layout(*, replayed: bool = False) -> rrb.Blueprint:
    """The layout, independent of the run: the 3D view follows a camera in the data.

    Args:
        replayed: Leave out the panels that a log cannot fill.
    """
    return rrb.Blueprint(
        _stored() if replayed else _live(),
        rrb.TimePanel(timeline="trial", play_state="following", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _live() -> rrb.Tabs:
    """Three panels for a first look; tabs hold the rest."""
    return rrb.Tabs(
        rrb.Horizontal(
            _scene(),
            rrb.Vertical(_success(), _document("status", "Status"), row_shares=[1.2, 1]),
            column_shares=[1.3, 1],
            name="Overview",
        ),
        rrb.Vertical(
            rrb.Horizontal(_reasons(), _document("outcomes", "Outcomes"), _cost()),
            rrb.Horizontal(_exploration(), rrb.Tabs(_learner(), _drift(), active_tab=0), _latency()),
            name="Trials and learning",
        ),
        rrb.Horizontal(_document("guide", "What is this?"), _log(), name="Help and log"),
        active_tab=0,
    )


def _stored() -> rrb.Vertical:
    return rrb.Vertical(
        rrb.Horizontal(_success(), rrb.Tabs(_cost(), _predictions(), active_tab=0)),
        rrb.Horizontal(
            rrb.Tabs(_document("status", "Status"), _log(), _document("guide", "What is this?"), active_tab=0),
            rrb.Tabs(_document("outcomes", "Outcomes"), _reasons(), active_tab=0),
            _learner(),
        ),
        row_shares=[1.4, 1],
    )


def _scene() -> rrb.Spatial3DView:
    newest = rrb.TimeRangeBoundary.cursor_relative()
    return rrb.Spatial3DView(
        origin="world",
        contents=["$origin/**", f"+ /{EYE}"],
        name=f"Robots: newest trial in real time, paths of the last {PATHS_SHOWN}",
        background=[16, 20, 28],
        line_grid=False,
        eye_controls=rrb.EyeControls3D(tracking_entity=f"/{EYE}", eye_up=[0, 0, 1]),
        time_ranges=[
            rrb.VisibleTimeRange("trial", start=rrb.TimeRangeBoundary.cursor_relative(seq=-PATHS_SHOWN), end=newest),
            rrb.VisibleTimeRange("epoch", start=newest, end=newest),
        ],
    )


def _series(name: str, *contents: str, share: bool = False, legend: str = "LeftTop") -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(contents),
        name=name,
        plot_legend=getattr(rrb.Corner2D, legend),
        axis_y=rrb.ScalarAxis(range=(-0.02, 1.02), zoom_lock=True) if share else None,
    )


def _success() -> rrb.TimeSeriesView:
    return _series(
        "Success over training trials", "+ /evaluation/**", "+ /training/**", share=True, legend="RightBottom"
    )


def _cost() -> rrb.TimeSeriesView:
    return _series("Cost of each trial: 0 best, 1 worst", "+ /cost/**", share=True, legend="RightTop")


def _reasons() -> rrb.TimeSeriesView:
    return _series("How trials end", "+ /reasons/**", share=True)


def _predictions() -> rrb.TimeSeriesView:
    return _series("Predicted and observed", "+ /predictions/**", share=True, legend="RightBottom")


def _exploration() -> rrb.TimeSeriesView:
    return _series("Exploration", "+ /exploration/**", legend="RightTop")


def _learner() -> rrb.TimeSeriesView:
    return _series("Active set and samples", "+ /learner/**")


def _drift() -> rrb.TimeSeriesView:
    return _series("Drift: above 20 the robot has changed", "+ /drift/**")


def _latency() -> rrb.TimeSeriesView:
    return _series("Latency [ms]", "+ /latency/**")


def _document(entity: str, name: str) -> rrb.TextDocumentView:
    return rrb.TextDocumentView(origin=f"/{entity}", name=name)


def _log() -> rrb.TextLogView:
    return rrb.TextLogView(origin="/log", name="Log")
