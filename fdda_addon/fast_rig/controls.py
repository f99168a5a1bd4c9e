# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the control bones that a fast rig keeps, and the actions that animate them."""

from collections.abc import Iterable

import bpy

from ..core.errors import RigError, WrongUsageError
from ..rig.references import split_bone_path
from ..scene.action_slots import constraint_actions, curves_of_actions
from ..scene.compatibility import is_bone_hidden

VISIBLE, KEYED, COLLECTION = "visible", "keyed", "collection:"


def check_choices(choices: Iterable[str]) -> None:
    """Check the syntax of choices of control bones.

    Raises:
        WrongUsageError: a choice is none of `visible`, `keyed` and `collection:NAME`.
    """
    for choice in choices:
        if choice not in {VISIBLE, KEYED} and not choice.startswith(COLLECTION):
            raise WrongUsageError(
                f"'{choice}' chooses no control bones; give {VISIBLE}, {KEYED} or {COLLECTION}NAME, a bone collection."
            )


def control_bones(armature_object: bpy.types.Object, choices: Iterable[str]) -> set[str]:
    """Return the names of the chosen control bones.

    Args:
        choices: each is `visible`, `keyed` (in an action of the file) or `collection:NAME`.

    Raises:
        WrongUsageError: as `check_choices`.
        RigError: there is no bone collection of that name.
    """
    choices = list(choices)
    check_choices(choices)
    bones = armature_object.pose.bones
    names: set[str] = set()
    for choice in choices:
        if choice == VISIBLE:
            names |= {bone.name for bone in bones if not is_bone_hidden(bone)}
        elif choice == KEYED:
            actions = animating_actions(armature_object)
            names |= {name for action in actions for name in keyed_bones(armature_object, action) if name in bones}
        else:
            collection_name = choice.removeprefix(COLLECTION)
            collection = armature_object.data.collections_all.get(collection_name)
            if collection is None:
                known = ", ".join(f"'{c.name}'" for c in armature_object.data.collections_all) or "none"
                raise RigError(
                    f"'{armature_object.name}' has no bone collection '{collection_name}'; its collections: {known}."
                )
            if not collection.bones_recursive:
                raise RigError(
                    f"The bone collection '{collection_name}' of '{armature_object.name}' has no bones; assign bones "
                    "to it, or choose another collection."
                )
            names |= {bone.name for bone in collection.bones_recursive}
    return names


def animating_actions(armature_object: bpy.types.Object) -> list[bpy.types.Action]:
    """Return the actions of the file that key bones of an armature, except `constraint_actions`."""
    bones, excluded = armature_object.pose.bones, constraint_actions(armature_object)
    return [
        action
        for action in bpy.data.actions
        if action not in excluded and any(name in bones for name in keyed_bones(armature_object, action))
    ]


def keyed_bones(armature_object: bpy.types.Object, action: bpy.types.Action) -> dict[str, int]:
    """Return how many channels of each bone an action keys, by the name of the bone, which may be missing."""
    counts: dict[str, int] = {}
    (curves,) = curves_of_actions([action], armature_object)
    for curve in curves.get(armature_object, ()):
        if name := split_bone_path(armature_object, curve.data_path)[0]:
            counts[name] = counts.get(name, 0) + 1
    return counts
