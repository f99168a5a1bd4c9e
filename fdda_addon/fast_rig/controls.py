# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the control bones that a fast rig keeps, and the actions that animate them."""

from collections import Counter
from collections.abc import Iterable, Sequence

import bpy

from ..core.errors import WrongUsageError
from ..poses.sample_selection import COLLECTION_PREFIX, parse_bones
from ..rig.references import split_bone_path
from ..scene.action_slots import constraint_actions, curves_of_actions
from ..scene.compatibility import is_bone_hidden

VISIBLE, KEYED = "visible", "keyed"


def check_choices(choices: Iterable[str]) -> None:
    """Check the syntax of choices of control bones.

    Raises:
        WrongUsageError: a choice is none of `visible`, `keyed` and `collection:NAME`.
    """
    for choice in choices:
        if choice not in {VISIBLE, KEYED} and not choice.startswith(COLLECTION_PREFIX):
            raise WrongUsageError(
                f"'{choice}' chooses no control bones; give {VISIBLE}, {KEYED} or {COLLECTION_PREFIX}NAME, a bone "
                "collection."
            )


def control_bones(armature_object: bpy.types.Object, choices: Iterable[str]) -> set[str]:
    """Return the names of the chosen control bones.

    Args:
        choices: each is `visible`, `keyed` (in an action of the file) or `collection:NAME`.

    Raises:
        WrongUsageError: as `check_choices`.
        RigError: there is no bone collection of that name, or it has no bones.
    """
    choices = list(choices)
    check_choices(choices)
    bones = armature_object.pose.bones
    names: set[str] = set()
    for choice in choices:
        if choice == VISIBLE:
            names |= {bone.name for bone in bones if not is_bone_hidden(bone)}
        elif choice == KEYED:
            keyed = keyed_bones(armature_object, animating_actions(armature_object))
            names |= {name for counts in keyed.values() for name in counts if name in bones}
        else:
            names |= parse_bones(armature_object, choice)
    return names


def animating_actions(armature_object: bpy.types.Object) -> list[bpy.types.Action]:
    """Return the actions of the file that key bones of an armature, except `constraint_actions`."""
    bones, excluded = armature_object.pose.bones, constraint_actions(armature_object)
    keyed = keyed_bones(armature_object, [action for action in bpy.data.actions if action not in excluded])
    return [action for action, counts in keyed.items() if any(name in bones for name in counts)]


def keyed_bones(
    armature_object: bpy.types.Object, actions: Sequence[bpy.types.Action]
) -> dict[bpy.types.Action, Counter[str]]:
    """Return how many channels of each bone actions key, by action and name of the bone, which may be missing."""
    all_curves = (curves.get(armature_object, ()) for curves in curves_of_actions(actions, armature_object))
    names = ((split_bone_path(armature_object, curve.data_path)[0] for curve in curves) for curves in all_curves)
    return {action: Counter(filter(None, each)) for action, each in zip(actions, names, strict=True)}
