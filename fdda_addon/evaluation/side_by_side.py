# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows the rig of a playing character beside it, or over it as a wireframe.

The rig is shown by a comparison object: a copy of the mesh object without the model, with the same mesh and armature.
The copy is runtime data, so it is never saved. It is linked to the scene, so that Blender evaluates it and undo
includes it. It cannot be selected, and renders do not show it.
"""

import bpy
from bpy.app.handlers import persistent
from mathutils import Vector

from ..runtime.binding import unbind
from ..scene.comparison import COMPARISON_KEY, comparison_objects
from ..scene.draw_cache import draw_cached

BESIDE, OVERLAY, NONE = "BESIDE", "OVERLAY", "NONE"
"""Display modes of the rig: beside the character, over it as a wireframe, or hidden."""
DISTANCE_IN_WIDTHS = 1.15
"""Default distance between character and copy, in widths of the character."""


def find(mesh_object: bpy.types.Object) -> bpy.types.Object | None:
    """Find the comparison object of a mesh object; return None if there is none."""
    return next(
        (
            comparison_object
            for comparison_object in comparison_objects()
            if comparison_object[COMPARISON_KEY] == mesh_object
        ),
        None,
    )


@draw_cached
def display_mode(mesh_object: bpy.types.Object) -> str:
    """Return how the rig of a mesh object is shown: `BESIDE`, `OVERLAY` or `NONE`."""
    comparison_object = find(mesh_object)
    if comparison_object is None:
        return NONE
    return OVERLAY if comparison_object.display_type == "WIRE" else BESIDE


def show(mesh_object: bpy.types.Object, mode: str, distance: float = 0.0) -> None:
    """Show the rig of a bound mesh object.

    Args:
        mode: `BESIDE`, `OVERLAY`, or `NONE` to hide the rig.
        distance: distance of `BESIDE` along the X axis of the world, Blender units; 0 for the default.
    """
    hide(mesh_object)
    if mode == NONE:
        return
    # Make the copy local, because modifiers of a library override cannot be removed.
    comparison_object = mesh_object.copy().make_local()
    comparison_object.is_runtime_data = True
    unbind(comparison_object)
    comparison_object.fdda.models.clear()
    comparison_object[COMPARISON_KEY] = mesh_object
    comparison_object.name = f"{mesh_object.name} rig, to compare"
    comparison_object.hide_select = comparison_object.hide_render = True
    bpy.context.scene.collection.objects.link(comparison_object)
    if mode == OVERLAY:
        comparison_object.display_type, comparison_object.show_in_front = "WIRE", True
        return
    if not distance:
        evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
        x_values = [(evaluated.matrix_world @ Vector(corner)).x for corner in evaluated.bound_box]
        distance = DISTANCE_IN_WIDTHS * (max(x_values) - min(x_values))
    # Move it by modifiers, because a transform would change how its armature deforms it.
    offset = mesh_object.matrix_world.to_3x3().inverted_safe() @ Vector((distance, 0, 0))
    for axis, component in zip("XYZ", offset, strict=True):
        if abs(component) > 1e-6 * offset.length:
            modifier = comparison_object.modifiers.new(f"Aside {axis}", "DISPLACE")
            modifier.direction, modifier.space, modifier.mid_level, modifier.strength = axis, "LOCAL", 0.0, component


def hide(mesh_object: bpy.types.Object) -> None:
    """Remove the comparison object of a mesh object, if there is one."""
    _remove(find(mesh_object))


def hide_all() -> None:
    """Remove all comparison objects of the open file."""
    for comparison_object in comparison_objects():
        _remove(comparison_object)


def _remove(comparison_object: bpy.types.Object | None) -> None:
    if comparison_object is not None:
        # Remove only the object, because its mesh belongs to the character.
        bpy.data.objects.remove(comparison_object)


@persistent
def _on_depsgraph_update_post(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Remove the comparison objects whose mesh objects were removed."""
    # Blender reports the scene when an object was added, removed or unlinked.
    if not depsgraph.id_type_updated("SCENE"):
        return
    for comparison_object in comparison_objects():
        compared_object = comparison_object[COMPARISON_KEY]
        if compared_object is None or not compared_object.users_scene:
            _remove(comparison_object)


HANDLERS = {"depsgraph_update_post": _on_depsgraph_update_post}
