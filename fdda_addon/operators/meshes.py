# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that chooses the mesh that the sidebar shows, and the menu "FDDA".

The menu makes Blender's search (F3) find the operators. It leaves out those that need a button of a panel.
"""

import bpy

from ..core.errors import RigError
from ..jobs.job import redraw
from ..scene.active_rig import cached_active_rig, cached_rigs_together
from ..scene.scene_rig import rigs_of_armature
from .rig_operator import RigOperator

MENU_OPERATORS = (
    ("fdda.add_sample_arm", "fdda.build_model"),
    ("fdda.measure", "fdda.profile_frame", "fdda.merge_vertices", "fdda.fit_base_skinning", "fdda.select_unlimited"),
    ("fdda.rest_pose", "fdda.poses_to_action", "fdda.use_selected_bones"),
    ("fdda.human_limits", "fdda.copy_limits", "fdda.mirror_limits", "fdda.set_limits", "fdda.clear_limits"),
    ("fdda.add_control", "fdda.add_control_bones", "fdda.remove_control"),
    ("fdda.record", "fdda.export_skinning", "fdda.delete_recording"),
    ("fdda.check_trainer", "fdda.train", "fdda.refine", "fdda.create_trainer_environment"),
    ("fdda.bind", "fdda.set_mode", "fdda.bake", "fdda.fast_rig", "fdda.relink", "fdda.unbind"),
    ("fdda.evaluate", "fdda.render_comparison", "fdda.show_rig", "fdda.color_mesh", "fdda.fit_color_range"),
    ("fdda.jump_to_worst", "fdda.open_report"),
    ("fdda.add_model", "fdda.remove_model", "fdda.pack_model", "fdda.unpack_model"),
    ("fdda.help",),
)
"""Operators of the menu, in groups with a separator between them."""


class FDDA_OT_show_mesh(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.show_mesh"
    bl_label = "Show Mesh"
    bl_description = "Show this mesh of the armature in the sidebar"
    bl_options = {"INTERNAL"}
    waits_for_jobs = False

    def apply(self, context: bpy.types.Context) -> str:
        shown, active = self.rig(context), context.view_layer.objects.active
        name = shown.mesh_object.name
        # A script may name the mesh while nothing is active.
        is_mesh_active = active is not None and active.type == "MESH"
        if is_mesh_active and active != shown.mesh_object:
            if name not in context.view_layer.objects:
                raise RigError(f"'{name}' is in a collection that the view layer excludes; include it.")
            if active.mode != "OBJECT":
                raise RigError(f"'{active.name}' is not in Object Mode; leave its mode first.")
        context.window_manager.fdda.mesh = name
        # The sidebar prefers a mesh that is selected together with the armature.
        for rig in rigs_of_armature(shown.armature_object):
            if rig.mesh_object.select_get():
                rig.mesh_object.select_set(False)
        if is_mesh_active:
            shown.mesh_object.select_set(True)
            context.view_layer.objects.active = shown.mesh_object
        redraw()
        return ""


class FDDA_MT_main(bpy.types.Menu):
    bl_idname = "FDDA_MT_main"
    bl_label = "FDDA"

    def draw(self, context: bpy.types.Context) -> None:
        has_several_meshes = bool(cached_rigs_together(context))
        for index, group in enumerate(MENU_OPERATORS):
            if index:
                self.layout.separator()
            for name in group:
                properties = self.layout.operator(name)
                if has_several_meshes and "all_meshes" in properties.bl_rna.properties:
                    properties.all_meshes = True


def _draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    if cached_active_rig(context) is not None or context.mode == "OBJECT":
        self.layout.separator()
        self.layout.menu(FDDA_MT_main.bl_idname)


CLASSES = (FDDA_OT_show_mesh, FDDA_MT_main)
MENUS = {"VIEW3D_MT_object": _draw_menu, "VIEW3D_MT_pose": _draw_menu}
