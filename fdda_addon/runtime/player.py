# SPDX-License-Identifier: GPL-3.0-or-later
"""The player of a bound object: reads its evaluated pose, and writes the positions that its model has for it."""

import threading
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import bpy
import numpy as np

from ..core.controls import Control
from ..core.errors import FDDAError, ModelError, RigError
from ..core.mathematics.features import FLOAT32_ROUNDING_RATIO
from ..core.mathematics.mask import SkinningBlend
from ..core.rig import STATIC_JOINT
from ..rig.modifier_stack import check_shape_readers, find_shape_readers, replaced_range
from ..rig.reading import PoseReader, read_model_rig
from ..scene.control_reader import ControlReader
from ..scene.mask import mask_key, read_mask
from ..scene.mesh import rest_positions, set_mesh_positions
from ..scene.scene_rig import SceneRig, armature_of
from . import evaluated_copies, rig_signature
from .depsgraph_changes import seen_mode
from .model_files import network_of
from .session import session

POSE_TOLERANCE = 1e-5
"""Meshes of a model share a pose if their objects have moved against each other by no more than this part of a mesh."""


class ModelInputs(NamedTuple):
    """The inputs of a model for one pose.

    Attributes:
        pose_matrices: (J, 4, 4) float32, space and unit of the model.
        controls: (C,) float32.
        warning: what is wrong with the pose; empty for nothing.
    """

    pose_matrices: np.ndarray
    controls: np.ndarray
    warning: str = ""


class Player:
    """Plays the model of one bound object (`player_batch`).

    Attributes:
        object_uid: session id of the object.
        network: the model of the object.
        armature_object_uid, armature_uid, mesh_uid: session ids of the armature object, of its data and of the mesh.
        signature: signature of the rig at its last check (`rig_signature`).
        error: the exception that stopped playback during an evaluation; None if there was none.
        warning, reported_warning: the current warning and the one in the status of the object; empty for none.
        mask: limits the model to a part of the mesh; None for none.
        strength: 0 for linear skinning alone, 1 for the model.
        needs_recreation: whether the armature object has other data, or other bones than those that the player reads.
        depsgraph_keys: keys of the dependency graphs that have evaluated the position buffer.
        has_new_copy: whether Blender has copied the object with its shape keys since changes were read.
        lock: the lock that is held while the pose is read and the positions are written.
    """

    def __init__(self, mesh_object: bpy.types.Object):
        """Create the player of a bound object.

        Raises:
            FDDAError: the model cannot be loaded, or no longer fits the object.
        """
        self.object_uid = mesh_object.session_uid
        self.network = network_of(mesh_object)
        self.error: FDDAError | None = None
        self.needs_recreation = False
        info = self.network.info
        scene_rig = self.scene_rig(mesh_object)
        armature_object, self.mesh_uid = scene_rig.armature_object, mesh_object.data.session_uid
        self.armature_object_uid, self.armature_uid = armature_object.session_uid, armature_object.data.session_uid
        self._vertex_count = info.vertex_count
        self._check_vertex_count(mesh_object)
        replaced = replaced_range(mesh_object)
        check_shape_readers(mesh_object, *replaced)
        # What stands before the rig and reads the shape gets it with shape keys.
        self._mutes_shape_keys = not find_shape_readers(mesh_object, *replaced)
        if mesh_object.data.shape_keys is not None and not self._mutes_shape_keys:
            mesh_object.data.shape_keys.update_tag()
        self.signature = self._read_signature(scene_rig, rig_signature.PARTS)
        rig_signature.check(scene_rig, self.network, self.signature)
        self._pose_reader = self._create_pose_reader(scene_rig)
        self._model_size = float(np.linalg.norm(np.ptp(self._rest_positions(mesh_object), axis=0)))
        self._control_reader = ControlReader(scene_rig, info.controls)
        self._mask_key, self.mask = mask_key(mesh_object), read_mask(mesh_object)
        self._blend: SkinningBlend | None = None
        self.depsgraph_keys: set[tuple[str, int, str]] = set()
        self.has_new_copy = False
        # A render may evaluate on another thread while the window does.
        self.lock = threading.Lock()
        self.strength = 1.0
        self._shown: tuple[ModelInputs, float] | None = None
        self._positions: np.ndarray | None = None
        self.warning, self.reported_warning = "", ""

    @property
    def control_sources(self) -> tuple[Control, ...]:
        """Return the numbers on which all controls of the model depend (`ControlReader.sources`)."""
        return self._control_reader.sources

    def fits_object(self, mesh_object: bpy.types.Object) -> bool:
        """Return whether the object has the same armature, mesh and number of vertices."""
        try:
            self._check_vertex_count(mesh_object)
        except ModelError:
            return False
        armature_object = armature_of(mesh_object)
        return (
            armature_object is not None
            and armature_object.session_uid == self.armature_object_uid
            and mesh_object.data.session_uid == self.mesh_uid
        )

    def check_rig(self, mesh_object: bpy.types.Object, parts: Iterable[str]) -> bool:
        """Return whether parts of the rig have the same signature; if so, check the whole rig if its mesh has changed.

        Raises:
            FDDAError: as `rig_signature.check`, or the armature was removed.
        """
        scene_rig = self.scene_rig(mesh_object)
        if not self._read_signature(scene_rig, parts).items() <= self.signature.items():
            return False
        rig_signature.check(scene_rig, self.network, self.signature)
        return True

    def _read_signature(self, scene_rig: SceneRig, parts: Iterable[str]) -> dict[str, tuple]:
        unread_bones = self.network.info.meshes[0].fingerprint.deformation.get("unread_bones", {})
        return rig_signature.read_signature(scene_rig, unread_bones, parts)

    def update_mask(self, mesh_object: bpy.types.Object, weights_changed: bool) -> bool:
        """Read the mask of the object again if it may have changed.

        Args:
            weights_changed: whether weights of its vertex groups may have changed.

        Returns:
            Whether the mask has changed, so that the pose has to be played again.
        """
        new_key = mask_key(mesh_object)
        if new_key == self._mask_key and not (weights_changed and self.mask is not None):
            return False
        new_mask = read_mask(mesh_object)
        with self.lock:
            self._mask_key, previous_mask, self.mask = new_key, self.mask, new_mask
            if new_mask == previous_mask:
                return False
            self._blend = None if self._blend is None else self._blend.with_mask(new_mask)
            # The shown positions have the previous mask.
            self._shown = None
        return True

    def store_error(self, error: BaseException) -> None:
        """Store any exception in `error`: a getter would lose it, and SystemExit would end Blender."""
        message = f"The model '{self.network.path}' cannot be played ({error!r}); bind it again."
        self.error = error if isinstance(error, FDDAError) else ModelError(message)

    def fits_pose(self, mesh_object: bpy.types.Object, armature_object: bpy.types.Object) -> bool:
        """Return whether the pose of evaluated objects can be read.

        Raises:
            ModelError: the mesh has another number of vertices.
        """
        data = armature_object.data.original
        if data.session_uid != self.armature_uid or not self._pose_reader.fits(armature_object):
            self.needs_recreation = True
            return False
        self._check_vertex_count(mesh_object.original)
        return True

    def read_inputs(
        self,
        mesh_object: bpy.types.Object,
        armature_object: bpy.types.Object,
        owners: Sequence[bpy.types.ID | None],
    ) -> ModelInputs | None:
        """Read the pose of evaluated objects; return None if one has a scale of zero, which hides a character.

        Args:
            owners: the datablocks that own `control_sources`, in their order.

        Raises:
            RigError: a control was removed.
        """
        try:
            pose_matrices = self._pose_reader.read(mesh_object, armature_object)
        except RigError:
            return None
        controls = self._control_reader.values(owners)
        return ModelInputs(pose_matrices, controls, self._control_reader.warning)

    def shares_pose(self, other: "Player", mesh_object: bpy.types.Object, armature_object: bpy.types.Object) -> bool:
        """Return whether evaluated objects have the pose that another player of the model has read.

        They have unless one of the mesh objects has moved against the other since the recording.
        """
        matrix, other_matrix = (
            self._pose_reader.read_transform(mesh_object, armature_object),
            other._pose_reader.transform,
        )
        if matrix == other_matrix:
            return True
        linear, other_linear = (np.array(m.to_3x3(), np.float64) for m in (matrix, other_matrix))
        to_mesh = mesh_object.matrix_world.inverted_safe()
        # Far from the world origin, locations are rounded more.
        distance = (to_mesh.to_3x3() @ mesh_object.matrix_world.translation).length
        tolerance = POSE_TOLERANCE * self._model_size + FLOAT32_ROUNDING_RATIO * distance
        return (
            np.abs(linear - other_linear).max() <= POSE_TOLERANCE * np.abs(linear).max()
            and (matrix.translation - other_matrix.translation).length <= tolerance
        )

    def is_outdated(self, inputs: ModelInputs, mesh_object: bpy.types.Object) -> bool:
        """Return whether the positions are of other inputs or of another strength than the evaluated object has."""
        binding = mesh_object.fdda
        # In mode RIG the modifiers are about to be switched, so the strength does not matter.
        mode = session.overriding_mode(self.object_uid) or binding.mode
        self.strength = 0.0 if mode == "LINEAR" else binding.strength
        if self._shown is None:
            return True
        shown_inputs, shown_strength = self._shown
        return shown_inputs is not inputs or shown_strength != self.strength

    def set_positions(self, inputs: ModelInputs, positions: np.ndarray, mesh_object: bpy.types.Object) -> None:
        """Use positions of the model.

        Args:
            inputs: the inputs for which the model was run.
            positions: (V, 3) float32, of all meshes, in the space of the model. They are not copied.
        """
        # After an exception nothing counts as shown, so the next evaluation tries again.
        self._shown, self.warning = None, inputs.warning
        positions = positions[self.network.vertices]
        if not np.isfinite(positions).all():
            self.warning = f"The model '{self.network.path.name}' gives positions that are not numbers; train it again."
        if self.strength < 1 or self.mask is not None:
            if self._blend is None:
                self._blend = self._create_blend(self.scene_rig(mesh_object.original))
            strengths = np.array([self.strength], np.float32)
            # The blend may overwrite its argument, which is the output of the model.
            positions = self._blend.apply(positions[None].copy(), inputs.pose_matrices[None], strengths)[0]
        self._positions = self.network.to_mesh_space(positions)
        self._shown = inputs, self.strength

    def write_positions(self, buffer: bpy.types.Object, mesh_object: bpy.types.Object) -> None:
        """Write the positions to an evaluated position buffer, even unchanged: an evaluation may have reset them."""
        set_mesh_positions(buffer.data, self._positions)
        if mesh_object.data.shape_keys is not None:
            self.has_new_copy |= not seen_mode(mesh_object)
            if self._mutes_shape_keys:
                evaluated_copies.mute_shape_keys(mesh_object)

    def _create_blend(self, scene_rig: SceneRig) -> SkinningBlend:
        """Create the blend of the model with linear skinning, in the space of the model."""
        rig = self.network.linear_rig(read_model_rig(scene_rig, self.network.info))
        positions, matrices = self._rest_positions(scene_rig.mesh_object), self.network.model.info.rest_matrices
        # The objects may have moved since training; pose matrices refer to the rest pose of the model.
        return SkinningBlend(replace(rig, rest_positions=positions, rest_matrices=matrices), self.mask)

    def _rest_positions(self, mesh_object: bpy.types.Object) -> np.ndarray:
        """Read the rest positions of the mesh, (V, 3) float32, in the space of the model."""
        positions, matrix = rest_positions(mesh_object.data), self.network.mesh_to_model
        if matrix is None:
            return positions
        return (positions @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)

    def _check_vertex_count(self, mesh_object: bpy.types.Object) -> None:
        count, expected = len(mesh_object.data.vertices), self._vertex_count
        if count != expected and mesh_object.mode != "EDIT":
            raise ModelError(
                f"'{mesh_object.name}' has {count} vertices and its model was trained for {expected}; "
                "undo the change, or record and train again."
            )

    def scene_rig(self, mesh_object: bpy.types.Object) -> SceneRig:
        """Return the rig of the object.

        Raises:
            RigError: its armature was removed.
        """
        armature_object = armature_of(mesh_object)
        if armature_object is None:
            raise RigError(
                f"'{mesh_object.name}' has no Armature modifier with an armature any more; undo, or add one and choose "
                "the armature."
            )
        return SceneRig(mesh_object, armature_object)

    def _create_pose_reader(self, scene_rig: SceneRig) -> PoseReader:
        info, armature_object = self.network.info, scene_rig.armature_object
        bones = armature_object.data.bones
        if missing := [name for name in info.joint_names if name not in bones and name != STATIC_JOINT]:
            raise ModelError(
                f"The armature '{armature_object.name}' lacks the joint '{missing[0]}' of the model "
                f"'{self.network.path.name}'; name it as before, or bind a model of this rig."
            )
        return PoseReader(
            scene_rig, info.joint_names, self.network.model.info.rest_matrices, self.network.mesh_to_model
        )
