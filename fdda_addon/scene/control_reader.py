# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the values of controls of a rig in every frame, also on the threads of Blender's evaluation."""

from collections.abc import Sequence

import bpy
import numpy as np

from ..core.controls import Control
from ..core.errors import RigError
from .bone_transform import BoneTransform, bone_transform
from .controls import number_at, owner_of
from .scene_rig import SceneRig


class ControlReader:
    """Reads the values of controls of a rig.

    The locations and rotations of one bone are read together, as one matrix, because a face has hundreds of them.

    Attributes:
        sources: one control of each struct that is read. Whoever depends on them depends on all controls.
    """

    def __init__(self, scene_rig: SceneRig, controls: tuple[Control, ...]):
        """Prepare to read controls.

        Args:
            scene_rig: the rig.
            controls: C controls.

        Raises:
            RigError: the rig lacks a control.
        """
        self._controls, self._mesh_name = controls, scene_rig.mesh_object.name
        bone_elements: dict[tuple[str, str], list[tuple[int, BoneTransform]]] = {}
        self._single_controls: list[int] = []
        for index, control in enumerate(controls):
            transform = bone_transform(control.path)
            if transform is None or transform.element is None:
                self._single_controls.append(index)
            else:
                bone_elements.setdefault((control.owner, transform.bone_path), []).append((index, transform))
        groups = list(bone_elements.values())
        self._bone_names = [elements[0][1].bone_name for elements in groups]
        self._matrices = np.zeros((len(groups), 4, 4), np.float32)
        self._matrix_controls = np.array([index for elements in groups for index, _ in elements], np.intp)
        self._matrix_elements = np.array(
            [
                16 * bone_index + 4 * transform.element[1] + transform.element[0]
                for bone_index, elements in enumerate(groups)
                for _, transform in elements
            ],
            np.intp,
        )
        first_controls = [elements[0][0] for elements in groups] + self._single_controls
        self.sources: tuple[Control, ...] = tuple(controls[index] for index in first_controls)
        self.values([owner_of(scene_rig, source.owner) for source in self.sources])

    def read(self, scene_rig: SceneRig, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
        """Read the evaluated values of the controls.

        Returns:
            (C,) float32, each in the unit of its property.

        Raises:
            RigError: a control was removed or renamed.
        """
        owners = [owner_of(scene_rig, source.owner) for source in self.sources]
        return self.values([owner and owner.evaluated_get(depsgraph) for owner in owners])

    def values(self, owners: Sequence[bpy.types.ID | None]) -> np.ndarray:
        """Read the values as `read` does, given the owner of each of `sources`, which may be an evaluated datablock."""
        values = np.zeros(len(self._controls), np.float32)
        bone_count = len(self._bone_names)
        for bone_index, (name, owner) in enumerate(zip(self._bone_names, owners[:bone_count], strict=True)):
            pose = getattr(owner, "pose", None)
            bone = pose and pose.bones.get(name)
            if bone is None:
                raise RigError(
                    f"'{self._mesh_name}' lacks the control bone '{name}'; name it as before, or record and train this "
                    "rig."
                )
            self._matrices[bone_index] = bone.matrix_basis
        values[self._matrix_controls] = self._matrices.reshape(-1)[self._matrix_elements]
        for index, owner in zip(self._single_controls, owners[bone_count:], strict=True):
            control = self._controls[index]
            value = None if owner is None else number_at(owner, control.path)
            values[index] = np.nan if value is None else value
        if not (is_finite := np.isfinite(values)).all():
            raise RigError(
                f"'{self._mesh_name}' lacks the control '{self._controls[int(is_finite.argmin())].name}', or it is not "
                "a number; name it as before, or record and train this rig."
            )
        return values
