# SPDX-License-Identifier: GPL-3.0-or-later
"""The error of a model by frame, as a graph along the bottom of the timeline and of the dope sheet."""

import blf
import bpy
import gpu
from gpu_extras.batch import batch_for_shader

from ..scene.scene_rig import armature_of
from . import last_evaluation

HEIGHT, BOTTOM = 34, 18
"""Of the graph, and of what Blender has below it, pixels at a scale of 1."""
FILL, LINE = (0.9, 0.3, 0.2, 0.35), (1.0, 0.45, 0.3, 0.9)

_handles: list[object] = []


def start() -> None:
    """Draw from now on where there is an evaluation to draw."""
    if not _handles and not bpy.app.background:
        add = bpy.types.SpaceDopeSheetEditor.draw_handler_add
        _handles.append(add(_draw, (), "WINDOW", "POST_PIXEL"))
    redraw()


def stop() -> None:
    """Draw no more."""
    while _handles:
        bpy.types.SpaceDopeSheetEditor.draw_handler_remove(_handles.pop(), "WINDOW")
    redraw()


def redraw() -> None:
    """Draw the timelines again."""
    for window in getattr(bpy.context.window_manager, "windows", ()):
        for area in window.screen.areas:
            if area.type == "DOPESHEET_EDITOR":
                area.tag_redraw()


def errors_by_frame(last: last_evaluation.LastEvaluation) -> list[tuple[int, float]]:
    """Frame and largest error of the model in mm, of every frame that was compared; none for random poses."""
    if not last.name:
        return []
    largest = last.errors["fdda"].max(axis=1) * 1000
    return [(last.first_frame + index, float(error)) for index, error in enumerate(largest)]


def _shown() -> last_evaluation.LastEvaluation | None:
    """The evaluation of the active mesh, or of one on the active armature."""
    active = bpy.context.view_layer.objects.active
    if active is None:
        return None
    if active.type == "ARMATURE":
        meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and armature_of(o) == active]
    else:
        meshes = [active]
    return next((last for o in meshes if (last := last_evaluation.of(o)) is not None), None)


def _draw() -> None:
    last = _shown()
    curve = errors_by_frame(last) if last is not None else []
    if len(curve) < 2:
        return
    context = bpy.context
    scale, view = context.preferences.system.ui_scale, context.region.view2d
    largest = max(error for _, error in curve) or 1.0
    bottom, height = BOTTOM * scale, HEIGHT * scale
    points = [(view.view_to_region(frame, 0, clip=False)[0], bottom + height * e / largest) for frame, e in curve]
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.blend_set("ALPHA")
    for kind, vertices, color in (
        ("TRI_STRIP", [corner for x, y in points for corner in ((x, bottom), (x, y))], FILL),
        ("LINE_STRIP", points, LINE),
    ):
        shader.uniform_float("color", color)
        batch_for_shader(shader, kind, {"pos": vertices}).draw(shader)
    gpu.state.blend_set("NONE")
    blf.size(0, 11 * scale)
    blf.color(0, 1, 1, 1, 0.9)
    blf.position(0, 8 * scale, bottom + 3 * scale, 0)
    blf.draw(0, f"FDDA: largest error by frame, up to {largest:.2f} mm")
