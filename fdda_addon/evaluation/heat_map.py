# SPDX-License-Identifier: GPL-3.0-or-later
"""Colors meshes in the viewport: by the errors of a model (heat map), or by partition.

The colors are drawn over the evaluated meshes, so they follow the animation and do not change the file. They last until
Blender ends. Without a window nothing is drawn.
"""

from contextlib import suppress

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..core.errors import ModelError
from ..core.mathematics.metrics import viewport_colors
from ..core.mathematics.partition import make_merged_partitions, partition_colors
from ..core.settings import MIN_VERTICES_PER_PART
from ..core.wording import format_count
from ..rig.reading import read_rig
from ..runtime.model_files import network_of
from ..runtime.opened_model import open_model
from ..scene.arrays import TRIANGLE_ELEMENT, VECTOR_ELEMENT, read
from ..scene.compatibility import is_bone_hidden, is_selected
from ..scene.mesh import mesh_positions
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.viewport import redraw_views
from . import last_evaluation

ERRORS, PARTITIONS = "ERRORS", "PARTITIONS"
"""Kinds of colors: the errors of a model, or the partitions."""
BONE_COLOR, SELECTED_BONE_COLOR, ACTIVE_BONE_COLOR = (
    (0.75, 0.75, 0.75, 1.0),
    (0.3, 0.85, 1.0, 1.0),
    (1.0, 1.0, 1.0, 1.0),
)
DEPTH_OFFSET = 2e-5
"""Depth offset of the colors towards the viewer. It is large enough that the colors cover the mesh itself, and too
small to cover objects in front of the mesh."""
BONE_WIDTH_PIXELS = 3
VERTEX_SHADER = """
void main()
{
  shade = 0.25 + 0.75 * abs(dot(normalize(normal), towards));
  paint = color;
  gl_Position = transform * vec4(position, 1.0);
  gl_Position.z -= offset * gl_Position.w;
}
"""
FRAGMENT_SHADER = """
void main()
{
  vec3 linear = mix(paint / 12.92, pow((paint + 0.055) / 1.055, vec3(2.4)), step(0.04045, paint));
  outcome = vec4(linear * shade, 1.0);
}
"""


def paint_errors(mesh_object: bpy.types.Object) -> None:
    """Show the errors of the last evaluation of a mesh as colors."""
    _paint(mesh_object, None)


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
    _paint(scene_rig.mesh_object, (partition_colors(partitions, rig.vertex_count), len(partitions)))


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
    if mesh_object.session_uid not in _colors.paints:
        return ""
    return ERRORS if _colors.paints[mesh_object.session_uid] is None else PARTITIONS


def is_hidden(mesh_object: bpy.types.Object) -> bool:
    """Return whether the colors of a mesh cannot be drawn, because of edit mode or a changed topology."""
    kind, evaluation = paint_kind(mesh_object), last_evaluation.get(mesh_object)
    if not kind or (kind == ERRORS and evaluation is None):
        return False
    count = evaluation.vertices if kind == ERRORS else len(colors_of(mesh_object))
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return evaluated.mode == "EDIT" or len(evaluated.data.vertices) != count


def colors_of(mesh_object: bpy.types.Object) -> np.ndarray | None:
    """Return the colors of a mesh at the current frame, (V, 3) float32, sRGB; None if there are none."""
    kind = paint_kind(mesh_object)
    if kind == PARTITIONS:
        return _colors.paints[mesh_object.session_uid][0]
    errors = errors_of(mesh_object) if kind else None
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


def _paint(mesh_object: bpy.types.Object, paint: tuple[np.ndarray, int] | None) -> None:
    _colors.paints[mesh_object.session_uid] = paint
    if not bpy.app.background:
        _colors.start()
    redraw_views()


class _MeshColors:
    """The colors of the open file's meshes, drawn while there are any. It owns draw handlers and GPU resources.

    Attributes:
        paints: the colors of the partitions, (V, 3) float32, sRGB, and their number, by the session ids of mesh
            objects; None for errors, whose colors depend on the frame.
    """

    def __init__(self) -> None:
        self.paints: dict[int, tuple[np.ndarray, int] | None] = {}
        self._draw_handles: list[object] = []
        self._shader: gpu.types.GPUShader | None = None
        # Key of the mesh (`triangles_of`) and its triangles, by the session id of the mesh object.
        self._triangles: dict[int, tuple[tuple[int, int, int], gpu.types.GPUIndexBuf]] = {}

    def start(self) -> None:
        """Start drawing."""
        if not self._draw_handles:
            add_handler = bpy.types.SpaceView3D.draw_handler_add
            self._draw_handles.append(add_handler(self._draw_view, (), "WINDOW", "POST_VIEW"))
            self._draw_handles.append(add_handler(self._draw_legend, (), "WINDOW", "POST_PIXEL"))

    def stop(self) -> None:
        """Stop drawing, and free the GPU resources, which must be freed before Blender's GPU context."""
        self._shader = None
        while self._draw_handles:
            bpy.types.SpaceView3D.draw_handler_remove(self._draw_handles.pop(), "WINDOW")
        self._triangles.clear()

    def triangles_of(self, mesh_object: bpy.types.Object, evaluated: bpy.types.Object) -> gpu.types.GPUIndexBuf | None:
        """Return the triangles of an evaluated mesh, stored because computing them takes longer than drawing them.

        They are None in edit mode: edits such as Rotate Edge change the triangles, but not the counts that identify
        the mesh.
        """
        if evaluated.mode == "EDIT":
            self._triangles.pop(mesh_object.session_uid, None)
            return None
        mesh = evaluated.data
        mesh_key = (mesh_object.data.session_uid, len(mesh.vertices), len(mesh.loops))
        stored = self._triangles.get(mesh_object.session_uid)
        if stored is None or stored[0] != mesh_key:
            mesh.calc_loop_triangles()
            triangles = gpu.types.GPUIndexBuf(type="TRIS", seq=read(mesh.loop_triangles, TRIANGLE_ELEMENT))
            stored = self._triangles[mesh_object.session_uid] = mesh_key, triangles
        return stored[1]

    def _draw_view(self) -> None:
        context = bpy.context
        painted_objects = {o.session_uid: o for o in bpy.data.objects if o.session_uid in self.paints}
        for removed_uid in self.paints.keys() - painted_objects.keys():
            del self.paints[removed_uid]
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.depth_mask_set(True)
        try:
            for mesh_object in painted_objects.values():
                if mesh_object.visible_get(view_layer=context.view_layer):
                    self._draw_mesh(context, mesh_object)
        finally:
            gpu.state.depth_mask_set(False)
            gpu.state.depth_test_set("NONE")
        self._draw_bones(context)

    def _draw_mesh(self, context: bpy.types.Context, mesh_object: bpy.types.Object) -> None:
        """Draw a mesh in its colors, unless it is edited, or modifiers change its topology."""
        evaluated = mesh_object.evaluated_get(context.evaluated_depsgraph_get())
        colors, triangles = colors_of(mesh_object), self.triangles_of(mesh_object, evaluated)
        if colors is None or triangles is None or len(evaluated.data.vertices) != len(colors):
            return
        normals = read(evaluated.data.vertex_normals, VECTOR_ELEMENT)
        attributes = {"position": mesh_positions(evaluated.data), "normal": normals, "color": colors}
        # Blender 5.2 does not derive the format from the shader.
        vertex_format = gpu.types.GPUVertFormat()
        for name in attributes:
            vertex_format.attr_add(id=name, comp_type="F32", len=3, fetch_mode="FLOAT")
        vertices = gpu.types.GPUVertBuf(vertex_format, len(colors))
        for name, values in attributes.items():
            vertices.attr_fill(name, values)
        shader, region_view = self._mesh_shader(), context.region_data
        shader.bind()
        shader.uniform_float("transform", region_view.perspective_matrix @ evaluated.matrix_world)
        to_view = (region_view.view_matrix @ evaluated.matrix_world).to_3x3()
        shader.uniform_float("towards", to_view.inverted_safe().col[2].normalized())
        shader.uniform_float("offset", DEPTH_OFFSET)
        gpu.types.GPUBatch(type="TRIS", buf=vertices, elem=triangles).draw(shader)

    def _draw_bones(self, context: bpy.types.Context) -> None:
        """Draw the bones of armatures in pose mode again, because the colors cover them."""
        line_ends: dict[tuple[float, ...], list[tuple[float, ...]]] = {}
        for mesh_object in context.view_layer.objects:
            armature_object = armature_of(mesh_object) if mesh_object.session_uid in self.paints else None
            if armature_object is None or armature_object.mode != "POSE":
                continue
            matrix, active_bone = armature_object.matrix_world, armature_object.data.bones.active
            for bone in armature_object.pose.bones:
                if is_bone_hidden(bone):
                    continue
                color = SELECTED_BONE_COLOR if is_selected(bone) else BONE_COLOR
                ends = tuple(matrix @ bone.head), tuple(matrix @ bone.tail)
                line_ends.setdefault(ACTIVE_BONE_COLOR if bone.bone == active_bone else color, []).extend(ends)
        if not line_ends:
            return
        shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
        shader.uniform_float("viewportSize", (context.region.width, context.region.height))
        for color, ends in line_ends.items():
            # A wider dark line below each bone outlines it.
            for width, line_color in ((BONE_WIDTH_PIXELS + 2, (0, 0, 0, 0.6)), (BONE_WIDTH_PIXELS, color)):
                shader.uniform_float("lineWidth", width * context.preferences.system.ui_scale)
                shader.uniform_float("color", line_color)
                batch_for_shader(shader, "LINES", {"pos": ends}).draw(shader)

    def _legend(self, context: bpy.types.Context) -> tuple[list[str], float | None]:
        """Return the lines of the legend, and the range of the heat map in mm; None if no errors are shown."""
        painted_objects = {o.session_uid: o for o in context.view_layer.objects if o.session_uid in self.paints}
        active_object = context.view_layer.objects.active
        active_painted_object = painted_objects.get(active_object.session_uid) if active_object else None
        mesh_object = active_painted_object or next(iter(painted_objects.values()), None)
        if mesh_object is None:
            return [], None
        if (paint := self.paints[mesh_object.session_uid]) is not None:
            return [f"{mesh_object.name}: {paint[1]} body parts"], None
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

    def _draw_legend(self) -> None:
        lines, range_mm = self._legend(bpy.context)
        if lines:
            # Draw the lines of the legend, and below them the colors of a heat map.
            ui_scale = bpy.context.preferences.system.ui_scale
            visible_regions = [region for region in bpy.context.area.regions if region.width > 1]
            left_x = 24 * ui_scale + sum(region.width for region in visible_regions if region.type == "TOOLS")
            # The legend is above the Adjust Last Operation panel, which is the region HUD.
            bottom_y = 30 * ui_scale + sum(region.height for region in visible_regions if region.type == "HUD")
            blf.size(0, 12 * ui_scale)
            blf.enable(0, blf.SHADOW)
            blf.shadow(0, 5, 0, 0, 0, 0.9)
            if range_mm is not None:
                height, width = 14 * ui_scale, 240 * ui_scale
                strip_bottom = bottom_y + 18 * ui_scale
                colors = viewport_colors(np.linspace(0, 1, 65), 1.0)
                x_values = left_x + width * np.linspace(0, 1, len(colors))
                corners = [(x, y) for x in x_values for y in (strip_bottom, strip_bottom + height)]
                rgba = [(*color, 1.0) for color in colors.tolist() for _ in range(2)]
                shader = gpu.shader.from_builtin("SMOOTH_COLOR")
                batch = batch_for_shader(shader, "TRI_STRIP", {"pos": corners, "color": rgba})
                batch.draw(shader)
                for fraction, text in ((0, "0"), (0.5, f"{range_mm / 2:.4g}"), (1, f"{range_mm:.4g} mm and more")):
                    half_width = blf.dimensions(0, text.split(" ")[0])[0] / 2
                    _draw_text(text, left_x + fraction * width - half_width, bottom_y)
                bottom_y += 46 * ui_scale
            for line in reversed(lines):
                _draw_text(line, left_x, bottom_y)
                bottom_y += 18 * ui_scale
            blf.disable(0, blf.SHADOW)

    def _mesh_shader(self) -> gpu.types.GPUShader:
        if self._shader is None:
            info = gpu.types.GPUShaderCreateInfo()
            info.push_constant("MAT4", "transform")
            info.push_constant("VEC3", "towards")
            info.push_constant("FLOAT", "offset")
            for slot, name in enumerate(("position", "normal", "color")):
                info.vertex_in(slot, "VEC3", name)
            interface = gpu.types.GPUStageInterfaceInfo("fdda_interface")
            interface.smooth("VEC3", "paint")
            interface.smooth("FLOAT", "shade")
            info.vertex_out(interface)
            info.fragment_out(0, "VEC4", "outcome")
            info.vertex_source(VERTEX_SHADER)
            info.fragment_source(FRAGMENT_SHADER)
            self._shader = gpu.shader.create_from_info(info)
        return self._shader


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


def _draw_text(text: str, x: float, y: float) -> None:
    blf.color(0, 1, 1, 1, 1)
    blf.position(0, round(x), round(y), 0)
    blf.draw(0, text)
