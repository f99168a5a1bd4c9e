# SPDX-License-Identifier: GPL-3.0-or-later
"""What is recorded, as the user has set it up in the sidebar: the bones and controls that are sampled, the actions."""

from typing import TYPE_CHECKING

import bpy

from ..core.errors import RigError
from ..scene.scene_rig import SceneRig
from ..settings import FDDA_PG_character, wanted_fit
from .on_pose import OnPose

if TYPE_CHECKING:  # Blender starts without numpy.
    from ..recording import RecordingSettings

ALL_SHAPE_KEYS = "shape_keys"
"""Stands for all shape keys that no driver moves (`scene.controls.stated_controls`)."""


def recording_settings(scene_rig: SceneRig, resume: bool = False) -> "RecordingSettings":
    """The settings of a recording of a character.

    Raises:
        RigError: what random poses are to move has not been chosen.
    """
    from ..recording import RecordingSettings

    settings = scene_rig.mesh_object.fdda.settings
    actions = recorded_actions(scene_rig.armature_object)
    return RecordingSettings(
        poses=settings.poses,
        seed=settings.seed,
        spread=settings.spread,
        actions=actions,
        resume=resume,
        sample=_sample(settings, actions),
        controls=_controls(settings),
        fit_linear=wanted_fit(settings),
        least_vertices=settings.least_vertices,
        mirror=settings.mirror and bool(actions),
    )


def _sample(settings: FDDA_PG_character, actions: tuple[str, ...]) -> tuple[str, ...]:
    """What random poses move, as `scene.sampling.choose` reads it."""
    if settings.sample == "COLLECTION":
        if not settings.bone_collection:
            raise RigError("Random poses are to move a bone collection, and none is chosen; choose it under Poses.")
        return (f"collection:{settings.bone_collection}",)
    if settings.sample == "ACTIONS":
        if not actions:
            raise RigError("Random poses are to move what the ticked actions key, and none is ticked; tick one.")
        return tuple(f"action:{name}" for name in actions)
    if settings.sample == "SELECTED":
        if not settings.sampled_bones:
            raise RigError(
                "Random poses are to move selected bones, and none is chosen; select them and press Use Selected Bones."
            )
        return tuple(f"bone:{bone.name}" for bone in settings.sampled_bones)
    return ()


def _controls(settings: FDDA_PG_character) -> tuple[str, ...]:
    """The listed controls as `scene.controls.stated_controls` reads them; those without a name yet are left out."""
    return tuple(
        f"{control.name}={control.low!r}:{control.high!r}" if control.has_range else control.name
        for control in settings.controls
        if control.name
    )


def recorded_actions(armature_object: bpy.types.Object) -> tuple[str, ...]:
    """Names of the actions that the user has chosen for recording and that move a bone of this armature."""
    return tuple(action.name for action in bpy.data.actions if action.fdda.record and fits(action, armature_object))


def fits(action: bpy.types.Action, armature_object: bpy.types.Object) -> bool:
    """Whether an action moves a bone of this armature."""
    from ..scene.compatibility import animation_curves

    bones = armature_object.pose.bones
    for curve in animation_curves(action):
        path = curve.data_path
        if path.startswith('pose.bones["') and path[12 : path.find('"]', 12)] in bones:
            return True
    return False


class FDDA_OT_use_selected_bones(OnPose, bpy.types.Operator):
    bl_idname = "fdda.use_selected_bones"
    bl_label = "Use Selected Bones"
    bl_description = "Let random poses move the bones that are selected now; another selection later changes nothing"
    bl_options = {"REGISTER", "UNDO"}

    def change(self, context: bpy.types.Context) -> str:
        from ..scene.compatibility import is_selected

        rig = self.rig(context)
        names = [bone.name for bone in rig.armature_object.pose.bones if is_selected(bone)]
        if not names:
            raise RigError(f"No bone of '{rig.armature_object.name}' is selected; select bones in pose mode.")
        settings = rig.mesh_object.fdda.settings
        settings.sample = "SELECTED"
        settings.sampled_bones.clear()
        for name in names:
            settings.sampled_bones.add().name = name
        return (
            f"Random poses move {len(names)} {'bone' if len(names) == 1 else 'bones'} of '{rig.armature_object.name}'."
        )


class FDDA_OT_add_control(OnPose, bpy.types.Operator):
    bl_idname = "fdda.add_control"
    bl_label = "Add Control"
    bl_description = "Make another number an input of the model, which random poses change: a shape key, a property"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.StringProperty(
        name="Name", description="Of a shape key, or OWNER/PATH; empty to choose it later", options={"SKIP_SAVE"}
    )

    def change(self, context: bpy.types.Context) -> str:
        from ..scene.controls import stated_controls

        rig = self.rig(context)
        settings = rig.mesh_object.fdda.settings
        if self.name:
            stated_controls(rig, [self.name])
        if self.name and self.name in settings.controls:
            raise RigError(f"The control '{self.name}' is in the list already.")
        settings.controls.add().name = self.name
        settings.control_index = len(settings.controls) - 1
        return f"{self.name or 'Another control'} is in the list."


class FDDA_OT_remove_control(OnPose, bpy.types.Operator):
    bl_idname = "fdda.remove_control"
    bl_label = "Remove Control"
    bl_description = "Take this control off the list"
    bl_options = {"REGISTER", "UNDO"}

    def change(self, context: bpy.types.Context) -> str:
        settings = self.rig(context).mesh_object.fdda.settings
        index = settings.control_index
        if not 0 <= index < len(settings.controls):
            raise RigError("No control is chosen; click one of the list.")
        name = settings.controls[index].name
        settings.controls.remove(index)
        settings.control_index = max(0, index - 1)
        return f"{name or 'The control'} is no longer in the list."


CLASSES = (FDDA_OT_use_selected_bones, FDDA_OT_add_control, FDDA_OT_remove_control)
