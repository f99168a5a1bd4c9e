# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of the section "Compare with Rig": `WindowManager.fdda_view`, which is not saved in the .blend file."""

from contextlib import suppress

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from ..core.errors import RigError
from ..core.settings import EVALUATION_SEED, SIDEBAR_EVALUATION_POSES
from ..evaluation.timeline import graph
from ..scene import undo
from ..scene.action_slots import active_action, dependencies, slots_of_action
from ..scene.active_rig import cached_active_rig
from ..scene.draw_cache import draw_cached
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import assign_action
from ..scene.viewport import redraw_views
from .recording_options import actions_of_active_rig


def _redraw(_view: "FDDA_PG_view", _context: bpy.types.Context) -> None:
    redraw_views()


def show_graph(is_shown: bool) -> None:
    """Show or hide the error graph in the timeline."""
    (graph.start if is_shown else graph.stop)()


def _active_action(_view: "FDDA_PG_view") -> str:
    """Return the name of the active action of the rig that the sidebar shows; empty without one."""
    rig = cached_active_rig(bpy.context)
    return active_action_name(rig) if rig is not None else ""


@draw_cached
def active_action_name(scene_rig: SceneRig) -> str:
    """Return the name of the action that animates a rig, or what it depends on; empty without one."""
    action = active_action(scene_rig.armature_object, scene_rig.mesh_object)
    return action.name if action is not None else ""


def _set_active_action(_view: "FDDA_PG_view", name: str) -> None:
    """Make an action the active one of the rig that the sidebar shows; an empty name removes the active one."""
    rig, action = cached_active_rig(bpy.context), bpy.data.actions.get(name)
    if rig is None or (name and action is None):
        return
    roots = (rig.armature_object, rig.mesh_object)
    datablocks = dependencies(*roots)
    if action is not None:
        # If several datablocks fit, none gets the action.
        with suppress(RigError):
            for datablock, slot in slots_of_action(action, datablocks).items():
                assign_action(datablock, action, slot)
    elif (old_action := active_action(*roots)) is not None:
        animations = [getattr(datablock, "animation_data", None) for datablock in datablocks]
        for animation in animations:
            if animation is not None and animation.action == old_action:
                animation.action = None
    undo.push_undo_soon("Choose Action")


class FDDA_PG_view(bpy.types.PropertyGroup):
    """Settings of the evaluation, of the colors in the viewport, and of the graph in the timeline."""

    source: EnumProperty(
        name="Compare On",
        description="Poses to compare the model with the rig on",
        items=(
            ("ACTION", "Active Action", "All frames of the action of the rig"),
            ("RANDOM", "Random Poses", "New random poses within the limits, which are in no recording"),
        ),
        default="ACTION",
    )
    action: StringProperty(
        name="Action",
        description="Active action of the rig; the model is compared with the rig in all of its frames",
        get=_active_action,
        set=_set_active_action,
        search=lambda _view, context, _text: actions_of_active_rig(context),
    )
    poses: IntProperty(
        name="Poses", description="Number of random poses", default=SIDEBAR_EVALUATION_POSES, min=1, soft_max=1000
    )
    seed: IntProperty(name="Seed", description="Random seed of the poses", default=EVALUATION_SEED, min=0)
    deformation: EnumProperty(
        name="Error Of",
        description="Deformation whose error to show",
        items=(
            ("fdda", "Model", "Distance between the model and the rig"),
            ("linear", "Skinning", "Distance between linear skinning and the rig"),
        ),
        update=_redraw,
    )
    statistic: EnumProperty(
        name="Show",
        description="Error to show for each vertex",
        items=(
            ("mean", "Mean", "Mean error over all compared poses"),
            ("max", "Max", "Largest error over all compared poses"),
            ("pose", "This Frame", "Error in the current frame, or in the random pose that is shown"),
        ),
        update=_redraw,
    )
    range_mm: FloatProperty(
        name="Max Color (mm)",
        description="Error that is shown in red",
        default=10.0,
        min=0.001,
        soft_max=50.0,
        precision=3,
        step=10,
        update=_redraw,
    )
    graph: BoolProperty(
        name="Show in Timeline",
        description="Draw the largest error of each frame as a graph at the bottom of the timeline",
        default=True,
        update=lambda view, _context: show_graph(view.graph),
    )
    pose: IntProperty(name="Pose", description="Random pose that is shown", default=-1, options={"HIDDEN"})
    show_partitions: BoolProperty(name="All Body Parts", description="List all body parts, not only the five worst")


CLASSES = (FDDA_PG_view,)
PROPERTIES = {(bpy.types.WindowManager, "fdda_view"): PointerProperty(type=FDDA_PG_view)}
