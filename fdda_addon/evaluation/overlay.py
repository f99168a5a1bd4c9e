# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws meshes with vertex colors, bones, and a legend over the 3D viewports."""

from dataclasses import dataclass

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..core.mathematics.metrics import viewport_colors
from ..scene.arrays import TRIANGLE_ELEMENT, VECTOR_ELEMENT, read
from ..scene.mesh import mesh_positions

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


@dataclass(frozen=True)
class OverlayMesh:
    """A mesh to draw.

    Attributes:
        positions, normals: (V, 3) float32, object space.
        colors: (V, 3) float32, sRGB.
        triangles: vertex indices of the triangles.
        matrix: transform from object space to world space.
    """

    positions: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    triangles: gpu.types.GPUIndexBuf
    matrix: object


@dataclass(frozen=True)
class OverlayBone:
    """A bone to draw: head and tail in world space, color in RGBA."""

    head: tuple[float, float, float]
    tail: tuple[float, float, float]
    color: tuple[float, float, float, float]


class Overlay:
    """Draws over all viewports from `start` to `stop`, and owns the draw handlers and the GPU resources.

    A subclass returns what is drawn; its methods are called at each redraw.
    """

    def __init__(self) -> None:
        self._draw_handles: list[object] = []
        self._shader: gpu.types.GPUShader | None = None
        # Key of the mesh (`_triangles_of`) and its triangles, by the session id of the mesh object.
        self._triangles: dict[int, tuple[tuple[int, int, int], gpu.types.GPUIndexBuf]] = {}

    def meshes(self, context: bpy.types.Context) -> list[OverlayMesh]:
        """Return the meshes to draw."""
        raise NotImplementedError

    def bones(self, context: bpy.types.Context) -> list[OverlayBone]:
        """Return the bones to draw over the meshes."""
        raise NotImplementedError

    def legend(self, context: bpy.types.Context) -> tuple[list[str], float | None]:
        """Return the lines of the legend, and the range of a heat map in mm or None."""
        raise NotImplementedError

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

    def overlay_mesh(
        self, context: bpy.types.Context, mesh_object: bpy.types.Object, colors: np.ndarray
    ) -> OverlayMesh | None:
        """Create the overlay of an evaluated mesh; return None in edit mode, or if modifiers change the topology.

        Args:
            context: the context with the dependency graph.
            colors: (V, 3) float32, sRGB.
        """
        evaluated = mesh_object.evaluated_get(context.evaluated_depsgraph_get())
        mesh = evaluated.data
        if evaluated.mode == "EDIT":
            # Edits such as Rotate Edge change the triangles, but not the counts that identify the mesh.
            self._triangles.pop(mesh_object.session_uid, None)
            return None
        if len(mesh.vertices) != len(colors):
            return None
        positions, normals = mesh_positions(mesh), read(mesh.vertex_normals, VECTOR_ELEMENT)
        triangles = self._triangles_of(mesh_object, mesh)
        return OverlayMesh(positions, normals, colors, triangles, evaluated.matrix_world.copy())

    def _triangles_of(self, mesh_object: bpy.types.Object, mesh: bpy.types.Mesh) -> gpu.types.GPUIndexBuf:
        """Return the triangles of an evaluated mesh, stored because computing them takes longer than drawing them."""
        mesh_key = (mesh_object.data.session_uid, len(mesh.vertices), len(mesh.loops))
        stored = self._triangles.get(mesh_object.session_uid)
        if stored is None or stored[0] != mesh_key:
            mesh.calc_loop_triangles()
            triangles = gpu.types.GPUIndexBuf(type="TRIS", seq=read(mesh.loop_triangles, TRIANGLE_ELEMENT))
            stored = self._triangles[mesh_object.session_uid] = mesh_key, triangles
        return stored[1]

    def _draw_view(self) -> None:
        context = bpy.context
        shader, region_view = self._mesh_shader(), context.region_data
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.depth_mask_set(True)
        try:
            for mesh in self.meshes(context):
                attributes = {"position": mesh.positions, "normal": mesh.normals, "color": mesh.colors}
                # Blender 5.2 does not derive the format from the shader.
                vertex_format = gpu.types.GPUVertFormat()
                for name in attributes:
                    vertex_format.attr_add(id=name, comp_type="F32", len=3, fetch_mode="FLOAT")
                vertices = gpu.types.GPUVertBuf(vertex_format, len(mesh.positions))
                for name, values in attributes.items():
                    vertices.attr_fill(name, values)
                batch = gpu.types.GPUBatch(type="TRIS", buf=vertices, elem=mesh.triangles)
                shader.bind()
                shader.uniform_float("transform", region_view.perspective_matrix @ mesh.matrix)
                towards_viewer = (region_view.view_matrix @ mesh.matrix).to_3x3().inverted_safe().col[2].normalized()
                shader.uniform_float("towards", towards_viewer)
                shader.uniform_float("offset", DEPTH_OFFSET)
                batch.draw(shader)
        finally:
            gpu.state.depth_mask_set(False)
            gpu.state.depth_test_set("NONE")
        bones = self.bones(context)
        if not bones:
            return
        shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
        shader.uniform_float("viewportSize", (context.region.width, context.region.height))
        for color in {bone.color for bone in bones}:
            line_ends = [line_end for bone in bones if bone.color == color for line_end in (bone.head, bone.tail)]
            # A wider dark line below each bone outlines it.
            for width, line_color in ((BONE_WIDTH_PIXELS + 2, (0, 0, 0, 0.6)), (BONE_WIDTH_PIXELS, color)):
                shader.uniform_float("lineWidth", width * context.preferences.system.ui_scale)
                shader.uniform_float("color", line_color)
                batch_for_shader(shader, "LINES", {"pos": line_ends}).draw(shader)

    def _draw_legend(self) -> None:
        lines, range_mm = self.legend(bpy.context)
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


def _draw_text(text: str, x: float, y: float) -> None:
    blf.color(0, 1, 1, 1, 1)
    blf.position(0, round(x), round(y), 0)
    blf.draw(0, text)
