# SPDX-License-Identifier: GPL-3.0-or-later
"""The true rig shown together with what plays: beside it, or over it as a wireframe.

It is a copy of the mesh object without the model, which shares its mesh and follows the same armature. The copy is
runtime data: no file ever has it. It is in the scene, so that Blender evaluates it, and undo takes it back; it cannot
be selected, and renders leave it out.
"""

import bpy
from bpy.app.handlers import persistent
from mathutils import Vector

from ..scene.comparison import COMPARISON_KEY, comparisons
from ..scene.draw_cache import draw_cached

BESIDE, OVERLAY, NONE = "BESIDE", "OVERLAY", "NONE"
GAP = 1.15
"""From one to the other, in widths of the character."""

_object_count = -1


def find(mesh_object: bpy.types.Object) -> bpy.types.Object | None:
    """The copy that stands beside a mesh object, None where there is none."""
    return next((other for other in comparisons() if other[COMPARISON_KEY] == mesh_object), None)


@draw_cached
def display_mode(mesh_object: bpy.types.Object) -> str:
    """How a mesh object is compared: `BESIDE`, `OVERLAY` or `NONE`."""
    other = find(mesh_object)
    if other is None:
        return NONE
    return OVERLAY if other.display_type == "WIRE" else BESIDE


def show(mesh_object: bpy.types.Object, way: str, distance: float = 0.0) -> None:
    """Show the rig of a bound mesh object together with it.

    Args:
        mesh_object: bound.
        way: `BESIDE`, `OVERLAY`, or `NONE` to show it no more.
        distance: to the side, along X of the world, in its units; 0 for the width of the character and a little.
    """
    from ..runtime.binding import unbind

    hide(mesh_object)
    if way == NONE:
        return
    # Local, for of a library override no modifier could be removed.
    other = mesh_object.copy().make_local()
    other.is_runtime_data = True
    unbind(other)
    other.fdda.models.clear()
    other[COMPARISON_KEY] = mesh_object
    other.name = f"{mesh_object.name} rig, to compare"
    other.hide_select = other.hide_render = True
    bpy.context.scene.collection.objects.link(other)
    if way == OVERLAY:
        other.display_type, other.show_in_front = "WIRE", True
    else:
        _move_aside(other, mesh_object, distance or GAP * _width(mesh_object))


def hide(mesh_object: bpy.types.Object) -> None:
    """Show the rig of a mesh object no more beside it."""
    _remove(find(mesh_object))


def hide_all() -> None:
    """Remove all copies of the open file."""
    for other in comparisons():
        _remove(other)


def _remove(other: bpy.types.Object | None) -> None:
    if other is not None:
        # The mesh is the user's.
        bpy.data.objects.remove(other)


def _width(mesh_object: bpy.types.Object) -> float:
    """Of what is shown, along X of the world."""
    shown = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    places = [(shown.matrix_world @ Vector(corner)).x for corner in shown.bound_box]
    return max(places) - min(places)


def _move_aside(other: bpy.types.Object, mesh_object: bpy.types.Object, distance: float) -> None:
    """Show an object to the side. Moved itself, it would not fit its bones any more; so its vertices are, at last."""
    aside = mesh_object.matrix_world.to_3x3().inverted_safe() @ Vector((distance, 0, 0))
    for axis, part in zip("XYZ", aside, strict=True):
        if abs(part) > 1e-6 * aside.length:
            modifier = other.modifiers.new(f"Aside {axis}", "DISPLACE")
            modifier.direction, modifier.space, modifier.mid_level, modifier.strength = axis, "LOCAL", 0.0, part


@persistent
def _on_changed(*_: object) -> None:
    """Remove the copies of what was deleted or unbound."""
    global _object_count
    if _object_count == len(bpy.data.objects):
        return
    for other in comparisons():
        compared = other[COMPARISON_KEY]
        if compared is None or not compared.users_scene:
            _remove(other)
    _object_count = len(bpy.data.objects)


HANDLERS = {"depsgraph_update_post": _on_changed}
