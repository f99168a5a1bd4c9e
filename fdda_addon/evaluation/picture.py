# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders pictures of labeled meshes in rows and columns, with Workbench, in a separate scene.

Blender also renders the labels and the color scale, so a picture needs neither a window nor another library.
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
from ..core.files.output import atomic_write
from ..core.mathematics.metrics import HEAT_MAP_STOPS, NO_ERROR_COLOR, NO_ERROR_METRES, heat_colors
from ..scene.arrays import COLOR_ELEMENT, LOOP_START_ELEMENT, VERTEX_INDEX_ELEMENT, write
from ..scene.blend_file import blender_path, silenced_stdout
from ..scene.mesh import mesh_positions, set_mesh_positions, topology

WIDTH_PIXELS = 1440
CELL_MARGIN_RATIO = 0.06
"""Space between cells, relative to the width of a cell."""
TEXT_SIZE_RATIO = 0.0145
"""Height of a line of text, relative to the width of the picture."""
MIN_CELL_ASPECT = 0.5
"""Smallest ratio of width and height of a cell."""
BACKGROUND_COLOR = (0.13, 0.14, 0.15)
TEXT_COLOR = (0.92, 0.92, 0.92)
PNG_END = b"IEND\xae\x42\x60\x82"
"""Last bytes of a complete PNG file."""


@dataclass(frozen=True)
class Cell:
    """One mesh in a picture.

    Attributes:
        positions: (V, 3) float32, mesh-object space, mesh units.
        colors: (V, 3) float32, sRGB.
        label: a line of text above the mesh.
    """

    positions: np.ndarray
    colors: np.ndarray
    label: str


@dataclass(frozen=True)
class View:
    """The view direction of a picture.

    Attributes:
        azimuth, elevation: angles in degrees. If both are 0, the viewer looks along +Y at the front of a character.
            With a positive azimuth, the viewer is on the character's left.
    """

    azimuth: float = 25.0
    elevation: float = 20.0

    @classmethod
    def from_direction(cls, towards_viewer: np.ndarray) -> "View":
        """Return the view of a viewer in a direction, (3,) in world space; the vertical stays upright."""
        x, y, z = (float(value) for value in towards_viewer / np.linalg.norm(towards_viewer))
        return cls(math.degrees(math.atan2(x, -y)), math.degrees(math.asin(z)))

    def axes(self) -> np.ndarray:
        """Return the directions to the right, up and towards the viewer as rows, (3, 3) float64, world space."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        towards_viewer = np.array(
            [math.sin(azimuth) * math.cos(elevation), -math.cos(azimuth) * math.cos(elevation), math.sin(elevation)]
        )
        right = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        return np.stack([right, np.cross(towards_viewer, right), towards_viewer])


def draw(
    mesh_object: bpy.types.Object,
    rows: list[list[Cell]],
    path: Path,
    title: str,
    view: View,
    has_heat_scale: bool = False,
    is_sculpted: bool = False,
) -> None:
    """Render deformations of one mesh into a PNG file.

    Args:
        mesh_object: the object with the faces; the picture shows it upright as it stands in the world.
        rows: the cells, row by row, as many in each.
        path: path of the file.
        title: a line of text above all cells.
        has_heat_scale: whether to add the color scale of the heat map at the bottom.
        is_sculpted: whether to light the meshes so that their shape shows best, instead of their colors.
    """
    check_can_render()
    picture = Picture(view, mesh_object)
    try:
        cells = [cell for row in rows for cell in row]
        projections = [cell.positions @ picture.projection.T for cell in cells]
        cell_size = np.max([np.ptp(projected[:, :2], axis=0) for projected in projections], axis=0)
        max_error = HEAT_MAP_STOPS[-1][0] if has_heat_scale else None
        places = picture.add_cells(mesh_object.data, cell_size, (len(rows), len(rows[0])), max_error)
        picture.title.body = title
        for cell, projected, (mesh, label) in zip(cells, projections, places, strict=True):
            label.body = cell.label
            centered = projected - (projected.max(axis=0) + projected.min(axis=0)) / 2
            set_mesh_positions(mesh, np.ascontiguousarray(centered, np.float32))
            set_colors(mesh, cell.colors)
            mesh.update()
        picture.set_up_render(is_sculpted)
        with atomic_write(path) as temporary_path:
            picture.render(temporary_path)
    finally:
        picture.remove()


def check_can_render() -> None:
    """Check for the library EGL: without it, a render without a window ends the process and raises no error.

    Raises:
        OutputError: the library is missing.
    """
    if bpy.app.background and sys.platform == "linux" and ctypes.util.find_library("EGL") is None:
        raise OutputError("Pictures need the library EGL; install the package libegl1.")


class Picture:
    """The scene of a picture. Positions in it are relative to the camera: x to the right, y up, in sizes of the
    undeformed mesh.

    Attributes:
        projection: (3, 3) float64, takes positions in mesh-object space to the directions of the view (`View.axes`).
            The undeformed mesh has size 1.
        scene: the scene.
        width, height: size of the picture.
        title: the line of text above all cells.
    """

    def __init__(self, view: View, mesh_object: bpy.types.Object):
        axes = view.axes()
        # Importers turn and scale objects: without their matrix a character may lie on its back.
        self.projection = axes @ np.array(mesh_object.matrix_world.to_3x3())
        # Shading depends on distances, so all characters get the same size.
        self.projection /= max(np.ptp(mesh_positions(mesh_object.data) @ self.projection.T, axis=0).max(), 1e-12)
        self._view_to_world = Matrix(axes.tolist()).transposed().to_4x4()
        self.scene = bpy.data.scenes.new("FDDA picture")
        self._datablocks: list[bpy.types.ID] = []
        self.width = self.height = 0.0

    def add_cells(
        self,
        mesh: bpy.types.Mesh,
        cell_size: np.ndarray,
        shape: tuple[int, int],
        max_error: float | None = None,
        label_lines: int = 1,
        text_ratio: float = TEXT_SIZE_RATIO,
    ) -> list[tuple[bpy.types.Mesh, bpy.types.TextCurve]]:
        """Lay out empty cells from the top left, below the title and above the color scale of the heat map.

        Args:
            mesh: the mesh with the faces.
            cell_size: (2,) width and height of the largest projected mesh.
            shape: number of rows and columns.
            max_error: error in meters with the last color of the scale; None for no scale.
            label_lines: number of lines of a label.
            text_ratio: height of a line of text, relative to the width of the picture.

        Returns:
            The mesh of each cell, around the origin and without positions and colors, and its label above it.
        """
        gap = cell_size[0] * CELL_MARGIN_RATIO
        # A tall character gets wider margins, so that texts fit above it.
        column_width = max(cell_size[0] + gap, cell_size[1] * MIN_CELL_ASPECT)
        self.width = shape[1] * column_width + gap
        size = self.width * text_ratio
        row_height = cell_size[1] + (2.2 + label_lines) * size
        self.title = self.add_text("", (gap, -2.0 * size), 1.3 * size)
        cells, bottom = [], 3.2 * size
        for _ in range(shape[0]):
            for column in range(shape[1]):
                left = gap + column * column_width
                label = self.add_text("", (left, -(bottom + 1.4 * size)), size)
                cell_mesh = _copy_faces(mesh)
                middle = bottom + (1.4 + label_lines) * size + cell_size[1] / 2
                self.move(self.add_object("cell", cell_mesh), left + (column_width - gap) / 2, -middle)
                cells.append((cell_mesh, label))
            bottom += row_height
        if max_error is not None:
            # A box for no error, and a strip from the first to the last color.
            y = -(bottom + size)
            colors = heat_colors(np.linspace(HEAT_MAP_STOPS[0][0], HEAT_MAP_STOPS[-1][0], 64))
            self.add_strip((gap, y), (size, size), np.array([NO_ERROR_COLOR, NO_ERROR_COLOR]))
            self.add_text(f"below {NO_ERROR_METRES * 1000:g} mm", (gap + 1.5 * size, y), 0.9 * size)
            self.add_strip((gap + 12 * size, y), (16 * size, size), colors)
            self.add_text(f"{max_error * 1000:g} mm and above", (gap + 28.5 * size, y), 0.9 * size)
            bottom += 2.6 * size
        self.height = bottom + gap
        return cells

    def move(self, scene_object: bpy.types.Object, x: float, y: float, depth: float = 0.0) -> None:
        """Move an object to a position relative to the camera."""
        scene_object.matrix_world = self._view_to_world @ Matrix.Translation((x, y, depth))

    def add_object(self, name: str, data: bpy.types.ID | None) -> bpy.types.Object:
        """Add an object with data that belongs to the picture."""
        scene_object = bpy.data.objects.new(name, data)
        self.scene.collection.objects.link(scene_object)
        self._datablocks += [scene_object, *([data] if data is not None else [])]
        return scene_object

    def add_text(self, text: str, position: tuple[float, float], size: float) -> bpy.types.TextCurve:
        """Add a line of text at the position of its left end, with its height; return its curve."""
        curve = bpy.data.curves.new("text", "FONT")
        curve.body, curve.size = text, size
        scene_object = self.add_object("text", curve)
        scene_object.color = (*srgb_to_linear(TEXT_COLOR), 1)
        self.move(scene_object, *position)
        return curve

    def add_strip(self, position: tuple[float, float], size: tuple[float, float], colors: np.ndarray) -> None:
        """Add a rectangle at the position of its lower left corner, with (N, 3) sRGB colors from left to right."""
        x_values = np.linspace(0, size[0], len(colors))
        points = [(x, y, 0) for x in x_values for y in (0, size[1])]
        faces = [(2 * i, 2 * i + 2, 2 * i + 3, 2 * i + 1) for i in range(len(colors) - 1)]
        mesh = bpy.data.meshes.new("scale")
        mesh.from_pydata(points, [], faces)
        set_colors(mesh, np.repeat(colors, 2, axis=0))
        self.move(self.add_object("scale", mesh), *position)

    def set_up_render(self, is_sculpted: bool, width_pixels: int = WIDTH_PIXELS, antialiasing: str = "8") -> None:
        """Add the camera, and set up the render. Width and height in pixels become even, as videos need them.

        Args:
            is_sculpted: as for `draw`.
            width_pixels: width of the picture.
            antialiasing: Blender's name of an antialiasing method of Workbench.
        """
        scene = self.scene
        camera = self.add_object("camera", bpy.data.cameras.new("camera"))
        camera.data.type = "ORTHO"
        camera.data.ortho_scale = max(self.width, self.height)
        self.move(camera, self.width / 2, -self.height / 2, 100.0)
        camera.data.clip_end = 1000.0
        scene.camera = camera
        scene.render.resolution_x = width_pixels // 2 * 2
        scene.render.resolution_y = round(width_pixels * self.height / self.width) // 2 * 2
        scene.render.engine = "BLENDER_WORKBENCH"
        scene.render.image_settings.file_format = "PNG"
        scene.render.image_settings.color_mode = "RGB"
        scene.render.image_settings.compression = 90
        # Dithering adds noise, which makes the file larger.
        scene.render.dither_intensity = 0
        scene.render.use_file_extension = False
        # Metadata would reveal file paths and names of the user.
        property_names = [render_property.identifier for render_property in scene.render.bl_rna.properties]
        for name in [name for name in property_names if name.startswith("use_stamp_")]:
            setattr(scene.render, name, False)
        scene.render.film_transparent = False
        scene.view_settings.view_transform = "Standard"
        scene.display.render_aa = antialiasing
        shading = scene.display.shading
        shading.light, shading.color_type = "STUDIO", "VERTEX"
        shading.studio_light = "Default" if is_sculpted else "paint.sl"
        shading.show_specular_highlight = is_sculpted
        shading.show_cavity = True
        shading.cavity_type = "WORLD"
        shading.cavity_ridge_factor = 0.6
        shading.cavity_valley_factor = 1.0
        world = bpy.data.worlds.new("picture")
        world.color = srgb_to_linear(BACKGROUND_COLOR)
        scene.world = world
        self._datablocks.append(world)

    def render(self, path: Path) -> None:
        """Write the PNG file.

        Raises:
            OSError: the file is not complete.
        """
        self.scene.render.filepath = blender_path(path)
        try:
            with silenced_stdout():
                bpy.ops.render.render(write_still=True, scene=self.scene.name)
        except RuntimeError as error:
            raise OSError(str(error).strip()) from error
        # Blender does not check whether the whole file reached the disk.
        if not (path.exists() and path.read_bytes().endswith(PNG_END)):
            raise OSError("Blender wrote no picture or only a part of it, the disk may be full")

    def remove(self) -> None:
        """Remove all datablocks of the picture from the file."""
        bpy.data.batch_remove([*self._datablocks, self.scene])


def _copy_faces(mesh: bpy.types.Mesh) -> bpy.types.Mesh:
    """Create a mesh with the vertices and faces of another, at the origin."""
    loop_starts, loop_vertices = topology(mesh)
    copied = bpy.data.meshes.new("cell")
    copied.vertices.add(len(mesh.vertices))
    copied.loops.add(len(loop_vertices))
    copied.polygons.add(len(loop_starts))
    write(copied.loops, VERTEX_INDEX_ELEMENT, loop_vertices)
    write(copied.polygons, LOOP_START_ELEMENT, loop_starts)
    copied.update(calc_edges=True)
    copied.shade_smooth()
    return copied


def set_colors(mesh: bpy.types.Mesh, colors: np.ndarray) -> None:
    """Set the colors of the vertices, (V, 3) sRGB."""
    attribute = mesh.color_attributes.get("color") or mesh.color_attributes.new("color", "FLOAT_COLOR", "POINT")
    rgba = np.ones((len(colors), 4), np.float32)
    rgba[:, :3] = srgb_to_linear(colors)
    write(attribute.data, COLOR_ELEMENT, rgba)
    mesh.color_attributes.active_color = attribute


def srgb_to_linear(srgb: object) -> np.ndarray:
    """Convert sRGB to linear colors (IEC 61966-2-1)."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
