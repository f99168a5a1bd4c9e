# SPDX-License-Identifier: GPL-3.0-or-later
"""What the section Evaluation compares and how it shows it: `WindowManager.fdda_view`, not saved with the file."""

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty

from ..core.defaults import EVALUATION_SEED, MARKERS, SIDEBAR_EVALUATION_POSES
from ..scene.viewport import redraw_views


def _redraw(_view: "FDDA_PG_view", _context: bpy.types.Context) -> None:
    redraw_views()


def show_graph(shown: bool) -> None:
    """Draw the errors in the timeline, or not."""
    from ..evaluation import timeline

    (timeline.start if shown else timeline.stop)()


class FDDA_PG_view(bpy.types.PropertyGroup):
    """Settings of the evaluation and of the colours in the viewport."""

    source: EnumProperty(
        name="Compare on",
        description="The poses on which the model is compared with the rig",
        items=(
            ("ACTION", "Active Action", "The frames of the armature's action"),
            ("RANDOM", "Random Poses", "Random poses inside the range of motion that no recording has"),
        ),
        default="ACTION",
    )
    poses: IntProperty(
        name="Poses", description="Number of random poses", default=SIDEBAR_EVALUATION_POSES, min=1, soft_max=1000
    )
    seed: IntProperty(name="Seed", description="Other seeds give other random poses", default=EVALUATION_SEED, min=0)
    way: EnumProperty(
        name="Of",
        description="Whose error is shown",
        items=(
            ("fdda", "FDDA", "The distance of the model from the rig"),
            ("linear", "Linear Layer", "The distance of linear skinning alone from the rig"),
        ),
        update=_redraw,
    )
    statistic: EnumProperty(
        name="Show",
        description="Which error of a vertex is shown",
        items=(
            ("mean", "Mean", "The mean over all poses that were compared"),
            ("max", "Largest", "The largest over all poses that were compared"),
            ("pose", "This Frame", "That of the current frame, or of the random pose that was jumped to"),
        ),
        update=_redraw,
    )
    range_mm: FloatProperty(
        name="Red from (mm)",
        description="Errors from here on are red, half of it is violet",
        default=10.0,
        min=0.001,
        soft_max=50.0,
        precision=3,
        step=10,
        update=_redraw,
    )
    graph: BoolProperty(
        name="Error in the Timeline",
        description="Draw the largest error of each frame as a graph along the bottom of the timeline",
        default=True,
        update=lambda view, _context: show_graph(view.graph),
    )
    pose: IntProperty(name="Pose", description="The random pose that was jumped to", default=-1, options={"HIDDEN"})
    markers: IntProperty(
        name="Markers", description="How many of the worst frames are marked", default=MARKERS, min=1, max=50
    )
    show_partitions: BoolProperty(name="All Partitions", description="List every partition, not the worst five alone")


CLASSES = (FDDA_PG_view,)


def register() -> None:
    """Give the window manager its property."""
    bpy.types.WindowManager.fdda_view = PointerProperty(type=FDDA_PG_view)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.WindowManager.fdda_view
