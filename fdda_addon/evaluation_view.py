# SPDX-License-Identifier: GPL-3.0-or-later
"""What the section Evaluation compares and how it shows it: `WindowManager.fdda_view`, not saved with the file."""

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty


def _redraw(_view: "FDDA_PG_view", _context: bpy.types.Context) -> None:
    redraw_views()


def redraw_views() -> None:
    """Draw the 3D viewports again."""
    for window in getattr(bpy.context.window_manager, "windows", ()):
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


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
    poses: IntProperty(name="Poses", description="Number of random poses", default=100, min=1, soft_max=1000)
    seed: IntProperty(name="Seed", description="Other seeds give other random poses", default=1, min=0)
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
    pose: IntProperty(name="Pose", description="The random pose that was jumped to", default=-1, options={"HIDDEN"})
    markers: IntProperty(
        name="Markers", description="How many of the worst frames are marked", default=5, min=1, max=50
    )
    show_partitions: BoolProperty(name="All Partitions", description="List every partition, not the worst five alone")


CLASSES = (FDDA_PG_view,)


def register() -> None:
    """Register the group."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.WindowManager.fdda_view = PointerProperty(type=FDDA_PG_view)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.WindowManager.fdda_view
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
