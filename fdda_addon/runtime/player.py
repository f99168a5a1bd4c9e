# SPDX-License-Identifier: GPL-3.0-or-later
"""The player of a bound object: reads its evaluated pose, runs its model and writes the positions."""

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import bpy
import numpy as np

from ..core.errors import FDDAError, ModelError, RigError
from ..core.formats.pose_repair import repair_pose
from ..core.mathematics.mask import SkinningBlend
from ..core.rig import STATIC_JOINT
from ..rig.modifier_stack import check_shape_readers, find_shape_readers, replaced_range
from ..rig.reading import PoseReader, read_model_rig
from ..scene.control_reader import ControlReader
from ..scene.mask import mask_key, read_mask
from ..scene.mesh import set_mesh_positions
from ..scene.scene_rig import SceneRig, armature_of
from . import driver, evaluated_copies, rig_signature
from .depsgraph_changes import seen_mode
from .model_files import network_of
from .network import Execution
from .session import session


class ModelInputs(NamedTuple):
    """The inputs of a model for one pose.

    Attributes:
        pose_matrices: (J, 4, 4) float32, mesh-object space, mesh units.
        controls: (C,) float32.
        strength: 0 for linear skinning alone, 1 for the model.
    """

    pose_matrices: np.ndarray
    controls: np.ndarray
    strength: float


class Player:
    """Plays the model of one bound object.

    Attributes:
        object_uid: session id of the object.
        network: the model of the object.
        armature_uid, mesh_uid: session ids of the armature data and of the mesh.
        signature: signature of the rig at its last check (`rig_signature`).
        error: the exception that stopped playback during an evaluation; None if there was none.
        warning, reported_warning: the current warning and the one in the status of the object; empty for none.
        mask: limits the model to a part of the mesh; None for none.
        needs_recreation: whether the armature object has other data, or other bones than those that the player reads.
        new_inputs: inputs for which the model has to run; None if the inputs are unchanged.
        has_moved: whether there were new inputs since the last update of the batches, which resets it.
        pose_input_count: number of driver variables whose datablocks `play` reads (`driver_inputs`).
        depsgraph_keys: keys of the dependency graphs that have evaluated the position buffer.
        has_new_copy: whether Blender has copied the object with its shape keys since changes were read.
        lock: the lock that is held from `read_pose` to `write_positions`.
    """

    def __init__(self, mesh_object: bpy.types.Object, buffer: bpy.types.Object):
        """Create the player of a bound object.

        Args:
            mesh_object: the bound object.
            buffer: its position buffer.

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
        self._armature_object_uid, self.armature_uid = armature_object.session_uid, armature_object.data.session_uid
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
        self._control_reader = ControlReader(scene_rig, info.controls)
        self.pose_input_count = 3 + len(self._control_reader.sources)
        self._mask_key, self.mask = mask_key(mesh_object), read_mask(mesh_object)
        self._blend: SkinningBlend | None = None
        self._execution = Execution(self.network, 1)
        self.new_inputs: ModelInputs | None = None
        self.depsgraph_keys: set[tuple[str, int, str]] = set()
        self.has_moved = self.has_new_copy = False
        # A render may evaluate on another thread while the window does.
        self.lock = threading.Lock()
        self._shown_inputs: tuple | None = None
        self._positions: np.ndarray | None = None
        self.warning, self.reported_warning = "", ""
        self._execution.poses[0] = info.rest_matrices
        self._check_finite(self._execution.run())  # The first pose is played after the handlers have run.
        self.update_driver(mesh_object, buffer)

    def update_driver(self, mesh_object: bpy.types.Object, buffer: bpy.types.Object) -> None:
        """Make Blender evaluate the position buffer whenever an input of the model has changed."""
        pose_inputs, dependencies = self.driver_inputs(mesh_object, buffer)
        driver.set_driver_inputs(buffer, [driver.playback_input(buffer), *pose_inputs, *dependencies])

    def driver_inputs(
        self, mesh_object: bpy.types.Object, buffer: bpy.types.Object
    ) -> tuple[list[driver.DriverInput], list[driver.DriverInput]]:
        """Return the driver variables whose datablocks `play` reads, and those that only add dependencies."""
        scene_rig = self.scene_rig(mesh_object)
        dependencies = driver.dependency_inputs(scene_rig, self.network.info.joint_names)
        return driver.pose_inputs(buffer, scene_rig, self._control_reader.sources), dependencies

    def fits_object(self, mesh_object: bpy.types.Object) -> bool:
        """Return whether the object has the same armature, mesh and number of vertices."""
        try:
            self._check_vertex_count(mesh_object)
        except ModelError:
            return False
        armature_object = armature_of(mesh_object)
        return (
            armature_object is not None
            and armature_object.session_uid == self._armature_object_uid
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
            self._shown_inputs = None
        return True

    def play(self, buffer: bpy.types.Object) -> None:
        """Write the positions of the evaluated pose to an evaluated position buffer; store exceptions in `error`."""
        with self.lock, self.capture_errors():
            _, mesh_object, armature_object, *owners = driver.evaluated_inputs(buffer, self.pose_input_count)
            if self.read_pose(mesh_object, armature_object, owners):
                if self.new_inputs is not None:
                    self.run_model()
                self.write_positions(buffer, mesh_object)

    @contextmanager
    def capture_errors(self) -> Iterator[None]:
        """Store any exception of the block in `error`: a getter would lose it, and SystemExit would end Blender."""
        try:
            yield
        except BaseException as error:  # SystemExit too.
            message = f"The model '{self.network.path}' cannot be played ({error!r}); bind it again."
            self.error = error if isinstance(error, FDDAError) else ModelError(message)

    def read_pose(
        self,
        mesh_object: bpy.types.Object | None,
        armature_object: bpy.types.Object | None,
        owners: Sequence[bpy.types.ID | None],
    ) -> bool:
        """Read the pose of evaluated objects into `new_inputs`.

        Args:
            mesh_object: the bound object.
            owners: the datablocks that own `ControlReader.sources`, in their order.

        Returns:
            Whether there are positions to write.
        """
        self.new_inputs = None
        if armature_object is None or mesh_object is None:
            return False
        data = armature_object.data.original
        if data.session_uid != self.armature_uid or not self._pose_reader.fits(armature_object):
            self.needs_recreation = True
            return False
        self._check_vertex_count(mesh_object.original)
        binding = mesh_object.fdda
        try:
            pose_matrices = self._pose_reader.read(mesh_object, armature_object)
        except RigError:
            # Animators hide a character with a scale of zero.
            return False
        controls = self._control_reader.values(owners)
        # In mode RIG the modifiers are about to be switched, so the strength does not matter.
        strength = 0.0 if (session.overriding_mode(self.object_uid) or binding.mode) == "LINEAR" else binding.strength
        inputs = pose_matrices.tobytes(), controls.tobytes(), strength, self._control_reader.warning
        if inputs != self._shown_inputs and not (session.skips_models and self._positions is not None):
            self.warning = self._control_reader.warning
            if not np.isfinite(pose_matrices).all():
                pose_matrices, first_name = repair_pose(pose_matrices, self.network.info)
                self.warning = (
                    f"The pose of the joint '{first_name}' of '{armature_object.name}' is not a number; what it moves "
                    "follows the joint above."
                )
            if self._blend is None and (strength < 1 or self.mask is not None):
                self._blend = self._create_blend(SceneRig(mesh_object.original, armature_object.original))
            self._shown_inputs = inputs
            self.new_inputs = ModelInputs(pose_matrices, controls, strength)
            self.has_moved = True
        return True

    def run_model(self) -> None:
        """Run the model for `new_inputs` alone."""
        # After an exception no inputs count as shown, so the next evaluation tries again.
        self._shown_inputs, shown_inputs = None, self._shown_inputs
        if self.new_inputs.strength > 0:
            self._execution.poses[0] = self.new_inputs.pose_matrices
            self._execution.controls[0] = self.new_inputs.controls
            self._execution.run()
        self.set_positions(self._execution.positions[0])
        self._shown_inputs = shown_inputs

    def set_positions(self, positions: np.ndarray) -> None:
        """Use positions of an execution, (V, 3) float32, as those of `new_inputs`. They are not copied."""
        self._positions = positions
        self._check_finite(positions)
        strength = self.new_inputs.strength
        if strength < 1 or self.mask is not None:
            pose_matrices, strengths = self.new_inputs.pose_matrices[None], np.array([strength], np.float32)
            self._positions = self._blend.apply(positions[None], pose_matrices, strengths)[0]

    def write_positions(self, buffer: bpy.types.Object, mesh_object: bpy.types.Object) -> None:
        """Write the positions to an evaluated position buffer, even unchanged: an evaluation may have reset them."""
        set_mesh_positions(buffer.data, self._positions)
        if mesh_object.data.shape_keys is not None:
            self.has_new_copy |= not seen_mode(mesh_object)
            if self._mutes_shape_keys:
                evaluated_copies.mute_shape_keys(mesh_object)

    def _create_blend(self, scene_rig: SceneRig) -> SkinningBlend:
        """Create the blend of the model with linear skinning."""
        rig = self.network.linear_rig(read_model_rig(scene_rig, self.network.info))
        # The objects may have moved since training; pose matrices refer to the rest pose of the model.
        return SkinningBlend(replace(rig, rest_matrices=self.network.info.rest_matrices), self.mask)

    def _check_finite(self, positions: np.ndarray) -> None:
        if not np.isfinite(positions).all():
            self.warning = f"The model '{self.network.path.name}' gives positions that are not numbers; train it again."

    def _check_vertex_count(self, mesh_object: bpy.types.Object) -> None:
        count, expected = len(mesh_object.data.vertices), self.network.info.vertex_count
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
        return PoseReader(scene_rig, info.joint_names, info.rest_matrices)
