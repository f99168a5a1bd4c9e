# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks a rig before a recording, and reports all problems at once."""

from dataclasses import dataclass, replace

from ..core.controls import Control
from ..core.errors import RigError
from ..core.mathematics.poses import Channel
from ..core.rig import STATIC_JOINT, Rig
from ..rig.modifier_stack import check_evaluable, deforming_modifiers
from ..rig.reading import read_rig
from ..rig.time_inputs import check_time_inputs
from ..scene.scene_rig import SceneRig, armature_modifier, check_full_rig
from ..scene.skin import read_skin
from .plan import (
    RecordingSettings,
    depends_on_time,
    find_actions,
    listed_controls,
    random_pose_channels,
    read_sample_selection,
)

DEFAULT_SETTINGS = RecordingSettings()


@dataclass(frozen=True, eq=False)
class RigCheck:
    """Result of the check of a rig.

    Attributes:
        problems: one sentence for each reason why the rig cannot be recorded.
        rig: the rig as arrays; None if it cannot be read.
        channels: channels of random poses; may be empty.
        replaced_modifiers: names of the modifiers that a model replaces.
        automatic_controls: controls that are not listed in the settings: drivers of the mesh read them, or sampled
            actions key them.
        extra_joints, include_static_joint: arguments of `read_rig`.
        problems_beside_others: those of `problems` that also leave the mesh out of a recording of several meshes.
    """

    problems: tuple[str, ...]
    rig: Rig | None
    channels: tuple[Channel, ...]
    replaced_modifiers: tuple[str, ...] = ()
    automatic_controls: tuple[Control, ...] = ()
    extra_joints: tuple[str, ...] | None = None
    include_static_joint: bool = False
    problems_beside_others: tuple[str, ...] = ()


def check_has_weights(scene_rig: SceneRig) -> None:
    """Check that vertices of some mesh follow deforming bones, so that there is linear skinning to learn from.

    Raises:
        RigError: there is no Armature modifier, or no vertex has a weight on a deforming bone.
    """
    mesh_object, armature_object = scene_rig.mesh_object, scene_rig.armature_object
    modifiers = {each: armature_modifier(each) for each in scene_rig.mesh_objects}
    skins = (read_skin(each, armature_object, modifier) for each, modifier in modifiers.items() if modifier)
    if all(set(skin.bones) <= {STATIC_JOINT} for skin in skins):
        raise RigError(
            f"The vertices of '{mesh_object.name}' have no weights on deforming bones of '{armature_object.name}', so "
            "there is no linear skinning to learn from; set Base Skinning in Training to Fit, or paint weights."
        )


def check_recordable_rig(
    scene_rig: SceneRig, settings: RecordingSettings = DEFAULT_SETTINGS, previous_check: RigCheck | None = None
) -> RigCheck:
    """Check a rig. While a model plays, the modifiers of the rig are off, so they are not checked.

    Args:
        settings: settings of the recording.
        previous_check: the result of an earlier check, whose mesh is not read again: only modifiers, modes, ranges of
            motion and settings may have changed since.
    """
    result = RigCheck((), None, ())
    problems: list[str] = []
    stack = None
    try:
        check_full_rig(scene_rig.mesh_object)
    except RigError as error:
        problems.append(str(error))
    if not scene_rig.mesh_object.fdda.is_playing:
        try:
            stack = check_evaluable(scene_rig)
        except RigError as error:
            problems.append(str(error))
    try:
        result = replace(result, replaced_modifiers=tuple(m.name for m in deforming_modifiers(scene_rig.mesh_object)))
        selection, extra_joints = read_sample_selection(scene_rig, settings)
        if stack is not None and not settings.target.name:
            try:
                check_time_inputs(scene_rig, selection.controls, stack, find_actions(settings))
            except RigError as error:
                problems.append(str(error))
        include_static_joint = depends_on_time(scene_rig, settings, selection.controls)
        if (
            previous_check is not None
            and previous_check.rig is not None
            and (previous_check.extra_joints, previous_check.include_static_joint)
            == (extra_joints, include_static_joint)
        ):
            rig = previous_check.rig
        else:
            rig = read_rig(scene_rig, extra_joints, include_static_joint)
        # The same object shows that there is nothing to draw again.
        if rig.controls != selection.controls:
            rig = replace(rig, controls=selection.controls)
        user_controls = listed_controls(scene_rig, settings)
        automatic_controls = tuple(control for control in selection.controls if control not in user_controls)
        result = replace(
            result,
            rig=rig,
            automatic_controls=automatic_controls,
            extra_joints=extra_joints,
            include_static_joint=include_static_joint,
        )
        result = replace(result, channels=random_pose_channels(scene_rig, rig, selection))
    except RigError as error:
        # A rig without channels to sample can still be recorded from actions alone.
        if str(error) not in problems and (result.rig is None or settings.poses):
            problems.append(str(error))
    return replace(result, problems=tuple(problems))


def problems_beside_others(
    scene_rig: SceneRig, settings: RecordingSettings, previous_check: RigCheck | None = None
) -> tuple[str, ...]:
    """Return why a mesh cannot be recorded together with others, which have what random poses need.

    Args:
        scene_rig, settings, previous_check: as of `check_recordable_rig`.
    """
    inputs = tuple(text for text in settings.extra_inputs if _has_input(scene_rig, settings, text))
    return check_recordable_rig(scene_rig, replace(settings, poses=0, extra_inputs=inputs), previous_check).problems


def _has_input(scene_rig: SceneRig, settings: RecordingSettings, text: str) -> bool:
    """Return whether a mesh or its armature has an extra input of the settings."""
    try:
        listed_controls(scene_rig, replace(settings, extra_inputs=(text,)))
    except RigError:
        return False
    return True
