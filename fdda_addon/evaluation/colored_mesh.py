# SPDX-License-Identifier: GPL-3.0-or-later
"""Creates the colored meshes of pictures and films."""

import bpy
import numpy as np

from ..scene.arrays import COLOR_ELEMENT, LOOP_START_ELEMENT, VERTEX_INDEX_ELEMENT, write
from ..scene.mesh import set_mesh_positions, topology


class MeshFactory:
    """Creates meshes with the same topology."""

    def __init__(self, mesh: bpy.types.Mesh):
        self._vertex_count = len(mesh.vertices)
        self._loop_starts, self._loop_vertices = topology(mesh)

    def create(self, positions: np.ndarray, colors: np.ndarray) -> bpy.types.Mesh:
        """Create a mesh with (V, 3) positions and (V, 3) sRGB colors."""
        mesh = bpy.data.meshes.new("cell")
        mesh.vertices.add(self._vertex_count)
        mesh.loops.add(len(self._loop_vertices))
        mesh.polygons.add(len(self._loop_starts))
        set_mesh_positions(mesh, np.ascontiguousarray(positions, np.float32))
        write(mesh.loops, VERTEX_INDEX_ELEMENT, self._loop_vertices)
        write(mesh.polygons, LOOP_START_ELEMENT, self._loop_starts)
        mesh.update(calc_edges=True)
        mesh.shade_smooth()
        set_colors(mesh, colors)
        return mesh


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
