# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that mend what the section "Rig" finds before a recording."""

import bpy

from ..core.checks.seams import POSITION_DIGITS, split_vertex_groups
from ..core.errors import RigError
from ..core.wording import format_count
from ..poses.motion_range import unlimited_bones
from ..rig.reading import read_rig
from ..scene.arrays import VECTOR_ELEMENT, read, write
from .poses import select_bones
from .rig_operator import RigOperator


class FDDA_OT_merge_vertices(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.merge_vertices"
    bl_label = "Merge by Distance"
    bl_description = (
        "Merge the vertices along cuts that lie on each other, as importers of game formats leave them. Normals and UV "
        "maps stay, and cuts that skin weights or shape keys open"
    )
    waits_for_all_jobs = True
    modes = frozenset({"OBJECT", "POSE"})

    def apply(self, context: bpy.types.Context) -> str:
        import bmesh  # bpy brings it, so it is there after bpy has loaded.

        mesh_object = self.rig(context).mesh_object
        mesh = mesh_object.data
        if mesh_object.fdda.is_bound or mesh.library or mesh_object.library:
            raise RigError(f"'{mesh_object.name}' has a model or is linked; unbind it, or merge in its own file.")
        rig = read_rig(self.rig(context))
        # A layer keeps the normal of each corner, also where faces collapse.
        layer = mesh.attributes.new("fdda_normals", "FLOAT_VECTOR", "CORNER")
        write(layer.data, VECTOR_ELEMENT, read(mesh.corner_normals, VECTOR_ELEMENT))
        # Equal rounded positions may differ by the diagonal of a cube.
        layer_name, distance = layer.name, 2 * rig.size * 10.0**-POSITION_DIGITS
        targets, apart_count = {}, 0
        edited = bmesh.new()
        try:
            edited.from_mesh(mesh)
            edited.verts.ensure_lookup_table()
            keys = edited.verts.layers.shape.values()
            for group in split_vertex_groups(rig):
                kept = []
                for vertex in (edited.verts[i] for i in group):
                    same = (v for v in kept if all((v[key] - vertex[key]).length <= distance for key in keys))
                    if (target := next(same, None)) is not None:
                        targets[vertex] = target
                    else:
                        kept.append(vertex)
                apart_count += len(kept) - 1
            bmesh.ops.weld_verts(edited, targetmap=targets)
            edited.to_mesh(mesh)
        finally:
            edited.free()
            layer = mesh.attributes[layer_name]
            normals = read(layer.data, VECTOR_ELEMENT)
            mesh.attributes.remove(layer)
        mesh.normals_split_custom_set(normals)
        mesh.update()
        message = f"Merged {format_count(len(targets), 'vertex', 'vertices')} of '{mesh_object.name}'."
        return f"{message} Shape keys move {apart_count:,} apart, which stay." if apart_count else message


class FDDA_OT_fit_base_skinning(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.fit_base_skinning"
    bl_label = "Fit Base Skinning"
    bl_description = "Let the training fit skin weights to the recorded poses, with at most four bones per vertex"

    def apply(self, context: bpy.types.Context) -> str:
        self.rig(context).mesh_object.fdda.settings.base_skinning = "SMOOTH"
        return "The training fits skin weights."


class FDDA_OT_select_unlimited(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.select_unlimited"
    bl_label = "Select These"
    bl_description = (
        "Select the bones without rotation limits in Pose Mode, to set limits in the section Training Poses"
    )

    def apply(self, context: bpy.types.Context) -> str:
        rig = self.rig(context)
        names = set(unlimited_bones(rig.armature_object, read_rig(rig)))
        select_bones(context, rig, names)
        return f"Selected {format_count(len(names), 'bone')}."


CLASSES = (FDDA_OT_merge_vertices, FDDA_OT_fit_base_skinning, FDDA_OT_select_unlimited)
