# SPDX-License-Identifier: GPL-3.0-or-later
"""The error of a model by frame, as a graph along the bottom of the timeline and of the dope sheet."""

import weakref

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
_curve: list[object] = []
"""The evaluation whose errors were asked for last, and they."""
_made: list[object] = []
"""The evaluation and the place that batches were made for, and they."""


def start() -> None:
    """Draw from now on where there is an evaluation to draw."""
    if not _handles and not bpy.app.background:
        add = bpy.types.SpaceDopeSheetEditor.draw_handler_add
        _handles.append(add(_draw, (), "WINDOW", "POST_PIXEL"))
    redraw()


def stop() -> None:
    """Draw no more."""
    _curve.clear()
    _made.clear()
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
    # The timeline is drawn at every frame that plays, and the errors are millions.
    if not _curve or _curve[0]() is not last:
        largest = last.errors["fdda"].max(axis=1) * 1000
        _curve[:] = weakref.ref(last), [(last.first_frame + index, float(error)) for index, error in enumerate(largest)]
    return _curve[1]


def _shown() -> last_evaluation.LastEvaluation | None:
    """The evaluation of the active mesh, or of one on the active armature."""
    active = bpy.context.view_layer.objects.active
    if active is None:
        return None
    if active.type == "ARMATURE":
        meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and armature_of(o) == active]
    else:
        meshes = [active]
    return next((last for o in meshes if (last := last_evaluation.get(o)) is not None), None)


def _draw() -> None:
    last = _shown()
    curve = errors_by_frame(last) if last is not None else []
    if len(curve) < 2:
        return
    context = bpy.context
    scale, view = context.preferences.system.ui_scale, context.region.view2d
    largest = max(error for _, error in curve) or 1.0
    bottom, height = BOTTOM * scale, HEIGHT * scale
    # The view maps frames in proportion: two say where all are.
    (first, _), (last_frame, _) = curve[0], curve[-1]
    left, right = (view.view_to_region(frame, 0, clip=False)[0] for frame in (first, last_frame))
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batches = _batches(last, (left, right, bottom, height), shader)
    gpu.state.blend_set("ALPHA")
    for batch, color in zip(batches, (FILL, LINE), strict=True):
        shader.uniform_float("color", color)
        batch.draw(shader)
    gpu.state.blend_set("NONE")
    blf.size(0, 11 * scale)
    blf.color(0, 1, 1, 1, 0.9)
    blf.position(0, 8 * scale, bottom + 3 * scale, 0)
    blf.draw(0, f"FDDA: max error per frame, up to {largest:.2f} mm")


def _batches(
    last: last_evaluation.LastEvaluation, place: tuple[float, float, float, float], shader: gpu.types.GPUShader
) -> tuple[gpu.types.GPUBatch, ...]:
    """The area below the graph, and the graph; made anew when it is another or somewhere else, not for every frame.

    Args:
        last: what is drawn.
        place: left and right end, bottom and height, pixels.
        shader: that draws it.
    """
    if not _made or _made[0]() is not last or _made[1] != place:
        left, right, bottom, height = place
        curve = errors_by_frame(last)
        largest, step = max(error for _, error in curve) or 1.0, (right - left) / (len(curve) - 1)
        points = [(left + n * step, bottom + height * error / largest) for n, (_, error) in enumerate(curve)]
        below = [corner for x, y in points for corner in ((x, bottom), (x, y))]
        _made[:] = (
            weakref.ref(last),
            place,
            (
                batch_for_shader(shader, "TRI_STRIP", {"pos": below}),
                batch_for_shader(shader, "LINE_STRIP", {"pos": points}),
            ),
        )
    return _made[2]
