# SPDX-License-Identifier: GPL-3.0-or-later
"""Parses the user's selection of bones and controls for random poses."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import bpy

from ..core.controls import Control
from ..core.errors import RigError
from ..core.mathematics.poses import Channel
from ..core.mathematics.remix import Remix
from ..scene.compatibility import is_selected
from ..scene.scene_rig import SceneRig
from .action_range import constant_controls, keyed_controls, keyed_ranges, measured_controls
from .clip import find_action
from .motion_range import limited_bones
from .remix import REMIX, read_remix, remixed_actions

SELECTED_BONES, COLLECTION_PREFIX, ACTION_PREFIX, BONE_PREFIX = "selected", "collection:", "action:", "bone:"
"""Forms of an entry: the selected bones, and the prefixes of a bone collection, an action and a single bone."""


@dataclass(frozen=True)
class SampleSelection:
    """The bones and controls that random poses set.

    Attributes:
        bones: names of the selected bones; None for the default bones (`default_channels`).
        measured: ranges of the channels that the selected actions key. Bones that are selected by an action move in
            these ranges, within the limits of the rig. Other selected bones use them if they have no range of motion.
        action_bones: names of the bones that are selected by actions alone.
        controls: the controls, listed by the user or keyed by the actions.
        constant_channels: numbers that the actions key at a single value which differs from the current one.
        control_bones: names of the bones whose channels are controls; they are sampled besides the default bones. They
            are among the selected bones, if there are any.
        key_bones: bones that act through shape keys alone. They are sampled, but are no joints.
    """

    bones: frozenset[str] | None = None
    measured: tuple[tuple[tuple[str, str, int], tuple[float, float]], ...] = ()
    action_bones: frozenset[str] = frozenset()
    controls: tuple[Control, ...] = ()
    constant_channels: tuple[Channel, ...] = ()
    control_bones: frozenset[str] = frozenset()
    remix: Remix | None = None
    key_bones: frozenset[str] = frozenset()


DEFAULT_SELECTION = SampleSelection()
"""The user selected nothing, so the default bones are sampled."""


def select_bones(
    scene_rig: SceneRig,
    texts: Iterable[str],
    control_bones: frozenset[str] = frozenset(),
    recorded_actions: Iterable[bpy.types.Action] = (),
) -> SampleSelection:
    """Parse a selection, which may be empty.

    Args:
        texts: as for `sampling.parse_sample_selection`.
        control_bones: names of the bones whose channels are controls.
        recorded_actions: actions whose frames are recorded; control bones without a range move in their ranges.

    Raises:
        RigError: there is no such collection, action or bone.
    """
    texts, recorded_actions = list(texts), list(recorded_actions)
    measured = keyed_ranges(scene_rig.armature_object, recorded_actions if control_bones else ())
    control_ranges = {key: bounds for key, bounds in measured.items() if key[0] in control_bones}
    if not texts:
        return replace(DEFAULT_SELECTION, measured=tuple(control_ranges.items()), control_bones=control_bones)
    selected_bones = set(control_bones)
    actions = []
    remix = None
    for text in texts:
        if text == REMIX:
            actions += remixed_actions(scene_rig, recorded_actions)
            remix = read_remix(scene_rig, recorded_actions)
            # Bones that the actions leave at rest move within the limits that they have.
            remixed_bones = {channel.name for channel in remix.channels}
            selected_bones |= limited_bones(scene_rig.armature_object) - remixed_bones
        elif text.startswith(ACTION_PREFIX):
            actions.append(find_action(text.removeprefix(ACTION_PREFIX)))
            if not keyed_ranges(scene_rig.armature_object, actions[-1:]) and not keyed_controls(
                scene_rig, actions[-1:]
            ):
                raise RigError(
                    f"The action '{actions[-1].name}' chooses nothing to sample: it keys no bone of "
                    f"'{scene_rig.armature_object.name}' and no number of the rig; choose another action."
                )
        else:
            selected_bones |= parse_bones(scene_rig, text)
    keyed_channel_ranges = keyed_ranges(scene_rig.armature_object, actions)
    keyed_bones = {bone for bone, _, _ in keyed_channel_ranges}
    controls, constant_channels = measured_controls(scene_rig, actions), constant_controls(scene_rig, actions)
    return SampleSelection(
        frozenset(selected_bones | keyed_bones),
        tuple((control_ranges | keyed_channel_ranges).items()),
        frozenset(keyed_bones - selected_bones),
        controls,
        constant_channels,
        control_bones,
        remix,
    )


def parse_bones(scene_rig: SceneRig, text: str) -> set[str]:
    """Return the names of the bones that a text chooses: `selected`, `collection:NAME` or `bone:NAME`.

    Raises:
        RigError: there is no such collection or bone, or no bone is chosen.
    """
    armature_object = scene_rig.armature_object
    bones, armature = armature_object.pose.bones, armature_object.data
    if text == SELECTED_BONES:
        names = {bone.name for bone in bones if is_selected(bone)}
        if not names:
            raise RigError(f"No bone of '{armature_object.name}' is selected; select bones in Pose Mode.")
        return names
    if text.startswith(COLLECTION_PREFIX):
        name = text.removeprefix(COLLECTION_PREFIX)
        if name not in armature.collections_all:
            names = ", ".join(f"'{c.name}'" for c in armature.collections_all) or "none"
            raise RigError(f"'{armature_object.name}' has no bone collection '{name}'; its collections: {names}.")
        names = {bone.name for bone in armature.collections_all[name].bones_recursive}
        if not names:
            raise RigError(
                f"The bone collection '{name}' of '{armature_object.name}' has no bones; assign bones to it, or choose "
                "another collection."
            )
        return names
    name = text.removeprefix(BONE_PREFIX)
    if not text.startswith(BONE_PREFIX) or name not in bones:
        raise RigError(
            f"'{text}' chooses nothing of '{armature_object.name}'; give {SELECTED_BONES}, {COLLECTION_PREFIX}NAME, "
            f"{ACTION_PREFIX}NAME, {BONE_PREFIX}NAME of what is there, or {REMIX}."
        )
    return {name}
