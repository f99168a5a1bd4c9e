# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the values of controls of a rig in every frame, also on the threads of Blender's evaluation."""

from collections.abc import Iterator, Sequence

import bpy
import numpy as np

from ..core.controls import MESH_OWNER, SHAPE_KEY_PATH, Control
from ..core.errors import RigError
from ..core.rig import STATIC_JOINT
from .armature import PoseMatrixReader, rest_matrices
from .arrays import KEY_VALUE_ELEMENT, POSE_CHANNELS, read
from .controls import BoneTransform, bone_transform, canonical_path, number_at, owner_of
from .scene_rig import MIN_VOLUME, SceneRig

MAX_HIDDEN_MOTION = 1e-3
"""Largest motion of a control bone along an axis that is no control, as a part of its length, without a warning."""
ABSENT_INPUTS = "so its extra inputs count as 0"
"""A clause of the warning about a missing mesh, with which a model plays all the same."""


class ControlReader:
    """Reads the values of controls of a rig.

    The locations, rotations and scales of one bone are read together, as one matrix, because a face has hundreds of
    them. It includes the constraints of the bone, because what follows the bone sees them. Only drivers that read the
    channels of a bone do not; then the channels are read. The values of all shape keys of the mesh are read with one
    call.

    Attributes:
        sources: one number of each struct that is read. Whoever depends on them depends on all controls.
        warning: names a mesh that is missing with its controls, or a bone that constraints have moved along an axis
            that is no control; empty for none.
    """

    def __init__(self, scene_rig: SceneRig, controls: tuple[Control, ...]):
        """Prepare to read controls.

        Args:
            controls: C controls.
        """
        self._controls, self._mesh_name, self.warning = controls, scene_rig.mesh_object.name, ""
        channel_bones = set(_read_channel_bones())

        def is_constrained(control: Control, transform: BoneTransform) -> bool:
            owner = owner_of(scene_rig, control.owner)
            bone = owner and owner.type == "ARMATURE" and owner.data.bones.get(transform.bone_name)
            if not bone or (owner.name, bone.name) in channel_bones:
                return False
            return bone.use_inherit_rotation and bone.use_local_location and bone.inherit_scale == "FULL"

        bone_elements: dict[tuple[str, str], list[tuple[int, BoneTransform]]] = {}
        self._single_controls: list[int] = []
        keys_by_owner: dict[str, list[tuple[int, str]]] = {}
        for index, control in enumerate(controls):
            if control.is_shape_key:
                name = SHAPE_KEY_PATH.fullmatch(control.path)["name"]
                keys_by_owner.setdefault(control.owner, []).append((index, bpy.utils.unescape_identifier(name)))
                continue
            transform = bone_transform(control.path)
            is_scale = transform is not None and transform.scale_axis is not None
            if transform is None or (
                transform.element is None and not (is_scale and is_constrained(control, transform))
            ):
                self._single_controls.append(index)
            else:
                bone_elements.setdefault((control.owner, transform.bone_path), []).append((index, transform))
        groups = list(bone_elements.values())
        self._bone_names = [elements[0][1].bone_name for elements in groups]
        self._matrices = np.zeros((len(groups), 4, 4), np.float32)
        bones_by_owner: dict[str, list[int]] = {}
        for bone_index, elements in enumerate(groups):
            index, transform = elements[0]
            if is_constrained(controls[index], transform):
                bones_by_owner.setdefault(controls[index].owner, []).append(bone_index)
        self._constrained_bones = [
            (bone_indices, ConstrainedBones(owner_of(scene_rig, owner), [groups[i] for i in bone_indices]))
            for owner, bone_indices in bones_by_owner.items()
        ]
        numbers = [(i, index, transform) for i, elements in enumerate(groups) for index, transform in elements]
        elements = [(index, 16 * i + 4 * t.element[1] + t.element[0]) for i, index, t in numbers if t.element]
        scales = [(index, 3 * i + t.scale_axis) for i, index, t in numbers if not t.element]
        self._matrix_controls, self._matrix_elements = np.array(elements, np.intp).reshape(-1, 2).T
        self._scale_controls, self._scale_elements = np.array(scales, np.intp).reshape(-1, 2).T
        first_controls = [elements[0][0] for elements in groups] + self._single_controls
        self.sources: tuple[Control, ...] = tuple(controls[index] for index in first_controls)
        self._key_readers = [([i for i, _ in keys], KeyReader([n for _, n in keys])) for keys in keys_by_owner.values()]
        # This property depends on the drivers of all keys; the value of a key only depends on its own driver.
        self.sources += tuple(Control(owner, "use_relative", 0.0, 1.0) for owner in keys_by_owner)
        self.values([owner_of(scene_rig, source.owner) for source in self.sources])

    def read(self, scene_rig: SceneRig, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
        """Read the evaluated values of the controls.

        Returns:
            (C,) float32, each in the unit of its property.
        """
        owners = [owner_of(scene_rig, source.owner) for source in self.sources]
        return self.values([owner and owner.evaluated_get(depsgraph) for owner in owners])

    def values(self, owners: Sequence[bpy.types.ID | None]) -> np.ndarray:
        """Read the values as `read` does, given the owner of each of `sources`, which may be an evaluated datablock."""
        values, self.warning = np.zeros(len(self._controls), np.float32), ""
        bone_count, source_count = len(self._bone_names), len(owners) - len(self._key_readers)
        for (key_controls, reader), shape_keys in zip(self._key_readers, owners[source_count:], strict=True):
            if shape_keys is not None or not self._warn_of_absent_mesh(key_controls[0]):
                values[key_controls] = reader.read(shape_keys)
        remaining = set(range(bone_count))
        for bone_indices, bones in self._constrained_bones:
            owner = owners[bone_indices[0]]
            if getattr(owner, "pose", None) and bones.fits(owner):
                self._matrices[bone_indices], warning = bones.read(owner)
                self.warning = self.warning or warning
                remaining -= set(bone_indices)
        for bone_index in sorted(remaining):
            name, owner = self._bone_names[bone_index], owners[bone_index]
            pose = getattr(owner, "pose", None)
            bone = pose and pose.bones.get(name)
            if bone is None:
                raise RigError(
                    f"'{self._mesh_name}' lacks the control bone '{name}'; name it as before, or record and train this "
                    "rig."
                )
            self._matrices[bone_index] = bone.matrix_basis
        values[self._matrix_controls] = self._matrices.reshape(-1)[self._matrix_elements]
        if len(self._scale_controls):
            lengths = np.linalg.norm(self._matrices[:, :3, :3], axis=1)
            values[self._scale_controls] = lengths.reshape(-1)[self._scale_elements]
        for index, owner in zip(self._single_controls, owners[bone_count:source_count], strict=True):
            control = self._controls[index]
            value = None if owner is None else number_at(owner, control.path)
            if owner is None and self._warn_of_absent_mesh(index):
                value = 0.0
            values[index] = np.nan if value is None else value
        if not (is_finite := np.isfinite(values)).all():
            raise RigError(
                f"'{self._mesh_name}' lacks the control '{self._controls[int(is_finite.argmin())].name}', or it is not "
                "a number; name it as before, or record and train this rig."
            )
        return values

    def _warn_of_absent_mesh(self, index: int) -> bool:
        """Return whether a control without an owner belongs to another mesh: without that mesh, its value is 0."""
        if (match := MESH_OWNER.fullmatch(self._controls[index].owner)) is None:
            return False
        self.warning = (
            f"The mesh '{match['mesh']}' of the model is missing, {ABSENT_INPUTS}; add it again, or record and train "
            "without it."
        )
        return True


class KeyReader:
    """Reads the values of shape keys of one mesh."""

    def __init__(self, names: Sequence[str]):
        """Prepare to read the K shape keys with these names."""
        self._names = names
        self._order: list[str] | None = None

    def read(self, shape_keys: bpy.types.Key | None) -> np.ndarray:
        """Read the values, (K,) float32; NaN for those that the mesh lacks."""
        order = [] if shape_keys is None else shape_keys.key_blocks.keys()
        if order != self._order:
            indices = {name: index for index, name in enumerate(order)}
            # The last element is NaN.
            self._indices = np.array([indices.get(name, len(order)) for name in self._names])
            self._values = np.full(len(order) + 1, np.nan, np.float32)
            self._order = order
        if order:
            read(shape_keys.key_blocks, KEY_VALUE_ELEMENT, self._values[:-1])
        return self._values[self._indices]


class ConstrainedBones:
    """Reads the transforms of bones of one armature after their constraints, relative to rest pose and parent."""

    def __init__(self, armature_object: bpy.types.Object, bones: Sequence[Sequence[tuple[int, BoneTransform]]]):
        """Prepare to read bones.

        Args:
            bones: the numbers of each bone that are controls, at least one.
        """
        self._names = [numbers[0][1].bone_name for numbers in bones]
        rest_bones = [armature_object.data.bones[name] for name in self._names]
        parent_names = [bone.parent.name if bone.parent else STATIC_JOINT for bone in rest_bones]
        names = (*self._names, *parent_names)
        self._reader = PoseMatrixReader(armature_object, names)
        rest, parent_rest = np.split(rest_matrices(armature_object.data, names), 2)
        self._offsets = np.linalg.inv(parent_rest) @ rest
        self._locations = np.empty((len(armature_object.pose.bones), 3), np.float32)
        self._indices = [armature_object.pose.bones.find(name) for name in self._names]
        elements = [{transform.element for _, transform in numbers} for numbers in bones]
        # A connected bone ignores its location.
        self._hidden_axes = np.array(
            [
                [(3, axis) not in of_bone and not bone.use_connect for axis in range(3)]
                for of_bone, bone in zip(elements, rest_bones, strict=True)
            ]
        )
        self._max_motion = MAX_HIDDEN_MOTION * np.array([bone.length for bone in rest_bones])

    def fits(self, armature_object: bpy.types.Object) -> bool:
        """Return whether the armature still has the same number of bones."""
        return self._reader.fits(armature_object)

    def read(self, armature_object: bpy.types.Object) -> tuple[np.ndarray, str]:
        """Read an evaluated armature object.

        Returns:
            (n, 4, 4) float64 matrices, the identity for bones whose parents have no volume; and a warning for a bone
            that moves along an axis that is no control, or an empty text.
        """
        matrices, parent_matrices = np.split(self._reader.read(armature_object).astype(np.float64), 2)
        parent_spaces = parent_matrices @ self._offsets
        is_flat = np.abs(np.linalg.det(parent_spaces)) < MIN_VOLUME
        parent_spaces[is_flat] = np.eye(4)
        local = np.linalg.inv(parent_spaces) @ matrices
        local[is_flat] = np.eye(4)
        read(armature_object.pose.bones, POSE_CHANNELS[0], self._locations)
        moved = (local[:, :3, 3] - self._locations[self._indices]) * self._hidden_axes
        hidden = np.flatnonzero(np.linalg.norm(moved, axis=1) > self._max_motion)
        if not len(hidden):
            return local, ""
        return local, (
            f"A constraint moves the control bone '{self._names[hidden[0]]}' along an axis that is no extra input, so "
            "the model does not follow it; mute it, or record and train this rig."
        )


def _read_channel_bones() -> Iterator[tuple[str, str]]:
    """Yield the names of armature object and bone of each bone whose channels drivers read, without its constraints."""
    for datablock in (*bpy.data.objects, *bpy.data.shape_keys, *bpy.data.armatures, *bpy.data.node_groups):
        # The drivers that run models read all controls.
        animation = None if datablock.is_runtime_data else datablock.animation_data
        for curve in animation.drivers if animation else ():
            for variable in curve.driver.variables:
                for target in variable.targets:
                    if not isinstance(target.id, bpy.types.Object):
                        continue
                    if variable.type == "SINGLE_PROP":
                        transform = bone_transform(canonical_path(target.id, target.data_path))
                        if transform is not None:
                            yield target.id.name, transform.bone_name
                    elif variable.type == "TRANSFORMS" and target.transform_space == "TRANSFORM_SPACE":
                        yield target.id.name, target.bone_target
