# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws a graph of the largest error of a model in each frame, into the timeline and the Dope Sheet."""

import weakref

import blf
import bpy
import gpu
from gpu_extras.batch import batch_for_shader

from ..scene.scene_rig import armature_of
from . import last_evaluation

GRAPH_HEIGHT, GRAPH_BOTTOM, FRAME_NUMBERS_HEIGHT = 34, 4, 24
"""Largest height of the graph, its distance from the bottom of the region, and height of the frame numbers at the top
of the region, in pixels at a UI scale of 1."""
CAPTION_DISTANCE = 8
"""Distance of the caption from the end of the graph, in pixels at a UI scale of 1."""
FILL_COLOR, LINE_COLOR = (0.9, 0.3, 0.2, 0.35), (1.0, 0.45, 0.3, 0.9)


class ErrorGraph:
    """The graph of the active mesh, drawn from `start` to `stop`. It owns the draw handler and the GPU batches."""

    def __init__(self) -> None:
        self._draw_handle: object = None
        # A weak reference to the evaluation of the last batches, the rectangle of the graph, and the batches.
        self._last_batches: tuple | None = None

    def start(self) -> None:
        """Start drawing the errors of evaluations."""
        if self._draw_handle is None and not bpy.app.background:
            add_handler = bpy.types.SpaceDopeSheetEditor.draw_handler_add
            self._draw_handle = add_handler(self._draw, (), "WINDOW", "POST_PIXEL")
        redraw()

    def stop(self) -> None:
        """Stop drawing."""
        if self._draw_handle is not None:
            bpy.types.SpaceDopeSheetEditor.draw_handler_remove(self._draw_handle, "WINDOW")
        self._draw_handle = self._last_batches = None
        redraw()

    def _draw(self) -> None:
        evaluation = _active_evaluation()
        curve = evaluation.errors_by_frame() if evaluation is not None else []
        if len(curve) < 2:
            return
        context = bpy.context
        ui_scale, view = context.preferences.system.ui_scale, context.region.view2d
        max_error_mm = max(error for _, error in curve) or 1.0
        bottom = GRAPH_BOTTOM * ui_scale
        free_height = context.region.height - FRAME_NUMBERS_HEIGHT * ui_scale - bottom
        height = min(GRAPH_HEIGHT * ui_scale, free_height)
        if height <= 0:
            return
        # The view maps frames linearly to pixels, so the positions of the first and last frame define all others.
        (first_frame, _), (last_frame, _) = curve[0], curve[-1]
        left, right = (view.view_to_region(frame, 0, clip=False)[0] for frame in (first_frame, last_frame))
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        batches = self._batches(evaluation, (left, right, bottom, height), shader)
        gpu.state.blend_set("ALPHA")
        for batch, color in zip(batches, (FILL_COLOR, LINE_COLOR), strict=True):
            shader.uniform_float("color", color)
            batch.draw(shader)
        gpu.state.blend_set("NONE")
        blf.size(0, 11 * ui_scale)
        blf.color(0, 1, 1, 1, 0.9)
        caption = f"FDDA: max error per frame, up to {max_error_mm:.2f} mm"
        # Beside the graph; over its end if there is no space.
        max_x = context.region.width - blf.dimensions(0, caption)[0] - CAPTION_DISTANCE * ui_scale
        blf.position(0, max(0, min(right + CAPTION_DISTANCE * ui_scale, max_x)), bottom + 3 * ui_scale, 0)
        blf.draw(0, caption)

    def _batches(
        self,
        evaluation: last_evaluation.LastEvaluation,
        rectangle: tuple[float, float, float, float],
        shader: gpu.types.GPUShader,
    ) -> tuple[gpu.types.GPUBatch, ...]:
        """Return the GPU batches of the area below the graph and of its line, stored until an argument changes."""
        last = self._last_batches
        if last is None or last[0]() is not evaluation or last[1] != rectangle:
            left, right, bottom, height = rectangle
            curve = evaluation.errors_by_frame()
            max_error_mm, frame_width = max(error for _, error in curve) or 1.0, (right - left) / (len(curve) - 1)
            points = [
                (left + index * frame_width, bottom + height * error / max_error_mm)
                for index, (_, error) in enumerate(curve)
            ]
            area_corners = [corner for x, y in points for corner in ((x, bottom), (x, y))]
            area = batch_for_shader(shader, "TRI_STRIP", {"pos": area_corners})
            line = batch_for_shader(shader, "LINE_STRIP", {"pos": points})
            last = self._last_batches = weakref.ref(evaluation), rectangle, (area, line)
        return last[2]


graph = ErrorGraph()


def redraw() -> None:
    """Redraw the timelines."""
    for window in getattr(bpy.context.window_manager, "windows", ()):
        for area in window.screen.areas:
            if area.type == "DOPESHEET_EDITOR":
                area.tag_redraw()


def _active_evaluation() -> last_evaluation.LastEvaluation | None:
    """Return the last evaluation of the active mesh, or of a mesh that the active armature deforms."""
    active_object = bpy.context.view_layer.objects.active
    if active_object is None:
        return None
    if active_object.type == "ARMATURE":
        # Look for evaluations first: few objects have one, and finding the armature of an object takes longer.
        evaluations = ((o, last_evaluation.get(o)) for o in bpy.context.scene.objects)
        return next(
            (evaluation for o, evaluation in evaluations if evaluation is not None and armature_of(o) == active_object),
            None,
        )
    return last_evaluation.get(active_object)
