# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Rig": shows the character, problems that prevent recording, and whether a model would be faster."""

import bpy

from ..core.wording import format_count
from ..jobs import job
from ..properties.character import file_problem
from ..scene.scene_rig import SceneRig
from . import checks, curves, findings, limits
from .frame_profile import draw_profile, draw_times
from .meshes import draw_meshes
from .recording import has_recording, is_in_recording
from .section import Section, draw_assessment, draw_button, draw_job, draw_wrapped, is_recordable, panel_rig
from .trained_file import find_trained_file
from .training import read_assessment

MODIFIER_ICONS = {
    "ARMATURE": "MOD_ARMATURE", "CORRECTIVE_SMOOTH": "MOD_SMOOTH", "SMOOTH": "MOD_SMOOTH", "LATTICE": "MOD_LATTICE",
    "NODES": "GEOMETRY_NODES", "SURFACE_DEFORM": "MOD_MESHDEFORM", "MESH_DEFORM": "MOD_MESHDEFORM",
}  # fmt: skip


class FDDA_PT_rig(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_rig"
    bl_label = "Rig"
    verbs = ("measure", "build_model", "profile_frame")

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return True

    @classmethod
    def is_done(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        check = checks.last_check(rig) if rig else None
        return check is not None and not check.problems and not findings.find(rig)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.enabled_layout()
        rig, message = panel_rig(context)
        if rig is None:
            active_object = context.view_layer.objects.active
            # Without an armature, the section Model is not shown.
            status = active_object.fdda.status if active_object is not None and active_object.type == "MESH" else ""
            draw_wrapped(layout, context, status or message, "ERROR" if status else "INFO")
            layout.operator("fdda.add_sample_arm", text="Add Sample Arm", icon="ADD")
            return
        is_fast_rig = rig.mesh_object.fdda.is_fast_rig
        if not is_fast_rig:
            _draw_build_model(layout, context, rig)
        draw_meshes(layout, context, rig)
        check = checks.last_check(rig)
        column = layout.column(align=True)
        column.label(
            text=f"{rig.mesh_object.name}: {format_count(len(rig.mesh_object.data.vertices), 'vertex', 'vertices')}",
            icon="MESH_DATA",
        )
        bones = rig.armature_object.data.bones
        bone_count = len(bones)
        # A mesh without weights also has a joint that is no bone.
        deforming_count = sum(name in bones for name in check.rig.joint_names) if check and check.rig else bone_count
        count_text = format_count(bone_count, "bone")
        if deforming_count != bone_count:
            count_text = f"{deforming_count:,} of {count_text}"
        column.label(text=f"{rig.armature_object.name}: {count_text}", icon="ARMATURE_DATA")
        for problem in check.problems if check else ():
            draw_wrapped(layout.box(), context, problem, "ERROR")
        for finding in findings.find(rig):
            box = layout.box().column(align=True)
            draw_wrapped(box, context, finding.text, "ERROR")
            if finding.operator:
                box.operator(finding.operator).object = rig.mesh_object.name
        if check:
            mesh_object = rig.mesh_object
            column = layout.column(align=True)
            column.label(text="Replaced by the Model:")
            for modifier in (
                mesh_object.modifiers[name] for name in check.replaced_modifiers if name in mesh_object.modifiers
            ):
                column.label(text=modifier.name, icon=MODIFIER_ICONS.get(modifier.type, "MODIFIER"))
            if mesh_object.data.shape_keys:
                count = len(mesh_object.data.shape_keys.key_blocks) - 1
                column.label(text=f"{count} shape {'key' if count == 1 else 'keys'}", icon="SHAPEKEY_DATA")
        if not is_fast_rig:
            draw_times(layout, context, rig.armature_object)
            draw_profile(layout, context, rig)


def _draw_build_model(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw the button that records, trains and binds, or the progress of its job."""
    if draw_job(layout, context, "build_model"):
        state = job.state_of("build_model")
        if not state.changes_scene:
            curves.draw(layout, state.curves)
        return
    _draw_verdict(layout, context, rig)
    settings = rig.mesh_object.fdda.settings
    row = layout.row()
    row.scale_y = 1.3
    problem = file_problem(rig.mesh_object)
    row.enabled = not problem
    label, applies_to = "Record, Train & Bind", is_recordable
    if has_recording(rig):
        label, applies_to = "Train & Bind", lambda each: each == rig or is_in_recording(each, rig)
    draw_button(row, context, "fdda.build_model", label, "PLAY", applies_to)
    if problem:
        draw_wrapped(layout, context, problem, "INFO")
    elif limits.lacks_limits(rig) and settings.has_random_poses:
        draw_wrapped(layout, context, "No rotation limits yet: set them in Training Poses first.", "ERROR")


def _draw_verdict(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw what the errors of the model mean that the job has trained."""
    state, trained = job.state_of("build_model"), find_trained_file(rig)
    if state is None or state.outcome_level != "INFO" or trained is None:
        return
    if (assessment := read_assessment(trained.path)) is not None:
        draw_assessment(layout, context, assessment)


CLASSES = (FDDA_PT_rig,)


def unregister() -> None:
    """Clear all checks."""
    checks.unregister()
