# SPDX-License-Identifier: GPL-3.0-or-later
"""Parses the user's selection of bones and controls for random poses, and makes controls of the channels of bones."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import bpy

from ..core.controls import ARMATURE_OBJECT, Control
from ..core.errors import RigError
from ..core.mathematics.poses import LOCATION, ROTATION, ROTATION_VECTOR, SCALE, Channel
from ..core.mathematics.remix import Remix
from ..scene.compatibility import is_selected
from ..scene.controls import MATRIX, MATRIX_ELEMENT_RANGE, canonical_path, custom_properties, is_driven, make_control
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
            selected_bones |= parse_bones(scene_rig.armature_object, text)
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


def parse_bones(armature_object: bpy.types.Object, text: str) -> set[str]:
    """Return the names of the bones that a text chooses: `selected`, `collection:NAME` or `bone:NAME`.

    Raises:
        RigError: there is no such collection or bone, or no bone is chosen.
    """
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


_TRANSFORM_PROPERTIES = {LOCATION: "location", SCALE: "scale"}
_TWO_COLUMNS = [(column, row) for column in (0, 1) for row in (0, 1, 2)]


def split_control_bones(scene_rig: SceneRig, texts: Iterable[str]) -> tuple[frozenset[str], tuple[str, ...]]:
    """Split controls as a user lists them into the names of control bones, and the other texts.

    Args:
        texts: `collection:NAME` for the bones of a collection and its children, `bone:NAME`, or any other text.
    """
    names: set[str] = set()
    other_texts = []
    for text in texts:
        if text.startswith((COLLECTION_PREFIX, BONE_PREFIX)):
            names |= parse_bones(scene_rig.armature_object, text)
        else:
            other_texts.append(text)
    return frozenset(names), tuple(other_texts)


def bone_controls(scene_rig: SceneRig, names: frozenset[str], channels: Iterable[Channel]) -> tuple[Control, ...]:
    """Make the controls of control bones: what random poses move, and the custom properties that no driver sets.

    Args:
        names: names of the control bones.
        channels: channels of the random poses (`sampling.selected_channels`).

    Raises:
        RigError: there is no control.
    """
    armature_object = scene_rig.armature_object
    channels_by_bone: dict[str, list[Channel]] = {name: [] for name in names}
    for channel in channels:
        if channel.name in names and not _is_driven(armature_object, channel):
            channels_by_bone[channel.name].append(channel)
    controls = []
    for bone in (armature_object.pose.bones[name] for name in sorted(names)):
        path = bone.path_from_id()
        for channel in channels_by_bone[bone.name]:
            if channel.kind in _TRANSFORM_PROPERTIES:
                subpath = f"{_TRANSFORM_PROPERTIES[channel.kind]}[{channel.axis}]"
                controls.append(Control(ARMATURE_OBJECT, f"{path}.{subpath}", channel.low, channel.high))
        controls += [
            Control(ARMATURE_OBJECT, f"{path}.{MATRIX}[{column}][{row}]", *MATRIX_ELEMENT_RANGE)
            for column, row in rotation_elements(channels_by_bone[bone.name])
        ]
        for property_path in custom_properties(armature_object, path):
            try:
                controls.append(make_control(scene_rig, ARMATURE_OBJECT, property_path))
            except RigError:
                # A property without a range, such as a setting of an add-on, is seldom made for animation.
                continue
    if names and not controls:
        raise RigError(
            f"No channel of the {len(names)} control bones of '{armature_object.name}', such as '{min(names)}', may "
            "move: unlock an axis, give a Limit Location or a Limit Scale, or record an action that moves "
            "them (--action NAME)."
        )
    return tuple(controls)


def rotation_elements(channels: Iterable[Channel]) -> list[tuple[int, int]]:
    """Return the columns and rows of the matrix elements that represent the rotation of a bone.

    Euler angles jump by a full turn, a rotation vector jumps at half a turn, and a quaternion has two signs. The first
    two columns are continuous everywhere and determine the rotation (Zhou et al., On the Continuity of Rotation
    Representations in Neural Networks, 2019). For a rotation about one axis, cosine and sine of its angle are enough.

    Args:
        channels: the channels of the bone.

    Returns:
        The elements of two columns; cosine and sine of a rotation about one axis; or none.
    """
    kinds_and_axes = {
        (channel.kind, channel.axis) for channel in channels if channel.kind in (ROTATION, ROTATION_VECTOR)
    }
    axes = sorted(axis for _, axis in kinds_and_axes)
    if not axes:
        return []
    # Components of a rotation vector are no angles about the axes of the bone.
    if len(axes) == 1 and kinds_and_axes == {(ROTATION, axes[0])}:
        cosine_row, sine_row = (axes[0] + 1) % 3, (axes[0] + 2) % 3
        return [(cosine_row, cosine_row), (cosine_row, sine_row)]
    return _TWO_COLUMNS


def _is_driven(armature_object: bpy.types.Object, channel: Channel) -> bool:
    """Return whether a driver sets a channel of a bone, or any component of its rotation."""
    path = armature_object.pose.bones[channel.name].path_from_id()
    animation = armature_object.animation_data
    if channel.kind in _TRANSFORM_PROPERTIES:
        return is_driven(armature_object, f"{path}.{_TRANSFORM_PROPERTIES[channel.kind]}[{channel.axis}]")
    return animation is not None and any(
        canonical_path(armature_object, curve.data_path).startswith(f"{path}.rotation_") for curve in animation.drivers
    )


def bones_without_location_range(
    armature_object: bpy.types.Object, names: Iterable[str], controls: Iterable[Control]
) -> list[str]:
    """Return the control bones whose location may be moved, but is no control on any axis, sorted."""
    paths = {control.path for control in controls}
    return [
        name
        for name in sorted(names)
        for bone in [armature_object.pose.bones[name]]
        if not bone.bone.use_connect
        and not all(bone.lock_location)
        and paths.isdisjoint(f"{bone.path_from_id()}.location[{axis}]" for axis in range(3))
    ]


def describe_control_bones(
    armature_object: bpy.types.Object, names: Iterable[str], controls: tuple[Control, ...]
) -> str:
    """Return a sentence with the number of inputs of control bones, and sentences about what has no range.

    Args:
        names: names of the control bones.
        controls: the controls of these, and any others.
    """
    names = frozenset(names)
    bone_paths = [armature_object.pose.bones[name].path_from_id() for name in names]
    counts = [sum(control.path.startswith(path) for control in controls) for path in bone_paths]
    moving_count = sum(count > 0 for count in counts)
    sentence = f"{moving_count} control bone{'s' * (moving_count != 1)} with {sum(counts)} inputs."
    if unlimited := bones_without_location_range(armature_object, names, controls):
        others = f" and of {len(unlimited) - 1} more" if len(unlimited) > 1 else ""
        sentence += (
            f" The location of '{unlimited[0]}'{others} has no range, so random poses do not move it; lock it, give it "
            "a Limit Location, or record an action that moves it."
        )
    paths = {control.path for control in controls}
    bone_paths = [(name, armature_object.pose.bones[name].path_from_id()) for name in sorted(names)]
    if properties := [
        (name, bpy.utils.unescape_identifier(property_path.removeprefix(path)[2:-2]))
        for name, path in bone_paths
        for property_path in sorted(custom_properties(armature_object, path))
        if property_path not in paths
    ]:
        bone_name, property_name = properties[0]
        others = f" and {len(properties) - 1} more" if len(properties) > 1 else ""
        sentence += (
            f" The custom property '{property_name}' of '{bone_name}'{others} has no range and is no input; set "
            "Soft Min and Soft Max in the settings of the property."
        )
    return sentence
