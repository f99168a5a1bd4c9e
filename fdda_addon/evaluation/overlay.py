# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws meshes with a color for each vertex, and a legend, over the 3D viewports."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..core.metrics import NO_ERROR_COLOR, NO_ERROR_METRES, heat_colors
from ..scene.arrays import TRIANGLE, VECTOR, read
from ..scene.mesh import mesh_positions

TOWARDS_VIEWER = 2e-5
"""How far the colors lie before the mesh, in depth: enough to cover it, too little to show through another."""
STICK_PIXELS = 3
VERTEX = """
void main()
{
  shade = 0.25 + 0.75 * abs(dot(normalize(normal), towards));
  paint = color;
  gl_Position = transform * vec4(position, 1.0);
  gl_Position.z -= offset * gl_Position.w;
}
"""
FRAGMENT = """
void main()
{
  vec3 linear = mix(paint / 12.92, pow((paint + 0.055) / 1.055, vec3(2.4)), step(0.04045, paint));
  outcome = vec4(linear * shade, 1.0);
}
"""

_handles: list[object] = []
_shader: gpu.types.GPUShader | None = None
_triangles: dict[int, tuple[tuple[int, int], gpu.types.GPUIndexBuf]] = {}


@dataclass(frozen=True)
class OverlayMesh:
    """A mesh: (V, 3) float32 positions and normals in its own space, sRGB colors, triangles, and its matrix_world."""

    positions: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    triangles: gpu.types.GPUIndexBuf
    matrix: object


@dataclass(frozen=True)
class OverlayBone:
    """A bone: its ends in world space, and its color, RGBA."""

    head: tuple[float, float, float]
    tail: tuple[float, float, float]
    color: tuple[float, float, float, float]


def start(
    sheets: Callable[[bpy.types.Context], list[OverlayMesh]],
    legend: Callable[[bpy.types.Context], tuple[list[str], float | None]],
    sticks: Callable[[bpy.types.Context], list[OverlayBone]],
) -> None:
    """Draw from now on, in all viewports.

    Args:
        sheets: gives the meshes, asked at every redraw.
        legend: gives lines of text and the range of a heat map in mm, None for no scale.
        sticks: gives the bones that are to be seen over the meshes.
    """
    if not _handles:
        add = bpy.types.SpaceView3D.draw_handler_add
        _handles.append(add(_draw_sheets, (sheets, sticks), "WINDOW", "POST_VIEW"))
        _handles.append(add(_draw_legend, (legend,), "WINDOW", "POST_PIXEL"))


def stop() -> None:
    """Draw no more, and let go of what the graphics card holds: it must not outlive its context."""
    global _shader
    _shader = None
    while _handles:
        bpy.types.SpaceView3D.draw_handler_remove(_handles.pop(), "WINDOW")
    _triangles.clear()


def sheet(context: bpy.types.Context, mesh_object: bpy.types.Object, colors: np.ndarray) -> OverlayMesh | None:
    """What Blender shows of an object, with other colors; None when its modifiers change the topology."""
    evaluated = mesh_object.evaluated_get(context.evaluated_depsgraph_get())
    mesh = evaluated.data
    if evaluated.mode == "EDIT" or len(mesh.vertices) != len(colors):
        return None
    positions, normals = mesh_positions(mesh), read(mesh.vertex_normals, VECTOR)
    return OverlayMesh(positions, normals, colors, _triangles_of(mesh_object, mesh), evaluated.matrix_world.copy())


def _triangles_of(mesh_object: bpy.types.Object, mesh: bpy.types.Mesh) -> gpu.types.GPUIndexBuf:
    """The triangles; kept as long as the counts stay: finding them anew costs more than drawing them."""
    key = (len(mesh.vertices), len(mesh.loops))
    kept = _triangles.get(mesh_object.session_uid)
    if kept is None or kept[0] != key:
        mesh.calc_loop_triangles()
        triangles = read(mesh.loop_triangles, TRIANGLE)
        kept = _triangles[mesh_object.session_uid] = (key, gpu.types.GPUIndexBuf(type="TRIS", seq=triangles))
    return kept[1]


def _draw_sheets(
    sheets: Callable[[bpy.types.Context], list[OverlayMesh]], sticks: Callable[[bpy.types.Context], list[OverlayBone]]
) -> None:
    context = bpy.context
    shader, view = _mesh_shader(), context.region_data
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(True)
    try:
        for drawn in sheets(context):
            content = {"position": drawn.positions, "normal": drawn.normals, "color": drawn.colors}
            vertices = gpu.types.GPUVertBuf(_vertex_format(content), len(drawn.positions))
            for name, values in content.items():
                vertices.attr_fill(name, values)
            batch = gpu.types.GPUBatch(type="TRIS", buf=vertices, elem=drawn.triangles)
            shader.bind()
            shader.uniform_float("transform", view.perspective_matrix @ drawn.matrix)
            towards = (view.view_matrix @ drawn.matrix).to_3x3().inverted_safe().col[2].normalized()
            shader.uniform_float("towards", towards)
            shader.uniform_float("offset", TOWARDS_VIEWER)
            batch.draw(shader)
    finally:
        gpu.state.depth_mask_set(False)
        gpu.state.depth_test_set("NONE")
    _draw_sticks(context, sticks(context))


def _draw_sticks(context: bpy.types.Context, sticks: list[OverlayBone]) -> None:
    if not sticks:
        return
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.uniform_float("viewportSize", (context.region.width, context.region.height))
    for color in {stick.color for stick in sticks}:
        ends = [end for stick in sticks if stick.color == color for end in (stick.head, stick.tail)]
        for width, shown in ((STICK_PIXELS + 2, (0, 0, 0, 0.6)), (STICK_PIXELS, color)):
            shader.uniform_float("lineWidth", width * context.preferences.system.ui_scale)
            shader.uniform_float("color", shown)
            batch_for_shader(shader, "LINES", {"pos": ends}).draw(shader)


def _vertex_format(names: Iterable[str]) -> gpu.types.GPUVertFormat:
    """Three floats for each name; stated here, as what a shader says of its inputs lacks them in Blender 5.2."""
    made = gpu.types.GPUVertFormat()
    for name in names:
        made.attr_add(id=name, comp_type="F32", len=3, fetch_mode="FLOAT")
    return made


def _mesh_shader() -> gpu.types.GPUShader:
    global _shader
    if _shader is None:
        info = gpu.types.GPUShaderCreateInfo()
        info.push_constant("MAT4", "transform")
        info.push_constant("VEC3", "towards")
        info.push_constant("FLOAT", "offset")
        for place, name in enumerate(("position", "normal", "color")):
            info.vertex_in(place, "VEC3", name)
        between = gpu.types.GPUStageInterfaceInfo("fdda_between")
        between.smooth("VEC3", "paint")
        between.smooth("FLOAT", "shade")
        info.vertex_out(between)
        info.fragment_out(0, "VEC4", "outcome")
        info.vertex_source(VERTEX)
        info.fragment_source(FRAGMENT)
        _shader = gpu.shader.create_from_info(info)
    return _shader


def _draw_legend(legend: Callable[[bpy.types.Context], tuple[list[str], float | None]]) -> None:
    context = bpy.context
    lines, range_mm = legend(context)
    if not lines:
        return
    unit = context.preferences.system.ui_scale
    regions = [r for r in context.area.regions if r.width > 1]
    left = 24 * unit + sum(r.width for r in regions if r.type == "TOOLS")
    # Above what Blender offers there to adjust the last operation.
    bottom = 30 * unit + sum(r.height for r in regions if r.type == "HUD")
    blf.size(0, 12 * unit)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 5, 0, 0, 0, 0.9)
    if range_mm is not None:
        _draw_scale(left, bottom, unit, range_mm)
        bottom += 46 * unit
    for line in reversed(lines):
        _write(line, left, bottom)
        bottom += 18 * unit
    blf.disable(0, blf.SHADOW)


def _draw_scale(left: float, bottom: float, unit: float, range_mm: float) -> None:
    box, width = 14 * unit, 240 * unit
    top = bottom + 18 * unit
    _draw_strip(left, top, box, box, np.tile(np.float32(NO_ERROR_COLOR), (2, 1)))
    _write("none", left - 2 * unit, bottom)
    start = left + 44 * unit
    _draw_strip(start, top, width, box, heat_colors(np.linspace(NO_ERROR_METRES, range_mm / 1000, 64), range_mm / 1000))
    for part, words in ((0, "0"), (0.5, f"{range_mm / 2:.4g}"), (1, f"{range_mm:.4g} mm and more")):
        across = blf.dimensions(0, words.split(" ")[0])[0] / 2
        _write(words, start + part * width - across, bottom)


def _draw_strip(left: float, bottom: float, width: float, height: float, colors: np.ndarray) -> None:
    across = left + width * np.linspace(0, 1, len(colors))
    corners = [(x, y) for x in across for y in (bottom, bottom + height)]
    rgba = [(*color, 1.0) for color in colors.tolist() for _ in range(2)]
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    batch = batch_for_shader(shader, "TRI_STRIP", {"pos": corners, "color": rgba})
    batch.draw(shader)


def _write(text: str, x: float, y: float) -> None:
    blf.color(0, 1, 1, 1, 1)
    blf.position(0, round(x), round(y), 0)
    blf.draw(0, text)
