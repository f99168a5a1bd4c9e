# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws meshes and words in rows and columns, with Workbench, in a scene of its own.

Everything of a picture, the words and the scale too, is rendered by Blender: it needs no window and no other library.
"""

import ctypes.util
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import OutputError
from ..core.metrics import HEAT_MAP_STOPS, NO_ERROR_COLOR, heat_colors
from ..core.output import atomic_write
from ..scene.arrays import COLOR, LOOP_START, VERTEX_INDEX, write
from ..scene.blend_file import blender_path
from ..scene.mesh import set_mesh_positions, topology

PIXELS_WIDE = 1440
MARGIN = 0.06
"""Space between cells, as a part of a cell's width."""
TEXT_SIZE = 0.0145
"""Height of a line, as a part of the picture's width."""
BACKGROUND = (0.13, 0.14, 0.15)
INK = (0.92, 0.92, 0.92)
PNG_END = b"IEND\xae\x42\x60\x82"


@dataclass(frozen=True)
class Cell:
    """One mesh in a picture.

    Attributes:
        positions: (V, 3) float32, mesh-object space, mesh units.
        colors: (V, 3) float32 sRGB.
        label: a line above it.
    """

    positions: np.ndarray
    colors: np.ndarray
    label: str


@dataclass(frozen=True)
class View:
    """From where a picture is drawn.

    Attributes:
        azimuth, elevation: degrees; 0, 0 looks along +Y, at the front of a character, and a positive azimuth comes
            from the character's left.
    """

    azimuth: float = 25.0
    elevation: float = 20.0

    def axes(self) -> np.ndarray:
        """(3, 3) float64: right, up and towards the viewer, one a row."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        towards = np.array(
            [math.sin(azimuth) * math.cos(elevation), -math.cos(azimuth) * math.cos(elevation), math.sin(elevation)]
        )
        right = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        return np.stack([right, np.cross(towards, right), towards])


def draw(
    mesh: bpy.types.Mesh,
    rows: list[list[Cell]],
    path: Path,
    title: str,
    view: View,
    heat_scale: bool = False,
    sculpted: bool = False,
) -> None:
    """Draw deformations of one mesh as a PNG file.

    Args:
        mesh: whose faces are drawn.
        rows: cells, row by row.
        path: of the file.
        title: a line above all.
        view: from where.
        heat_scale: draw the scale of the heat map below all.
        sculpted: light that shows the shape; else light that shows the colors.

    Raises:
        OutputError: the file cannot be written, or the machine lacks what Workbench needs.
    """
    _check_can_render()
    picture = _Picture(view)
    try:
        picture.compose(mesh, rows, title, heat_scale)
        picture.render(path, sculpted)
    finally:
        picture.remove()


def _check_can_render() -> None:
    """Without EGL a render without a window ends the process, with no error that Python could catch."""
    if bpy.app.background and sys.platform == "linux" and ctypes.util.find_library("EGL") is None:
        raise OutputError("Pictures need the library EGL; install the package libegl1.")


class _Picture:
    """A scene that holds a picture. Its plane is that of the camera: x to the right, y up, metres."""

    def __init__(self, view: View):
        self._axes = view.axes()
        self._turn = Matrix(self._axes.tolist()).transposed().to_4x4()
        self._scene = bpy.data.scenes.new("FDDA picture")
        self._made: list[bpy.types.ID] = []
        self._width = self._height = 0.0

    def compose(self, mesh: bpy.types.Mesh, rows: list[list[Cell]], title: str, heat_scale: bool) -> None:
        """Lay out cells from the top left, the title above and the scale below."""
        flat = [cell.positions @ self._axes.T for row in rows for cell in row]
        size = np.max([np.ptp(projected[:, :2], axis=0) for projected in flat], axis=0)
        columns = max(len(row) for row in rows)
        unit = size[0]
        gap = unit * MARGIN
        self._width = columns * (unit + gap) + gap
        text = self._width * TEXT_SIZE
        step = np.array([unit + gap, size[1] + 3.2 * text])
        self._text(title, (gap, -2.0 * text), 1.3 * text)
        top = 3.2 * text
        template = _Template(mesh)
        for r, row in enumerate(rows):
            for c, cell in enumerate(row):
                left = gap + c * step[0]
                self._text(cell.label, (left, -(top + r * step[1] + 1.4 * text)), text)
                center = (left + size[0] / 2, -(top + r * step[1] + 2.4 * text + size[1] / 2))
                self._cell(template, cell, center)
        bottom = top + len(rows) * step[1]
        if heat_scale:
            self._scale((gap, -(bottom + 1.2 * text)), text)
            bottom += 4.4 * text
        self._height = bottom + gap

    def _place(self, target: bpy.types.Object, x: float, y: float, depth: float = 0.0) -> None:
        target.matrix_world = self._turn @ Matrix.Translation((x, y, depth))

    def _add(self, name: str, data: bpy.types.ID | None) -> bpy.types.Object:
        made = bpy.data.objects.new(name, data)
        self._scene.collection.objects.link(made)
        self._made += [made, *([data] if data is not None else [])]
        return made

    def _cell(self, template: "_Template", cell: Cell, center: tuple[float, float]) -> None:
        projected = (cell.positions @ self._axes.T).astype(np.float32)
        middle = (projected.max(axis=0) + projected.min(axis=0)) / 2
        made = self._add("cell", template.mesh(projected - middle, cell.colors))
        self._place(made, *center)

    def _text(self, words: str, place: tuple[float, float], size: float) -> None:
        curve = bpy.data.curves.new("text", "FONT")
        curve.body, curve.size = words, size
        made = self._add("text", curve)
        made.color = (*_linear(INK), 1)
        self._place(made, *place)

    def _scale(self, place: tuple[float, float], text: float) -> None:
        """The colors of the heat map: a box for no error, a strip from the first to the last stop."""
        x, y = place
        box = 1.2 * text
        self._strip((x, y - box), (box, box), np.array([NO_ERROR_COLOR, NO_ERROR_COLOR]))
        self._text("none (below 0.0001 cm)", (x + 1.5 * box, y - box + 0.2 * text), 0.9 * text)
        left, width = x + 16 * text, self._width * 0.35
        self._strip(
            (left, y - box), (width, box), heat_colors(np.linspace(HEAT_MAP_STOPS[0][0], HEAT_MAP_STOPS[-1][0], 64))
        )
        last = HEAT_MAP_STOPS[-1][0]
        for metres, words in ((0.0, "error 0 cm"), (0.005, "0.5 cm"), (last, "1 cm and above")):
            self._text(words, (left + width * metres / last - 0.6 * text, y - box - 1.2 * text), 0.9 * text)

    def _strip(self, place: tuple[float, float], size: tuple[float, float], colors: np.ndarray) -> None:
        across = np.linspace(0, size[0], len(colors))
        points = [(x, y, 0) for x in across for y in (0, size[1])]
        faces = [(2 * i, 2 * i + 2, 2 * i + 3, 2 * i + 1) for i in range(len(colors) - 1)]
        mesh = bpy.data.meshes.new("scale")
        mesh.from_pydata(points, [], faces)
        _paint(mesh, np.repeat(colors, 2, axis=0))
        self._place(self._add("scale", mesh), *place)

    def render(self, path: Path, sculpted: bool) -> None:
        """Write the PNG file."""
        scene = self._scene
        camera = self._add("camera", bpy.data.cameras.new("camera"))
        camera.data.type = "ORTHO"
        camera.data.ortho_scale = max(self._width, self._height)
        self._place(camera, self._width / 2, -self._height / 2, 100.0)
        camera.data.clip_end = 1000.0
        scene.camera = camera
        scene.render.resolution_x = PIXELS_WIDE
        scene.render.resolution_y = round(PIXELS_WIDE * self._height / self._width)
        scene.render.engine = "BLENDER_WORKBENCH"
        scene.render.image_settings.file_format = "PNG"
        scene.render.image_settings.color_mode = "RGB"
        scene.render.image_settings.compression = 90
        # Dither is noise, and noise is what does not compress.
        scene.render.dither_intensity = 0
        scene.render.use_file_extension = False
        # A picture that is passed on must not say where it was made.
        for name in [p.identifier for p in scene.render.bl_rna.properties if p.identifier.startswith("use_stamp_")]:
            setattr(scene.render, name, False)
        scene.render.film_transparent = False
        scene.view_settings.view_transform = "Standard"
        scene.display.render_aa = "8"
        shading = scene.display.shading
        shading.light, shading.color_type = "STUDIO", "VERTEX"
        shading.studio_light = "Default" if sculpted else "paint.sl"
        shading.show_specular_highlight = sculpted
        shading.show_cavity = True
        shading.cavity_type = "WORLD"
        shading.cavity_ridge_factor = 0.6
        shading.cavity_valley_factor = 1.0
        world = bpy.data.worlds.new("picture")
        world.color = _linear(BACKGROUND)
        scene.world = world
        self._made.append(world)
        with atomic_write(path) as temporary:
            scene.render.filepath = blender_path(temporary)
            try:
                bpy.ops.render.render(write_still=True, scene=scene.name)
            except RuntimeError as error:
                raise OSError(str(error).strip()) from error
            # Blender does not look whether all of it reached the disk.
            if not (temporary.exists() and temporary.read_bytes().endswith(PNG_END)):
                raise OSError("Blender wrote no picture or only a part of it, the disk may be full")

    def remove(self) -> None:
        """Leave nothing of the picture in the file."""
        bpy.data.batch_remove([*self._made, self._scene])


class _Template:
    """Makes meshes of one topology."""

    def __init__(self, mesh: bpy.types.Mesh):
        self._vertices = len(mesh.vertices)
        self._loop_starts, self._loop_vertices = topology(mesh)

    def mesh(self, positions: np.ndarray, colors: np.ndarray) -> bpy.types.Mesh:
        """A mesh with (V, 3) positions and (V, 3) sRGB colors."""
        mesh = bpy.data.meshes.new("cell")
        mesh.vertices.add(self._vertices)
        mesh.loops.add(len(self._loop_vertices))
        mesh.polygons.add(len(self._loop_starts))
        set_mesh_positions(mesh, np.ascontiguousarray(positions, np.float32))
        write(mesh.loops, VERTEX_INDEX, self._loop_vertices)
        write(mesh.polygons, LOOP_START, self._loop_starts)
        mesh.update(calc_edges=True)
        mesh.shade_smooth()
        _paint(mesh, colors)
        return mesh


def _paint(mesh: bpy.types.Mesh, colors: np.ndarray) -> None:
    attribute = mesh.color_attributes.new("color", "FLOAT_COLOR", "POINT")
    rgba = np.ones((len(colors), 4), np.float32)
    rgba[:, :3] = _linear(colors)
    write(attribute.data, COLOR, rgba)
    mesh.color_attributes.active_color = attribute


def _linear(srgb: object) -> np.ndarray:
    """sRGB to linear color (IEC 61966-2-1)."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
