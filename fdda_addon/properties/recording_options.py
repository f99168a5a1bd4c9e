# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts the properties of a character to the settings of a recording."""

from collections.abc import Iterable

import bpy

from ..core.errors import RigError
from ..core.settings import POSES, settings_of, values_from
from ..poses.motion_range import limited_bones
from ..poses.remix import REMIX, choose_bones, describe_bones
from ..recording.plan import RecordingSettings
from ..rig.pose_setter import TargetSettings
from ..scene.action_slots import dependencies, may_animate
from ..scene.active_rig import cached_active_rig
from ..scene.draw_cache import actions_state, computed_once, draw_cached
from ..scene.scene_rig import SceneRig
from .character import FDDA_PG_character, default_model, default_recording

SHARED_VALUES = (*(setting.name for setting in settings_of(RecordingSettings)), "bones_to_pose", "bone_collection")
SHARED_LISTS = {"sampled_bones": ("name",), "extra_inputs": ("name", "has_range", "low", "high")}
"""Settings that the meshes of a recording share, and the attributes of the entries of lists."""


def recording_settings(scene_rig: SceneRig, resume: bool = False) -> "RecordingSettings":
    """Return the settings of a recording of a character."""
    settings = scene_rig.mesh_object.fdda.settings
    actions = recorded_actions(scene_rig)
    values = values_from(settings, settings_of(RecordingSettings))
    values["mirror"] &= bool(actions)
    if settings.auto_poses:
        values["poses"] = POSES.default
    return RecordingSettings(
        actions=actions,
        resume=resume,
        bones_to_pose=_sample_options(scene_rig, actions),
        extra_inputs=tuple(
            f"{control.name}={control.low!r}:{control.high!r}" if control.has_range else control.name
            for control in settings.extra_inputs
            if control.name
        ),
        target=target_settings(settings),
        **values,
    )


def complete_settings(scene_rig: SceneRig) -> "RecordingSettings | None":
    """Return the settings of a recording of a character; None if the bones to pose have not been chosen."""
    try:
        return recording_settings(scene_rig)
    except RigError:
        return None


def target_settings(settings: FDDA_PG_character) -> "TargetSettings":
    """Return the settings of the target object of a character."""
    if not settings.learn_from:
        return TargetSettings()
    return TargetSettings(settings.learn_from, settings.pre_roll, settings.settle_frames)


def copy_settings(mesh_object: bpy.types.Object, source_object: bpy.types.Object) -> None:
    """Copy the settings of poses, recording and paths from another mesh, so that they share recording and model."""
    settings, source = mesh_object.fdda.settings, source_object.fdda.settings
    settings.recording = source.recording or default_recording(source_object)
    settings.model = source.model or default_model(source_object)
    for name in SHARED_VALUES:
        setattr(settings, name, getattr(source, name))
    for name, attributes in SHARED_LISTS.items():
        collection = getattr(settings, name)
        collection.clear()
        for entry in getattr(source, name):
            copied_entry = collection.add()
            for attribute in attributes:
                setattr(copied_entry, attribute, getattr(entry, attribute))


def meshes_with_other_settings(shown_object: bpy.types.Object, mesh_objects: Iterable[bpy.types.Object]) -> list[str]:
    """Return the names of meshes with settings of their own, which `copy_settings` would replace."""
    shown = shown_object.fdda.settings
    folder = shown.recording or default_recording(shown_object)
    names = []
    for mesh_object in mesh_objects:
        settings = mesh_object.fdda.settings
        is_other = settings.recording not in ("", folder) or any(
            settings.is_property_set(name) and getattr(settings, name) != getattr(shown, name) for name in SHARED_VALUES
        )
        for name, attributes in SHARED_LISTS.items():
            own, others = (
                [tuple(getattr(entry, attribute) for attribute in attributes) for entry in getattr(owner, name)]
                for owner in (settings, shown)
            )
            is_other |= bool(own) and own != others
        names += [mesh_object.name] if is_other and mesh_object != shown_object else []
    return names


def bones_to_pose(scene_rig: SceneRig) -> str:
    """Return the setting Bones to Pose of a character, with its choice in place of Automatic."""
    setting = scene_rig.mesh_object.fdda.settings.bones_to_pose
    if setting != "AUTO":
        return setting
    actions = recorded_actions(scene_rig)
    # Limits do not count if there are recorded actions.
    has_limits = not actions and _has_limits(scene_rig.armature_object)
    inputs = actions_state(), actions, actions_of_rig(scene_rig), has_limits
    name = "bones to pose", scene_rig.mesh_object.session_uid

    def choose() -> str:
        return "REMIX" if choose_bones(scene_rig, [bpy.data.actions[name] for name in actions]) else "WEIGHTS"

    return computed_once(name, inputs, choose)


@draw_cached
def _has_limits(armature_object: bpy.types.Object) -> bool:
    return bool(limited_bones(armature_object))


def describe_chosen_bones(scene_rig: SceneRig) -> str:
    """Return a sentence about the actions from which random poses combine limbs, or about the deforming bones."""
    actions = recorded_actions(scene_rig)
    bones = (REMIX,) if bones_to_pose(scene_rig) == "REMIX" else ()
    inputs = actions_state(), bones, actions, actions_of_rig(scene_rig)
    key = "description of bones to pose", scene_rig.mesh_object.session_uid
    return computed_once(
        key, inputs, lambda: describe_bones(scene_rig, bones, [bpy.data.actions[name] for name in actions])
    )


def _sample_options(scene_rig: SceneRig, actions: tuple[str, ...]) -> tuple[str, ...]:
    """Return the bones that random poses move, in the syntax of `poses.sampling.parse_sample_selection`."""
    settings = scene_rig.mesh_object.fdda.settings
    if settings.bones_to_pose == "AUTO" and not settings.has_random_poses:
        return ()
    if bones_to_pose(scene_rig) == "REMIX":
        return (REMIX,)
    if settings.bones_to_pose == "COLLECTION":
        if not settings.bone_collection:
            raise RigError(
                "Bones to Pose is set to Bone Collection, but no collection is chosen; choose one in Training Poses."
            )
        return (f"collection:{settings.bone_collection}",)
    if settings.bones_to_pose == "ACTIONS":
        if not actions:
            label = settings.bl_rna.properties["bones_to_pose"].enum_items["ACTIONS"].name
            raise RigError(f"Bones to Pose is set to {label}, but no action is checked; check one below it.")
        return tuple(f"action:{name}" for name in actions)
    if settings.bones_to_pose == "SELECTED":
        if not settings.sampled_bones:
            raise RigError(
                "Bones to Pose is set to Selected Bones, but none is chosen; select bones and press Use Selected Bones."
            )
        return tuple(f"bone:{bone.name}" for bone in settings.sampled_bones)
    return ()


def recorded_actions(scene_rig: SceneRig) -> tuple[str, ...]:
    """Return the names of the checked actions that animate a rig."""
    return tuple(action.name for action in actions_of_rig(scene_rig) if action.fdda.record)


def actions_of_active_rig(context: bpy.types.Context) -> list[str]:
    """Return the names of the actions that animate the rig that the sidebar shows."""
    rig = cached_active_rig(context)
    return [action.name for action in actions_of_rig(rig)] if rig is not None else []


@draw_cached
def actions_of_rig(scene_rig: SceneRig) -> tuple[bpy.types.Action, ...]:
    """Return the actions that may animate a rig or something on which it depends."""
    datablocks = dependencies(scene_rig.armature_object, *scene_rig.mesh_objects)
    return tuple(action for action in bpy.data.actions if may_animate(action, datablocks))
