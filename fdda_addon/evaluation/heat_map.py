# SPDX-License-Identifier: GPL-3.0-or-later
"""Colors meshes in the viewport: by the errors of a model (heat map), or by partition.

The colors are drawn over the evaluated meshes, so they follow the animation and do not change the file. They last until
Blender ends. Without a window nothing is drawn.
"""

from contextlib import suppress
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.errors import ModelError
from ..core.mathematics.metrics import viewport_colors
from ..core.mathematics.partition import make_merged_partitions, partition_colors
from ..core.settings import MIN_VERTICES_PER_PART
from ..core.wording import format_count
from ..rig.reading import read_rig
from ..runtime.model_files import network_of
from ..runtime.opened_model import open_model
from ..scene.compatibility import is_bone_hidden, is_selected
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.viewport import redraw_views
from . import last_evaluation, overlay

ERRORS, PARTITIONS = "ERRORS", "PARTITIONS"
"""Kinds of colors: the errors of a model, or the partitions."""
BONE_COLOR, SELECTED_BONE_COLOR, ACTIVE_BONE_COLOR = (
    (0.75, 0.75, 0.75, 1.0),
    (0.3, 0.85, 1.0, 1.0),
    (1.0, 1.0, 1.0, 1.0),
)


@dataclass(frozen=True)
class Paint:
    """The colors of a mesh.

    Attributes:
        kind: `ERRORS` or `PARTITIONS`.
        partition_colors: (V, 3) float32, sRGB; None for errors, whose colors depend on the frame.
        partition_count: number of partitions; 0 for errors.
    """

    kind: str
    partition_colors: np.ndarray | None = None
    partition_count: int = 0


def paint_errors(mesh_object: bpy.types.Object) -> None:
    """Show the errors of the last evaluation of a mesh as colors."""
    _paint(mesh_object, Paint(ERRORS))


def paint_partitions(scene_rig: SceneRig, min_vertices_per_part: int = MIN_VERTICES_PER_PART.default) -> None:
    """Show the partitions of the bound model as colors, or the partitions of the rig if no model can be read.

    Args:
        min_vertices_per_part: smallest number of vertices in a partition of the rig.
    """
    rig = read_rig(scene_rig)
    partitions = make_merged_partitions(rig, min_vertices_per_part)
    if scene_rig.mesh_object.fdda.is_bound:
        with suppress(ModelError):
            opened_model = open_model(scene_rig, network_of(scene_rig.mesh_object))
            # Fitted skin weights result in other partitions than the skin weights of the rig.
            partitions = opened_model.network.info.partitions_of(opened_model.linear_rig)
    colors = partition_colors(partitions, rig.vertex_count)
    _paint(scene_rig.mesh_object, Paint(PARTITIONS, colors, len(partitions)))


def clear(mesh_object: bpy.types.Object) -> None:
    """Remove the colors of a mesh."""
    _colors.paints.pop(mesh_object.session_uid, None)
    if not _colors.paints:
        _colors.stop()
    redraw_views()


def clear_all() -> None:
    """Remove the colors of all meshes."""
    _colors.paints.clear()
    _colors.stop()


def paint_kind(mesh_object: bpy.types.Object) -> str:
    """Return the kind of the colors of a mesh, `ERRORS` or `PARTITIONS`; empty if the mesh has no colors."""
    paint = _colors.paints.get(mesh_object.session_uid)
    return paint.kind if paint else ""


def is_hidden(mesh_object: bpy.types.Object) -> bool:
    """Return whether the colors of a mesh cannot be drawn, because of edit mode or a changed topology."""
    paint, evaluation = _colors.paints.get(mesh_object.session_uid), last_evaluation.get(mesh_object)
    if paint is None or (paint.kind == ERRORS and evaluation is None):
        return False
    count = evaluation.vertices if paint.kind == ERRORS else len(paint.partition_colors)
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return evaluated.mode == "EDIT" or len(evaluated.data.vertices) != count


def colors_of(mesh_object: bpy.types.Object) -> np.ndarray | None:
    """Return the colors of a mesh at the current frame, (V, 3) float32, sRGB; None if there are none."""
    paint = _colors.paints.get(mesh_object.session_uid)
    if paint is None:
        return None
    if paint.kind == PARTITIONS:
        return paint.partition_colors
    errors = errors_of(mesh_object)
    return None if errors is None else viewport_colors(errors, bpy.context.window_manager.fdda_view.range_mm / 1000)


def errors_of(mesh_object: bpy.types.Object) -> np.ndarray | None:
    """Return the errors that the view settings select, (V,) meters; None if there are none at the current frame."""
    evaluation, view = last_evaluation.get(mesh_object), bpy.context.window_manager.fdda_view
    if evaluation is None:
        return None
    pose = evaluation.pose_at(bpy.context.scene.frame_current) if evaluation.name else view.pose
    return evaluation.vertex_errors(view.deformation, view.statistic, pose)


def suggested_range_mm(mesh_object: bpy.types.Object) -> float:
    """Return a range of the heat map, in mm, that covers almost all shown errors; 0 if no errors are shown."""
    errors = errors_of(mesh_object)
    return 0.0 if errors is None else float(f"{np.percentile(errors, 99.5) * 1000:.2g}")


def _paint(mesh_object: bpy.types.Object, paint: Paint) -> None:
    _colors.paints[mesh_object.session_uid] = paint
    if not bpy.app.background:
        _colors.start()
    redraw_views()


class _MeshColors(overlay.Overlay):
    """The colors of the open file's meshes, drawn while there are any.

    Attributes:
        paints: the colors, by the session ids of mesh objects.
    """

    def __init__(self) -> None:
        super().__init__()
        self.paints: dict[int, Paint] = {}

    def meshes(self, context: bpy.types.Context) -> list[overlay.OverlayMesh]:
        """Return the meshes to draw, and discard the colors of objects that no longer exist."""
        painted_objects = {o.session_uid: o for o in bpy.data.objects if o.session_uid in self.paints}
        for removed_uid in self.paints.keys() - painted_objects.keys():
            del self.paints[removed_uid]
        meshes = []
        for mesh_object in painted_objects.values():
            colors = colors_of(mesh_object)
            if colors is not None and mesh_object.visible_get(view_layer=context.view_layer):
                meshes.append(self.overlay_mesh(context, mesh_object, colors))
        return [mesh for mesh in meshes if mesh is not None]

    def bones(self, context: bpy.types.Context) -> list[overlay.OverlayBone]:
        """Return the bones of armatures in pose mode, which are drawn again because the colors cover them."""
        bones = []
        for mesh_object in context.view_layer.objects:
            armature_object = armature_of(mesh_object) if mesh_object.session_uid in self.paints else None
            if armature_object is None or armature_object.mode != "POSE":
                continue
            matrix, active_bone = armature_object.matrix_world, armature_object.data.bones.active
            for bone in armature_object.pose.bones:
                if is_bone_hidden(bone):
                    continue
                color = (
                    ACTIVE_BONE_COLOR
                    if bone.bone == active_bone
                    else (SELECTED_BONE_COLOR if is_selected(bone) else BONE_COLOR)
                )
                bones.append(overlay.OverlayBone(tuple(matrix @ bone.head), tuple(matrix @ bone.tail), color))
        return bones

    def legend(self, context: bpy.types.Context) -> tuple[list[str], float | None]:
        """Return the lines of the legend, and the range of the heat map in mm; None if no errors are shown."""
        painted_objects = {o.session_uid: o for o in context.view_layer.objects if o.session_uid in self.paints}
        active_object = context.view_layer.objects.active
        active_painted_object = painted_objects.get(active_object.session_uid) if active_object else None
        mesh_object = active_painted_object or next(iter(painted_objects.values()), None)
        if mesh_object is None:
            return [], None
        paint = self.paints[mesh_object.session_uid]
        if paint.kind == PARTITIONS:
            return [f"{mesh_object.name}: {paint.partition_count} body parts"], None
        evaluation, view = last_evaluation.get(mesh_object), context.window_manager.fdda_view
        if evaluation is None:
            return [], None
        errors = errors_of(mesh_object)
        method = "skinning" if view.deformation == "linear" else "model"
        description = _describe_errors(evaluation, view.statistic, context.scene.frame_current, view.pose)
        if errors is None:
            return [f"{mesh_object.name}, {method}: {description}"], None
        statistics = f"mean {errors.mean() * 1000:.2f} mm, max {errors.max() * 1000:.2f} mm"
        return [f"{mesh_object.name}, {method}: {description}", statistics], view.range_mm


_colors = _MeshColors()


def _describe_errors(evaluation: last_evaluation.LastEvaluation, statistic: str, frame: int, pose: int) -> str:
    if statistic != "pose":
        poses = (
            f"{format_count(evaluation.poses, 'frame')} of {evaluation.name}"
            if evaluation.name
            else format_count(evaluation.poses, "random pose")
        )
        return f"{'mean' if statistic == 'mean' else 'max'} error over {poses}"
    if not evaluation.name:
        return f"error in random pose {pose}"
    return f"error at frame {frame}" if evaluation.pose_at(frame) is not None else f"frame {frame} was not compared"
