"""Which views the window has."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drocap_ros.view.scene import PICTURE, WORLD, subject_path

if TYPE_CHECKING:
    import rerun.blueprint as rrb

_BACKGROUND = (238, 240, 243)


def layout(views: tuple[str, ...], *, follow: bool = False) -> rrb.Blueprint:
    """The body in its world beside the picture with its keypoints, over curves and the log.

    Parameters
    ----------
    views : groups of curves, one view each; "log" is what the nodes say
    follow : whether the newest image is shown, not the first; refined poses are hidden then
    """
    import rerun.blueprint as rrb

    contents = [f"+ /{WORLD}/**"]
    if follow:  # a refined pose is two seconds old: beside the newest ones it would be a second body
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
                rrb.Spatial2DView(origin=PICTURE, name="picture"),
                column_shares=[3, 2],
            ),
            rrb.Horizontal(*below),
            row_shares=[3, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="image", play_state="following" if follow else None),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
