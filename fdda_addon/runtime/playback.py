# SPDX-License-Identifier: GPL-3.0-or-later
"""The live bindings of the open file, and the moving of their meshes.

Live bindings hold names and session ids, never RNA references: those do not survive an undo or the load of a file.
They are found anew from the properties of the objects whenever something may have changed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import bpy
import numpy as np

from ..core.errors import FDDAError, ModelError, RigError
from ..core.rig import UNMOVED
from ..core.skinning import LinearLayer
from ..scene.controls import ControlReader
from ..scene.rig import PoseReader, SceneRig, armature_of, is_flat, read_model_rig
from . import nodes, resting, switch
from .model_files import network_of
from .network import Network

_live: dict[int, "LiveBinding"] = {}
_object_count = -1
_constants: dict[tuple, np.ndarray] | None = None


class LiveBinding:
    """One bound object, ready to play."""

    def __init__(self, mesh_object: bpy.types.Object):
        """Args:
            mesh_object: bound.

        Raises:
            FDDAError: the model cannot be loaded, or does not fit the object any more.
        """
        self.name, self.uid = mesh_object.name, mesh_object.session_uid
        self.network = network_of(mesh_object)
        self.armature_uid = _armature(mesh_object).session_uid
        self._reader = self._make_reader(mesh_object)
        self._controls = ControlReader(self._scene_rig(mesh_object), self.network.info.controls)
        self._linear_layer: LinearLayer | None = None
        self._shown: tuple | None = None
        self._cache_name = ""

    def _make_reader(self, mesh_object: bpy.types.Object) -> PoseReader:
        info = self.network.info
        names = tuple(joint.name for joint in info.joints)
        armature_object = _armature(mesh_object)
        if missing := [name for name in names if name not in armature_object.data.bones and name != UNMOVED]:
            raise ModelError(
                f"The armature '{armature_object.name}' lacks the joint '{missing[0]}' of the model "
                f"'{self.network.path.name}'; name it as before, or bind a model of this rig."
            )
        return PoseReader(SceneRig(mesh_object, armature_object), names, info.rest_matrices)

    def find(self) -> bpy.types.Object | None:
        """The object, under whatever name it has now; None when it is gone or no longer bound."""
        found = bpy.data.objects.get(self.name)
        if found is None or found.session_uid != self.uid:
            found = next((o for o in bpy.data.objects if o.session_uid == self.uid), None)
            if found is None:
                return None
            self.name = found.name
        return found if found.fdda.is_bound else None

    def _scene_rig(self, mesh_object: bpy.types.Object) -> SceneRig:
        return SceneRig(mesh_object, _armature(mesh_object))

    def read_pose(
        self, mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Pose matrices (J, 4, 4) and controls (C,), None when the graph does not hold the object, or nobody sees it.

        Raises:
            FDDAError: the mesh or the armature no longer fits the model.
        """
        armature_object = _armature(mesh_object)
        if armature_object.session_uid != self.armature_uid or not self._reader.fits(armature_object):
            self._reader, self.armature_uid = self._make_reader(mesh_object), armature_object.session_uid
        evaluated_mesh = mesh_object.evaluated_get(depsgraph)
        evaluated_armature = armature_object.evaluated_get(depsgraph)
        if not (evaluated_mesh.is_evaluated and evaluated_armature.is_evaluated):
            return None
        if is_flat(evaluated_mesh) or is_flat(evaluated_armature):
            # Animators hide a character so.
            return None
        count, expected = len(mesh_object.data.vertices), self.network.info.vertex_count
        if count != expected and mesh_object.mode != "EDIT":
            raise ModelError(
                f"'{mesh_object.name}' has {count} vertices and its model was trained for {expected}; "
                "undo the change, or record and train again."
            )
        controls = self._controls.read(SceneRig(mesh_object, armature_object), depsgraph)
        return self._reader.read(evaluated_mesh, evaluated_armature), controls

    def find_cache(self, mesh_object: bpy.types.Object) -> bpy.types.Object:
        """The cache object of the mesh object.

        Raises:
            ModelError: it or the modifier that reads it is gone.
        """
        cache = bpy.data.objects.get(self._cache_name)
        if cache is None:
            modifier = nodes.find_modifier(mesh_object)
            cache = nodes.cache_of(modifier) if modifier is not None else None
            if cache is None or len(cache.data.vertices) != self.network.info.vertex_count:
                raise ModelError(
                    f"The modifier of '{mesh_object.name}' that plays the model, or its positions, were removed; "
                    "bind the model again."
                )
            self._cache_name = cache.name
        return cache

    def is_shown(self, key: tuple) -> bool:
        """Whether the cache object holds the positions of this pose already; notes it for the next time."""
        shown, self._shown = self._shown == key, key
        return shown

    def forget_shown(self) -> None:
        """The cache object may hold anything."""
        self._shown = None

    def linear_positions(self, mesh_object: bpy.types.Object, pose_matrices: np.ndarray) -> np.ndarray:
        """(V, 3) float32 of the linear layer alone, mesh-object space, metres."""
        if self._linear_layer is None:
            rig = self.network.linear_rig(read_model_rig(self._scene_rig(mesh_object), self.network.info))
            # The rest pose of the model: the objects may have moved since, and pose matrices refer to it.
            self._linear_layer = LinearLayer(replace(rig, rest_matrices=self.network.info.rest_matrices))
        return self._linear_layer.positions(pose_matrices[None])[0]


_Job = tuple[LiveBinding, bpy.types.Object, tuple[np.ndarray, np.ndarray], float]
"""An object to move: its pose matrices and controls, and its strength, 0 for the linear layer alone."""


def is_outdated(mesh_object: bpy.types.Object) -> bool:
    """Whether an object plays a model whose file has been replaced since it was loaded."""
    live = _live.get(mesh_object.session_uid)
    return live is not None and live.network is not network_of(mesh_object)


def forget() -> None:
    """Look for bound objects anew at the next evaluation."""
    global _object_count
    _live.clear()
    _object_count = -1


def refresh(mesh_object: bpy.types.Object) -> None:
    """Evaluate a bound object anew, also when its pose has not changed."""
    global _object_count
    live = _live.get(mesh_object.session_uid)
    if live is not None:
        live.forget_shown()
    else:
        _object_count = -1
    mesh_object.update_tag()


def playing_objects() -> list[bpy.types.Object]:
    """The objects of the file that a model deforms."""
    return [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_playing]


def rest(scene: bpy.types.Scene) -> None:
    """Before a frame is evaluated: let the models rest until their pose is known."""
    resting.rest(scene, [o for o in _bound_objects() if o.fdda.mode != "RIG"])


def _bound_objects() -> Iterator[bpy.types.Object]:
    return (found for live in _live.values() if (found := live.find()) is not None)


def evaluate(depsgraph: bpy.types.Depsgraph) -> None:
    """Move the meshes of all bound objects to the pose that a dependency graph has evaluated.

    Objects that share a model are evaluated in one call. What cannot play is switched back to its rig and says why.
    """
    rested = resting.wake(depsgraph.scene, _bound_objects())
    _scan()
    rendering = depsgraph.mode == "RENDER"
    jobs: dict[Network, list[_Job]] = {}
    for uid, live in list(_live.items()):
        mesh_object = live.find()
        if mesh_object is None:
            del _live[uid]
            continue
        binding = mesh_object.fdda
        mode = binding.mode
        if mode == "RIG" or (rendering and not binding.use_in_render):
            continue
        strength = binding.strength if mode == "FDDA" else 0.0
        with _failing(mesh_object):
            pose = live.read_pose(mesh_object, depsgraph)
            if pose is not None and not live.is_shown((*(part.tobytes() for part in pose), strength)):
                jobs.setdefault(live.network, []).append((live, mesh_object, pose, strength))
            elif mesh_object in rested and resting.is_updated(depsgraph, mesh_object):
                # The positions are those of this pose already; the mesh has not been given them in this frame.
                live.find_cache(mesh_object).data.update_tag()
    for network, own in jobs.items():
        _move(network, own)


@contextmanager
def constant_positions() -> Iterator[None]:
    """Play without executing models, to measure what the rest of a frame costs: positions stay as they are first."""
    global _constants
    _constants = {}
    try:
        yield
    finally:
        _constants = None


def _positions(network: Network, poses: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    if _constants is not None and (network, len(poses)) in _constants:
        return _constants[network, len(poses)]
    positions = network.positions(*(np.array(parts) for parts in zip(*poses, strict=True)))
    if _constants is not None:
        _constants[network, len(poses)] = positions
    return positions


def _move(network: Network, jobs: list[_Job]) -> None:
    try:
        positions = _positions(network, [pose for _, _, pose, _ in jobs])
    except FDDAError as error:
        for _, mesh_object, _, _ in jobs:
            fail(mesh_object, error)
        return
    for (live, mesh_object, pose, strength), moved in zip(jobs, positions, strict=True):
        with _failing(mesh_object):
            if strength < 1:
                linear = live.linear_positions(mesh_object, pose[0])
                moved = linear + np.float32(strength) * (moved - linear)
            nodes.write_cache(live.find_cache(mesh_object), moved)


class _failing:
    """Switches an object back to its rig when the block fails with an error that is meant for the user."""

    def __init__(self, mesh_object: bpy.types.Object):
        self._mesh_object = mesh_object

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, _trace: object) -> bool:
        if isinstance(error, FDDAError):
            fail(self._mesh_object, error)
            return True
        return False


def fail(mesh_object: bpy.types.Object, error: FDDAError) -> None:
    """Give a mesh back to its rig because its model cannot play, and say why, once."""
    mesh_object.fdda.mode = "RIG"
    mesh_object.fdda.status = str(error)
    print(f"FDDA is switched off for '{mesh_object.name}': {error}")


def _scan() -> None:
    """Find the bound objects when objects have come or gone."""
    global _object_count
    if _object_count == len(bpy.data.objects):
        return
    caches = set()
    for mesh_object in [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]:
        modifier = nodes.find_modifier(mesh_object)
        if modifier is not None:
            cache = nodes.cache_of(modifier)
            is_linked = mesh_object.library is not None
            if cache is None or cache.name in caches or cache.library is not None or cache.is_runtime_data != is_linked:
                # A duplicate still points to the positions of its original, an override to those of the linked object,
                # a linked object to those of its library, which Blender does not evaluate anew.
                cache = nodes.new_cache(mesh_object)
                nodes.set_cache(modifier, cache)
            caches.add(cache.name)
        if mesh_object.fdda.is_playing != (mesh_object.fdda.mode != "RIG"):
            # Linked or appended from a file, which holds the true rig; or a library was reloaded.
            switch.switch_modifiers(mesh_object)
        if mesh_object.fdda.is_playing and mesh_object.session_uid not in _live:
            with _failing(mesh_object):
                _live[mesh_object.session_uid] = LiveBinding(mesh_object)
    _object_count = len(bpy.data.objects)


def _armature(mesh_object: bpy.types.Object) -> bpy.types.Object:
    armature_object = armature_of(mesh_object)
    if armature_object is None:
        raise RigError(f"The armature of '{mesh_object.name}' is gone; give its Armature modifier an armature.")
    return armature_object
