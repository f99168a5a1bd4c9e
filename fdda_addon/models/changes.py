# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds changes of a rig since a model of the rig was trained."""

from dataclasses import dataclass

import bpy

from ..core.formats.model_info import ModelInfo
from ..core.mathematics.poses import ROTATION_VECTOR, Channel, bones_with_changed_range
from ..core.rig import Rig, rig_differences
from ..core.wording import format_list
from ..poses.sampling import sampled_channels
from ..rig.reading import read_model_rig
from ..scene.scene_rig import SceneRig
from .model_list import entry_info_of_mesh


@dataclass(frozen=True)
class RigChanges:
    """Changes of a rig since a model of the rig was trained.

    Attributes:
        model_name: name of the model.
        blocking_changes: changes that prevent playback, each as a clause such as "the skin weights differ".
        bones_with_changed_range: names of the bones whose range of motion has changed. The model plays, but may be less
            exact in the new range.
    """

    model_name: str
    blocking_changes: tuple[str, ...] = ()
    bones_with_changed_range: tuple[str, ...] = ()

    @property
    def prevents_playback(self) -> bool:
        """Return whether the changes prevent playback."""
        return bool(self.blocking_changes)

    @property
    def sentence(self) -> str:
        """Return the changes and what to do as text; empty without changes."""
        if self.blocking_changes:
            return (
                f"{self.model_name} was trained for an earlier state of this rig: {'; '.join(self.blocking_changes)}. "
                "Undo the change, or record and train again."
            )
        names = self.bones_with_changed_range
        if not names:
            return ""
        return (
            f"The range of motion of {format_list(names)} has changed since {self.model_name} was trained: it plays, "
            "but may be less exact there. Record and train again."
        )


def compare_with_model(name: str, info: ModelInfo, rig: Rig, channels: tuple[Channel, ...]) -> RigChanges:
    """Compare a rig and its range of motion with those that a model was trained for.

    Args:
        name, info: name and metadata of the model.
        rig: the rig with the joints of the model (`rig.reading.read_model_rig`).
        channels: the current channels of the rig. Ranges of control bones and of actions are chosen by the user and
            not compared.
    """
    blocking_changes = rig_differences(info.joints, info.rest_matrices, info.meshes, rig)
    has_joint_ranges = all(c.name in rig.joint_names and c.kind != ROTATION_VECTOR for c in info.limits)
    changed_bones = bones_with_changed_range(info.limits, channels) if info.limits and has_joint_ranges else ()
    return RigChanges(name, tuple(blocking_changes), tuple(changed_bones))


def find_changes(scene_rig: SceneRig, entry: bpy.types.PropertyGroup) -> RigChanges:
    """Find the changes of a rig since a model in the list of its mesh was trained.

    Raises:
        FDDAError: the rig or the model cannot be read.
    """
    info = entry_info_of_mesh(scene_rig.mesh_object, entry)
    rig = read_model_rig(scene_rig, info)
    return compare_with_model(entry.name, info, rig, sampled_channels(scene_rig, rig))
