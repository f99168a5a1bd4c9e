# SPDX-License-Identifier: GPL-3.0-or-later
"""Which bones and controls a user chose to sample."""

from collections.abc import Iterable
from dataclasses import dataclass

from ..core.controls import Control
from ..core.errors import RigError
from ..core.poses import Channel
from ..scene.compatibility import is_selected
from ..scene.scene_rig import SceneRig
from .action_range import constant_controls, keyed_ranges, measured_controls
from .clip import find_action

SELECTED, COLLECTION, ACTION, BONE = "selected", "collection:", "action:", "bone:"
"""How a user chooses the control bones that are sampled."""

Measured = dict[tuple[str, str, int], tuple[float, float]]
"""Ranges by bone, kind and axis."""


@dataclass(frozen=True)
class SampleSelection:
    """What a user chose to sample.

    Attributes:
        bones: names of the control bones; None for the bones of the rig as it stands (`default_channels`).
        measured: ranges of what actions key. Bones that are chosen by action move in these, as far as the rig's limits
            let them; other chosen bones do where the rig states no range.
        by_action: names of the bones that are chosen by action alone.
        controls: the controls, stated or keyed.
        held: numbers that actions key at one value, which the file has otherwise.
    """

    bones: frozenset[str] | None = None
    measured: tuple[tuple[tuple[str, str, int], tuple[float, float]], ...] = ()
    by_action: frozenset[str] = frozenset()
    controls: tuple[Control, ...] = ()
    held: tuple[Channel, ...] = ()


DEFAULT_SELECTION = SampleSelection()
"""Nothing was chosen: the bones of the rig as it stands are sampled."""


def select_bones(scene_rig: SceneRig, texts: Iterable[str]) -> SampleSelection:
    """Read what a user chose; the choice may be empty.

    Raises:
        RigError: there is no such collection, action or bone.
    """
    texts = list(texts)
    if not texts:
        return DEFAULT_SELECTION
    chosen: set[str] = set()
    actions = []
    for text in texts:
        if text.startswith(ACTION):
            actions.append(find_action(text.removeprefix(ACTION)))
        else:
            chosen |= _bones_of(scene_rig, text)
    measured = keyed_ranges(scene_rig.armature_object, actions)
    keyed = {bone for bone, _, _ in measured}
    controls, held = measured_controls(scene_rig, actions), constant_controls(scene_rig, actions)
    return SampleSelection(
        frozenset(chosen | keyed), tuple(measured.items()), frozenset(keyed - chosen), controls, held
    )


def _bones_of(scene_rig: SceneRig, text: str) -> set[str]:
    armature_object = scene_rig.armature_object
    bones, data = armature_object.pose.bones, armature_object.data
    if text == SELECTED:
        return {bone.name for bone in bones if is_selected(bone)}
    if text.startswith(COLLECTION):
        name = text.removeprefix(COLLECTION)
        if name not in data.collections_all:
            known = ", ".join(f"'{c.name}'" for c in data.collections_all) or "none"
            raise RigError(f"'{armature_object.name}' has no bone collection '{name}'; its collections: {known}.")
        return {bone.name for bone in data.collections_all[name].bones_recursive}
    name = text.removeprefix(BONE)
    if not text.startswith(BONE) or name not in bones:
        raise RigError(
            f"'{text}' chooses nothing of '{armature_object.name}'; give {SELECTED}, {COLLECTION}NAME, {ACTION}NAME or "
            f"{BONE}NAME of what is there."
        )
    return {name}
