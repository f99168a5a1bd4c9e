# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators on the worst frames: add timeline markers, and jump to them."""

import math

import bpy

from ..core.errors import ModelError
from ..core.settings import MARKERS
from ..core.wording import format_count
from ..evaluation import markers
from ..evaluation.run import set_held_out_pose
from ..scene.viewport import center_views
from .evaluation import EvaluationOperator
from .rig_operator import RigOperator


class WorstPosesOperator(EvaluationOperator):
    """Mixin for an operator on the poses with the largest errors."""

    def worst_poses(self, context: bpy.types.Context, count: int) -> tuple[object, object, list[tuple[int, float]]]:
        """Return the rig, its last evaluation, and index and largest error in mm of its worst poses.

        Raises:
            FDDAError: there is no evaluation, or all errors are zero.
        """
        scene_rig, last = self.last_evaluation(context)
        poses = last.worst_poses(count)
        if not poses:
            raise ModelError("The model is exact in all compared poses; there is no worst one.")
        return scene_rig, last, poses


class FDDA_OT_add_worst_markers(WorstPosesOperator, bpy.types.Operator):
    bl_idname = "fdda.add_worst_markers"
    bl_label = "Mark Worst Frames"
    bl_description = "Add timeline markers at the frames with the largest errors, and remove those added before"

    count: bpy.props.IntProperty(
        name="Markers", description="Maximum number of markers", default=MARKERS, min=1, max=50
    )

    def apply(self, context: bpy.types.Context) -> str:
        _, last, poses = self.worst_poses(context, self.count)
        if not last.name:
            raise ModelError("Random poses have no frames to mark; evaluate the active action.")
        worst = [(round(last.scene_frame(index)), error_mm) for index, error_mm in poses]
        markers.place(context.scene, worst)
        return (
            f"Added {format_count(len(worst), 'marker')}. The worst frame is {worst[0][0]}, with {worst[0][1]:.2f} mm."
        )


class FDDA_OT_remove_markers(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.remove_markers"
    bl_label = "Remove Markers"
    bl_description = "Remove the timeline markers at the worst frames. Other markers are kept"

    @classmethod
    def poll_problem(cls, context: bpy.types.Context) -> str:
        return "" if markers.find(context.scene) else "There are no markers at worst frames"

    def apply(self, context: bpy.types.Context) -> str:
        return f"Removed {markers.remove(context.scene)} markers."


class FDDA_OT_jump_to_worst(WorstPosesOperator, bpy.types.Operator):
    bl_idname = "fdda.jump_to_worst"
    bl_label = "Jump to Worst"
    bl_description = "Go to the frame, or show the random pose, with the largest error"

    rank: bpy.props.IntProperty(name="Rank", description="1 is the worst, 2 the next", default=1, min=1, max=50)

    zoom: bpy.props.BoolProperty(
        name="Zoom to Vertex", description="Look at the vertex with the largest error", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        if properties.zoom:
            return "Go to this frame or random pose, and look at the vertex with the largest error"
        return cls.bl_description

    def apply(self, context: bpy.types.Context) -> str:
        message = self._show_pose(context)
        if self.zoom:
            scene_rig, last, poses = self.worst_poses(context, self.rank)
            index = int(last.errors["fdda"][poses[-1][0]].argmax())
            evaluated_object = scene_rig.mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
            # Modifiers that add vertices, such as a subdivision, keep the first ones.
            position = evaluated_object.matrix_world @ evaluated_object.data.vertices[index].co
            center_views(position, max(max(evaluated_object.dimensions) / 20, 1e-4))
        return message

    def _show_pose(self, context: bpy.types.Context) -> str:
        """Show the pose and return the message to report."""
        scene_rig, last, poses = self.worst_poses(context, self.rank)
        index, error_mm = poses[-1]
        if last.name:
            frame = last.scene_frame(index)
            context.scene.frame_set(math.floor(frame), subframe=frame - math.floor(frame))
            return f"Frame {round(frame)}: max error {error_mm:.2f} mm."

        set_held_out_pose(scene_rig, last.channels, last.seed, index)
        context.view_layer.update()
        context.window_manager.fdda_view.pose = index
        return f"Random pose {index + 1}: max error {error_mm:.2f} mm."


CLASSES = (FDDA_OT_add_worst_markers, FDDA_OT_remove_markers, FDDA_OT_jump_to_worst)
