# SPDX-License-Identifier: GPL-3.0-or-later
"""Colors over meshes in the viewport: their errors as a heat map, or their partitions.

They are drawn over what Blender evaluates, so nothing of the file is touched, and they follow the animation. Which
meshes are painted lasts for the session; without a window nothing is drawn.
"""

from contextlib import suppress
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.defaults import MIN_PARTITION_VERTICES
from ..core.errors import ModelError
from ..core.metrics import heat_colors
from ..core.partition import make_merged_partitions, partition_colors
from ..rig.reading import read_rig
from ..runtime.model_files import network_of
from ..runtime.opened_model import open_model
from ..scene.compatibility import is_bone_hidden, is_selected
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.viewport import redraw_views
from . import last_evaluation, overlay

ERRORS, PARTITIONS = "ERRORS", "PARTITIONS"
BONE, SELECTED, ACTIVE = (0.75, 0.75, 0.75, 1.0), (0.3, 0.85, 1.0, 1.0), (1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Paint:
    """What a mesh is painted with: ERRORS or PARTITIONS, and for those their (V, 3) sRGB colors and number."""

    kind: str
    colors: np.ndarray | None = None
    partitions: int = 0


_painted: dict[int, Paint] = {}
_hidden: set[int] = set()


def paint_errors(mesh_object: bpy.types.Object) -> None:
    """Show the errors of the last evaluation of a mesh."""
    _paint(mesh_object, Paint(ERRORS))


def paint_partitions(scene_rig: SceneRig, min_partition_vertices: int = MIN_PARTITION_VERTICES) -> None:
    """Show the partitions of the bound model; where none is bound that can be read, those that a rig is recorded with.

    Raises:
        RigError: the rig cannot be read.
    """
    rig = read_rig(scene_rig)
    partitions = make_merged_partitions(rig, min_partition_vertices)
    if scene_rig.mesh_object.fdda.is_bound:
        with suppress(ModelError):
            opened = open_model(scene_rig, network_of(scene_rig.mesh_object))
            # Fitted skin weights cut the mesh otherwise than those of the rig.
            partitions = opened.network.info.partitions_of(opened.linear_rig)
    colors = partition_colors(partitions, rig.vertex_count)
    _paint(scene_rig.mesh_object, Paint(PARTITIONS, colors, len(partitions)))


def clear(mesh_object: bpy.types.Object) -> None:
    """Show a mesh as Blender does."""
    _painted.pop(mesh_object.session_uid, None)
    if not _painted:
        overlay.stop()
    redraw_views()


def clear_all() -> None:
    """Paint nothing any more."""
    _painted.clear()
    overlay.stop()


def painted(mesh_object: bpy.types.Object) -> str:
    """ERRORS or PARTITIONS, empty when the mesh is not painted."""
    paint = _painted.get(mesh_object.session_uid)
    return paint.kind if paint else ""


def is_hidden(mesh_object: bpy.types.Object) -> bool:
    """Whether the colors of a mesh could not be drawn: it is edited, or a modifier changes its topology."""
    return mesh_object.session_uid in _hidden


def colors_of(mesh_object: bpy.types.Object) -> np.ndarray | None:
    """The colors of a painted mesh at the current frame: (V, 3) float32 sRGB, None when there is nothing to show."""
    paint = _painted.get(mesh_object.session_uid)
    if paint is None:
        return None
    if paint.kind == PARTITIONS:
        return paint.colors
    errors = errors_of(mesh_object)
    return None if errors is None else heat_colors(errors, bpy.context.window_manager.fdda_view.range_mm / 1000)


def errors_of(mesh_object: bpy.types.Object) -> np.ndarray | None:
    """The errors that the settings of the view ask for: (V,) metres, None when there are none at this frame."""
    last, view = last_evaluation.get(mesh_object), bpy.context.window_manager.fdda_view
    if last is None:
        return None
    pose = last.pose_at(bpy.context.scene.frame_current) if last.name else view.pose
    return last.vertex_errors(view.way, view.statistic, pose)


def fitting_range_mm(mesh_object: bpy.types.Object) -> float:
    """A range in mm in which the errors that are shown have colors from blue to red: nearly the largest of them."""
    errors = errors_of(mesh_object)
    return 0.0 if errors is None else float(f"{np.percentile(errors, 99.5) * 1000:.2g}")


def _paint(mesh_object: bpy.types.Object, paint: Paint) -> None:
    _painted[mesh_object.session_uid] = paint
    if not bpy.app.background:
        overlay.start(_sheets, _legend, _sticks)
    redraw_views()


def _sheets(context: bpy.types.Context) -> list["overlay.OverlayMesh"]:
    """What the overlay draws, object by object."""
    alive = {o.session_uid: o for o in bpy.data.objects if o.session_uid in _painted}
    for uid in _painted.keys() - alive.keys():
        del _painted[uid]
    drawn, hidden = [], set()
    for uid, mesh_object in alive.items():
        colors = colors_of(mesh_object)
        if colors is None or not mesh_object.visible_get(view_layer=context.view_layer):
            continue
        sheet = overlay.sheet(context, mesh_object, colors)
        if sheet is None:
            hidden.add(uid)
        else:
            drawn.append(sheet)
    if hidden != _hidden:
        _hidden.clear()
        _hidden.update(hidden)
        # Not from within a drawing.
        bpy.app.timers.register(redraw_views, first_interval=0)
    return drawn


def _sticks(context: bpy.types.Context) -> list["overlay.OverlayBone"]:
    """The bones of armatures in pose mode whose mesh is painted: the colors would hide them."""
    found = []
    for mesh_object in context.view_layer.objects:
        armature_object = armature_of(mesh_object) if mesh_object.session_uid in _painted else None
        if armature_object is None or armature_object.mode != "POSE":
            continue
        matrix, active = armature_object.matrix_world, armature_object.data.bones.active
        for bone in armature_object.pose.bones:
            if is_bone_hidden(bone):
                continue
            color = ACTIVE if bone.bone == active else (SELECTED if is_selected(bone) else BONE)
            found.append(overlay.OverlayBone(tuple(matrix @ bone.head), tuple(matrix @ bone.tail), color))
    return found


def _legend(context: bpy.types.Context) -> tuple[list[str], float | None]:
    """Lines below the colors, and the range of the heat map in mm, None where no errors are shown."""
    uids = {o.session_uid: o for o in context.view_layer.objects if o.session_uid in _painted}
    active = context.view_layer.objects.active
    chosen = uids.get(active.session_uid) if active else None
    mesh_object = chosen or next(iter(uids.values()), None)
    if mesh_object is None:
        return [], None
    paint = _painted[mesh_object.session_uid]
    if paint.kind == PARTITIONS:
        return [f"{mesh_object.name}: {paint.partitions} body parts"], None
    last, view = last_evaluation.get(mesh_object), context.window_manager.fdda_view
    if last is None:
        return [], None
    errors = errors_of(mesh_object)
    way = "skinning" if view.way == "linear" else "model"
    what = _what(last, view.statistic, context.scene.frame_current, view.pose)
    if errors is None:
        return [f"{mesh_object.name}, {way}: {what}"], None
    numbers = f"mean {errors.mean() * 1000:.2f} mm, max {errors.max() * 1000:.2f} mm"
    return [f"{mesh_object.name}, {way}: {what}", numbers], view.range_mm


def _what(last: last_evaluation.LastEvaluation, statistic: str, frame: int, pose: int) -> str:
    if statistic != "pose":
        over = f"{last.poses} frames of {last.name}" if last.name else f"{last.poses} random poses"
        return f"{'mean' if statistic == 'mean' else 'max'} error over {over}"
    if not last.name:
        return f"error in random pose {pose}"
    return f"error at frame {frame}" if last.pose_at(frame) is not None else f"frame {frame} was not compared"
