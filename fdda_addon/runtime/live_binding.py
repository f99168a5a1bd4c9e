# SPDX-License-Identifier: GPL-3.0-or-later
"""One bound object that plays: reads its evaluated pose, runs its model, writes its positions."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import bpy
import numpy as np

from ..core.errors import FDDAError, ModelError, RigError
from ..core.mask import SkinningBlend
from ..core.rig import STATIC_JOINT
from ..rig.reading import PoseReader, read_model_rig
from ..scene.arrays import MUTE, write
from ..scene.controls import ControlReader
from ..scene.mask import mask_key, read_mask
from ..scene.mesh import set_mesh_positions
from ..scene.scene_rig import SceneRig, armature_of
from . import driver, rig_check
from .model_files import network_of
from .network import Execution
from .switch import held_mode_of

VIEWPORT_KEY = "fdda_viewport"
"""Custom property of evaluated mesh objects of a viewport's graph; it goes with the evaluated copy."""


class Job(NamedTuple):
    """A pose to execute: pose matrices (J, 4, 4) and controls (C,), float32; strength, 0 for linear skinning alone."""

    pose: np.ndarray
    controls: np.ndarray
    strength: float


class LiveBinding:
    """One bound object, ready to play.

    Attributes:
        uid: session id of the object.
        network: its model.
        form: of its rig, when it was made.
        error: why it cannot play any more, noted while it was evaluated.
        is_outdated: it has to be made anew: its armature has other bones.
        job: what has to be executed for the pose that was read last.
        was_executed: it had a job, since whoever asked set it back.
        execution: where its positions lie.
        graphs: the dependency graphs that know of it: mode, session id of the scene, name of the view layer.
        is_unmarked: it was evaluated with shape keys for a graph that may be that of a viewport, which nobody knows.
        lock: to be held from `read` to `write`.
    """

    is_constant = False
    """No model is executed: what was shown last stays (`playback.constant_positions`)."""

    def __init__(self, mesh_object: bpy.types.Object, buffer: bpy.types.Object):
        """Args:
            mesh_object: bound.
            buffer: its position buffer.

        Raises:
            FDDAError: the model cannot be loaded, or does not fit the object any more.
        """
        self._name, self.uid = mesh_object.name, mesh_object.session_uid
        self.network = network_of(mesh_object)
        self.error: FDDAError | None = None
        self.is_outdated = False
        info = self.network.info
        scene_rig = self.scene_rig(mesh_object)
        self._armature_uid = scene_rig.armature_object.session_uid
        self._check_vertices(mesh_object)
        self.form = rig_check.Form.of(scene_rig)
        self.check_rig(mesh_object)
        self._reader = self._make_reader(scene_rig)
        self._controls = ControlReader(scene_rig, info.controls)
        self._mask_key, self._mask = mask_key(mesh_object), read_mask(mesh_object)
        self._blend: SkinningBlend | None = None
        self.execution = self._own_execution = Execution(self.network, 1)
        self.job: Job | None = None
        self.was_executed = False
        self.graphs: set[tuple[str, int, str]] = set()
        self.is_unmarked = False
        # A render may evaluate on another thread while the window does.
        self.lock = threading.Lock()
        self._shown: tuple | None = None
        self._positions: np.ndarray | None = None
        self._sentence = self._news = ""
        self.execution.poses[0] = info.rest_matrices
        # The first pose is played when the handlers have been called already.
        self._look_for_numbers(self.execution.run())
        self.connect(mesh_object, buffer)

    def connect(self, mesh_object: bpy.types.Object, buffer: bpy.types.Object) -> None:
        """Have the position buffer evaluated whenever what the model reads has been."""
        driver.set_driver_inputs(
            buffer, [driver.playback_input(buffer), *self.sources(mesh_object, buffer), *self.inputs(mesh_object)]
        )

    @property
    def source_count(self) -> int:
        """How many `sources` there are."""
        return 3 + len(self.network.info.controls)

    def sources(self, mesh_object: bpy.types.Object, buffer: bpy.types.Object) -> list[driver.DriverInput]:
        """What is read in `play`."""
        return driver.pose_inputs(buffer, self.scene_rig(mesh_object), self.network.info.controls)

    def inputs(self, mesh_object: bpy.types.Object) -> list[driver.DriverInput]:
        """What the positions follow from besides."""
        return driver.dependency_inputs(self.scene_rig(mesh_object), self.network.info.joint_names)

    def find(self) -> bpy.types.Object | None:
        """The object, under whatever name it has now; None when it is gone or no longer bound."""
        found = bpy.data.objects.get(self._name)
        if found is None or found.session_uid != self.uid:
            found = next((o for o in bpy.data.objects if o.session_uid == self.uid), None)
            if found is None:
                return None
            self._name = found.name
        return found if found.fdda.is_bound else None

    def fits(self, mesh_object: bpy.types.Object) -> bool:
        """Whether the object still has the armature, the mesh, the vertices and the settings that it had."""
        try:
            self._check_vertices(mesh_object)
        except ModelError:
            return False
        armature_object = armature_of(mesh_object)
        return (
            armature_object is not None
            and armature_object.session_uid == self._armature_uid
            and mesh_object.data.session_uid == self.form.mesh
            and self.form.skin[0] == rig_check.settings_of(mesh_object)
        )

    def has_skin(self, mesh_object: bpy.types.Object) -> bool:
        """Whether the object still has the vertex groups, and the settings, that it had."""
        return self.form.skin == rig_check.skin_of(mesh_object)

    def has_bones(self, mesh_object: bpy.types.Object, also_parents: bool) -> bool:
        """Whether its armature still has the bones that it had, in the rest pose and the order that they had."""
        armature_object = armature_of(mesh_object)
        if armature_object is None:
            return False
        armature = armature_object.data
        return rig_check.bones_of(armature) == self.form.bones and not (
            also_parents and rig_check.parents_of(armature) != self.form.parents
        )

    def has_rest(self, mesh_object: bpy.types.Object) -> bool:
        """Whether its vertices still are where they were at rest."""
        return rig_check.rest_of(mesh_object.data) == self.form.rest

    def check_rig(self, mesh_object: bpy.types.Object) -> None:
        """Fail when the rig is no longer the one that the model was trained for.

        Raises:
            FDDAError: as `rig_check.check`.
        """
        rig_check.check(self.scene_rig(mesh_object), self.network, self.form)

    @property
    def has_mask(self) -> bool:
        """Whether the model does not count everywhere."""
        return self._mask is not None

    def follow_mask(self, mesh_object: bpy.types.Object, weights_changed: bool) -> bool:
        """Take the mask that the object has now.

        Args:
            mesh_object: the object.
            weights_changed: its vertex groups may have other weights.

        Returns:
            Whether it is another than before; the pose has to be played again then.
        """
        key = mask_key(mesh_object)
        if key == self._mask_key and not (weights_changed and self._mask is not None):
            return False
        mask = read_mask(mesh_object)
        with self.lock:
            self._mask_key, before, self._mask = key, self._mask, mask
            if mask == before:
                return False
            self._blend = None if self._blend is None else self._blend.with_mask(mask)
            # What was shown had the other mask.
            self._shown = None
        return True

    @property
    def has_news(self) -> bool:
        """Whether `take_news` would say another thing than the last time."""
        return self._news != self._sentence

    def take_news(self) -> str:
        """What is odd about the playback, empty when all is well."""
        self._sentence = self._news
        return self._news

    def play(self, buffer: bpy.types.Object) -> None:
        """Write the positions of the evaluated pose to an evaluated position buffer; note errors in `error`."""
        with self.lock, self.noting_errors():
            _, mesh_object, armature_object, *owners = driver.evaluated_inputs(buffer, self.source_count)
            if self.read(mesh_object, armature_object, owners):
                if self.job is not None:
                    self.execute()
                self.write(buffer, mesh_object)

    @contextmanager
    def noting_errors(self) -> Iterator[None]:
        """Nothing leaves the block: it would be lost in a getter, or, as SystemExit does, end Blender."""
        try:
            yield
        except FDDAError as error:
            self.error = error
        except BaseException as error:  # As above.
            self.error = ModelError(f"The model '{self.network.path}' cannot be played ({error!r}); bind it again.")

    def read(
        self,
        mesh_object: bpy.types.Object | None,
        armature_object: bpy.types.Object | None,
        owners: Sequence[bpy.types.ID | None],
    ) -> bool:
        """Read the pose of evaluated objects; `job` is what has to be executed for it, None where it is as before.

        Returns:
            Whether there is something to show.
        """
        self.job = None
        if armature_object is None or mesh_object is None:
            return False
        if not self._reader.fits(armature_object):
            self.is_outdated = True
            return False
        self._check_vertices(mesh_object.original)
        binding = mesh_object.fdda
        try:
            pose = self._reader.read(mesh_object, armature_object)
        except RigError:
            # Animators hide a character with a scale of zero.
            return False
        controls = self._controls.values(owners)
        # Where its mode says the rig, it is about to be switched, or has just been.
        strength = 0.0 if (held_mode_of(self.uid) or binding.mode) == "LINEAR" else binding.strength
        shown = pose.tobytes(), controls.tobytes(), strength
        if shown != self._shown and not (LiveBinding.is_constant and self._positions is not None):
            self._news = ""
            if not np.isfinite(pose).all():
                pose = self._mended(pose, armature_object.name)
            if self._blend is None and (strength < 1 or self._mask is not None):
                self._blend = self._make_blend(SceneRig(mesh_object.original, armature_object.original))
            self._shown = shown
            self.job = Job(pose, controls, strength)
            self.was_executed = True
        return True

    def execute(self) -> None:
        """Execute `job` alone."""
        self._shown, shown = None, self._shown
        self.execution = self._own_execution
        if self.job.strength > 0:
            self.execution.poses[0], self.execution.controls[0] = self.job.pose, self.job.controls
            self.execution.run()
        self.accept(self.execution, 0)
        self._shown = shown

    def accept(self, execution: Execution, place: int) -> None:
        """Take the positions of `job` from an execution of several poses; they stay there while they are shown."""
        self.execution, self._positions = execution, execution.positions[place]
        self._look_for_numbers(self._positions)
        if self.job.strength < 1 or self._mask is not None:
            playing, strengths = execution.positions[place : place + 1], np.array([self.job.strength], np.float32)
            self._positions = self._blend.apply(playing, self.job.pose[None], strengths)[0]

    def write(self, buffer: bpy.types.Object, mesh_object: bpy.types.Object) -> None:
        """Write the positions to an evaluated position buffer, also unchanged ones: evaluation may have reset them."""
        set_mesh_positions(buffer.data, self._positions)
        # Baking asks here too where renders show the rig, and needs the shape keys.
        if mesh_object.data.shape_keys is not None:
            if VIEWPORT_KEY in mesh_object:
                _mute_shape_keys(mesh_object)
            else:
                self.is_unmarked = True

    def _mended(self, pose: np.ndarray, armature: str) -> np.ndarray:
        """A pose in which every joint is a number: one that is none moves as the next above it does."""
        info = self.network.info
        skin = pose @ np.linalg.inv(info.rest_matrices)
        is_finite = np.isfinite(skin).all(axis=(1, 2))
        for joint in np.flatnonzero(~is_finite):
            above = info.joints[joint].parent  # Mended already: parents come before their children.
            skin[joint] = skin[above] if above >= 0 else np.eye(4)
        lost = info.joints[int(np.argmin(is_finite))].name
        self._news = (
            f"The pose of the joint '{lost}' of '{armature}' is not a number; what it moves follows the joint above."
        )
        return (skin @ info.rest_matrices).astype(np.float32)

    def _make_blend(self, scene_rig: SceneRig) -> SkinningBlend:
        """What blends the model with linear skinning."""
        rig = self.network.linear_rig(read_model_rig(scene_rig, self.network.info))
        # The rest pose of the model: the objects may have moved since, and pose matrices refer to it.
        return SkinningBlend(replace(rig, rest_matrices=self.network.info.rest_matrices), self._mask)

    def _look_for_numbers(self, positions: np.ndarray) -> None:
        if not np.isfinite(positions).all():
            self._news = f"The model '{self.network.path.name}' gives positions that are not numbers; train it again."

    def _check_vertices(self, mesh_object: bpy.types.Object) -> None:
        count, expected = len(mesh_object.data.vertices), self.network.info.vertex_count
        if count != expected and mesh_object.mode != "EDIT":
            raise ModelError(
                f"'{mesh_object.name}' has {count} vertices and its model was trained for {expected}; "
                "undo the change, or record and train again."
            )

    def scene_rig(self, mesh_object: bpy.types.Object) -> SceneRig:
        """The rig of the object.

        Raises:
            RigError: its armature is gone.
        """
        armature_object = armature_of(mesh_object)
        if armature_object is None:
            raise RigError(f"The armature of '{mesh_object.name}' is gone; give its Armature modifier an armature.")
        return SceneRig(mesh_object, armature_object)

    def _make_reader(self, scene_rig: SceneRig) -> PoseReader:
        info, armature_object = self.network.info, scene_rig.armature_object
        known = armature_object.data.bones
        if missing := [name for name in info.joint_names if name not in known and name != STATIC_JOINT]:
            raise ModelError(
                f"The armature '{armature_object.name}' lacks the joint '{missing[0]}' of the model "
                f"'{self.network.path.name}'; name it as before, or bind a model of this rig."
            )
        return PoseReader(scene_rig, info.joint_names, info.rest_matrices)


def _mute_shape_keys(mesh_object: bpy.types.Object) -> None:
    """Spare an evaluated object the mixing of its shape keys, which Blender does whether anything reads them or not.

    Viewports in which the model is on, so what shows the rig has its shape keys. What the user set comes back when
    Blender copies the shape keys anew. Shape keys that another object has too stay as they are.
    """
    keys = mesh_object.data.shape_keys
    # Where the first is muted, all have been since they were copied, or the user muted it: then the others are mixed.
    if keys is not None and not keys.key_blocks[0].mute and mesh_object.original.data.users == 1:
        write(keys.key_blocks, MUTE, np.ones(len(keys.key_blocks), bool))
