"""Arrangement of the views."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drocap_ros.view.rerun_scene import IMAGE, WORLD, subject_path

if TYPE_CHECKING:
    import rerun.blueprint as rrb

_BACKGROUND = (238, 240, 243)


def layout(views: tuple[str, ...], *, follow: bool = False) -> rrb.Blueprint:
    """The body in its world beside the image with its keypoints, above curves and the log.

    Parameters
    ----------
    views : groups of curves, one view each; "log" for the messages of the nodes
    follow : show the newest image instead of the first, and hide refined poses
    """
    import rerun.blueprint as rrb

    contents = [f"+ /{WORLD}/**"]
    if follow:  # two seconds old, it would be a second body
        contents.append(f"- /{subject_path('refined')}/**")
    below = [
        rrb.TextLogView(origin="log", name="log")
        if name == "log"
        else rrb.TimeSeriesView(origin=f"plots/{name}", name=name.replace("_", " "))
        for name in views
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(
                    origin=WORLD, contents=contents, name="3D", background=rrb.Background(color=_BACKGROUND)
                ),
                rrb.Spatial2DView(origin=IMAGE, name="image"),
                column_shares=[3, 2],
            ),
            rrb.Horizontal(*below),
            row_shares=[3, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="image", play_state="following" if follow else None),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
