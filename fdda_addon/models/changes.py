# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes of a rig since a model of it was trained."""

from dataclasses import dataclass

import bpy

from ..core.model import ModelInfo
from ..core.poses import ROTATION_VECTOR, Channel, bones_with_changed_range
from ..core.rig import Rig, rig_differences
from ..poses.sampling import sampled_channels
from ..rig.reading import read_model_rig
from ..scene.scene_rig import SceneRig
from .model_list import entry_info


@dataclass(frozen=True)
class Changes:
    """Changes of a rig since a model of it was trained.

    Attributes:
        model: name of the model.
        clauses: changes that prevent playback ("the skin weights differ").
        limits: bones whose range of motion has changed; the model plays, but outside of its training poses.
    """

    model: str
    clauses: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()

    @property
    def prevents_playback(self) -> bool:
        """Whether the changes prevent playback."""
        return bool(self.clauses)

    @property
    def sentence(self) -> str:
        """One sentence with the changes and what to do; empty without changes."""
        if self.clauses:
            return (
                f"{self.model} is of this rig as it was before: {'; '.join(self.clauses)}. Undo the change, or record "
                "and train again."
            )
        if not self.limits:
            return ""
        bones = ", ".join(f"'{bone}'" for bone in self.limits[:3])
        more = f" and {len(self.limits) - 3} more" if len(self.limits) > 3 else ""
        return (
            f"The range of motion of {bones}{more} has changed since {self.model} was trained: it plays, but may be "
            "less exact there. Record and train again."
        )


def compare_with_model(name: str, info: ModelInfo, rig: Rig, channels: tuple[Channel, ...]) -> Changes:
    """Compare a rig and its range of motion with those that a model was trained for.

    Args:
        name, info: the model.
        rig: with the joints of the model (`rig.reading.read_model_rig`).
        channels: of the rig as it stands. The ranges of control bones and those of actions were chosen by the user and
            are not compared.
    """
    clauses = rig_differences(info.joints, info.rest_matrices, info.vertex_count, info.fingerprint, rig)
    covers_joints = all(c.name in rig.joint_names and c.kind != ROTATION_VECTOR for c in info.limits)
    return Changes(
        name,
        tuple(clauses),
        tuple(bones_with_changed_range(info.limits, channels)) if info.limits and covers_joints else (),
    )


def find_changes(scene_rig: SceneRig, entry: bpy.types.PropertyGroup) -> Changes:
    """Find the changes of a rig since a model of its list was trained.

    Raises:
        FDDAError: the rig or the model cannot be read.
    """
    info = entry_info(scene_rig.mesh_object, entry)
    rig = read_model_rig(scene_rig, info)
    return compare_with_model(entry.name, info, rig, sampled_channels(scene_rig, rig))
