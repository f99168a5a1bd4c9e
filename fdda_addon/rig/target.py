# SPDX-License-Identifier: GPL-3.0-or-later
"""Target: an object with the same vertices as the mesh of a rig, whose surface a model learns instead of the rig's.

The simulations and caches on which it depends, and the frame ranges of point caches, are found without an evaluation.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.controls import Control
from ..core.errors import RigError
from ..core.recording.index import FRAMES, POSE, SIMULATION
from ..poses.clip import Clip
from ..scene import mesh as mesh_io
from ..scene.arrays import EDGE_ELEMENT, EDGE_INDEX_ELEMENT, read
from ..scene.node_groups import SIMULATION_NODES, find_time_node
from ..scene.scene_rig import SceneRig, is_flat
from ..scene.stored_paths import resolve_path
from ..scene.temporary_state import temporary_attributes
from .modifier_stack import TIME_DEPENDENT_TYPES, downstream_disabled, is_playback_modifier
from .sources import Sources
from .time_inputs import control_keys, time_inputs


@dataclass(frozen=True)
class Cache:
    """A simulation or a cache on which a target depends.

    Attributes:
        description: such as "the modifier 'Cloth' of 'flesh'".
        first_frame, last_frame: the frame range; None if an end is open or unknown.
        is_simulation: each frame depends on the frame before; False for a baked simulation.
        owner: the RNA struct that has the frame range; None if the range cannot be set.
    """

    description: str
    first_frame: float | None = None
    last_frame: float | None = None
    is_simulation: bool = False
    owner: "bpy.types.PointCache | bpy.types.Scene | None" = None


def _object_caches(scene_object: bpy.types.Object) -> Iterator[Cache]:
    object_name = scene_object.name
    for modifier in scene_object.modifiers:
        if modifier.show_viewport:
            description = f"the modifier '{modifier.name}' of '{object_name}'"
            scene = bpy.context.scene
            if modifier.type in {"CLOTH", "SOFT_BODY"}:
                point_cache = modifier.point_cache
                is_simulation = not point_cache.is_baked
                yield Cache(description, point_cache.frame_start, point_cache.frame_end, is_simulation, point_cache)
            elif modifier.type == "NODES":
                node = find_time_node(modifier.node_group)
                if node is not None and node.bl_idname in SIMULATION_NODES:
                    yield Cache(description, scene.frame_start, scene.frame_end, True, scene)
                elif node is not None:
                    yield Cache(description)
            elif modifier.type == "MESH_CACHE":
                _check_file(modifier.filepath, description, scene_object)
                yield Cache(description)
            elif modifier.type == "MESH_SEQUENCE_CACHE":
                if modifier.cache_file is None:
                    raise RigError(f"{_capitalize(description)} has no cache file; choose one, or another target.")
                _check_file(modifier.cache_file.filepath, description, modifier.cache_file)
                yield Cache(description)
            elif modifier.type in TIME_DEPENDENT_TYPES:
                is_simulation = TIME_DEPENDENT_TYPES[modifier.type] == "is a simulation"
                yield Cache(description, scene.frame_start if is_simulation else None, None, is_simulation)
    for constraint in scene_object.constraints:
        if constraint.type == "TRANSFORM_CACHE" and constraint.cache_file and not constraint.mute:
            description = f"the constraint '{constraint.name}' of '{object_name}'"
            _check_file(constraint.cache_file.filepath, description, constraint.cache_file)
            yield Cache(description)


def _check_file(filepath: str, description: str, owner: bpy.types.ID) -> None:
    path = resolve_path(filepath, owner.library).resolve() if filepath else None
    if path is None or not path.is_file():
        raise RigError(
            f"{_capitalize(description)} plays the file '{path or filepath}', which is not there; put it there, "
            "or choose another file in the modifier."
        )


def _capitalize(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"


@dataclass(frozen=True)
class Target:
    """A target of a rig. Holds RNA references, so do not store it.

    Attributes:
        scene_rig: the rig.
        target_object: the object whose surface is learned.
        caches: the simulations and caches that the target depends on.
    """

    scene_rig: SceneRig
    target_object: bpy.types.Object
    caches: tuple[Cache, ...]

    @property
    def follows(self) -> str:
        """Return what determines the target's surface: `POSE`, `FRAMES` or `SIMULATION` (`core.recording.index`)."""
        if any(cache.is_simulation for cache in self.caches):
            return SIMULATION
        return FRAMES if self.caches else POSE

    @property
    def simulations(self) -> tuple[Cache, ...]:
        """Return the caches that Blender simulates while frames are visited."""
        return tuple(cache for cache in self.caches if cache.is_simulation)

    @property
    def first_frame(self) -> int:
        """Return the first frame of the target's simulations, or of the scene if they have no first frame."""
        first_frames = [cache.first_frame for cache in self.simulations if cache.first_frame is not None]
        return int(min(first_frames, default=bpy.context.scene.frame_start))

    def positions(self, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
        """Read the evaluated positions of the target.

        Returns:
            (V, 3) float32, space of the rig's mesh object, mesh units.

        Raises:
            RigError: the target has another number of vertices in this pose.
        """
        evaluated = self.target_object.evaluated_get(depsgraph)
        mesh_object = self.scene_rig.mesh_object.evaluated_get(depsgraph)
        if len(evaluated.data.vertices) != len(self.scene_rig.mesh_object.data.vertices):
            raise RigError(self._count_message(len(evaluated.data.vertices)))
        positions = mesh_io.mesh_positions(evaluated.data)
        target_to_mesh = np.array(mesh_object.matrix_world.inverted_safe() @ evaluated.matrix_world, np.float64)
        if np.array_equal(target_to_mesh, np.eye(4)):
            return positions
        return (positions @ target_to_mesh[:3, :3].T + target_to_mesh[:3, 3]).astype(np.float32)

    def check_mesh(self) -> None:
        """Check that the evaluated mesh of the target has the same vertices and faces as the mesh of the rig.

        Raises:
            RigError: the numbers of vertices or the faces differ.
        """
        target_mesh = self.target_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        mesh = self.scene_rig.mesh_object.data
        if len(target_mesh.vertices) != len(mesh.vertices):
            raise RigError(self._count_message(len(target_mesh.vertices)))
        # A mesh from a cache file may have no faces. Their order, first corner and direction may differ.
        has_faces = len(target_mesh.polygons) and len(mesh.polygons)
        if has_faces and not np.array_equal(_sorted_edges(target_mesh), _sorted_edges(mesh)):
            raise RigError(
                f"The target '{self.name}' has as many vertices as '{self.scene_rig.mesh_object.name}' and other "
                "faces, so its vertices are in another order or of another mesh; export it with the vertices of the "
                "mesh in their order."
            )

    def _count_message(self, count: int) -> str:
        expected = len(self.scene_rig.mesh_object.data.vertices)
        return (
            f"The target '{self.name}' has {count:,} vertices and '{self.scene_rig.mesh_object.name}' has "
            f"{expected:,}; a target needs the same vertices in the same order."
        )

    @property
    def name(self) -> str:
        """Return the name of the target object."""
        return self.target_object.name

    def restart_simulations(self) -> None:
        """Restart the simulations at their first frame, because their cached frames may show other poses."""
        for cache in self.simulations:
            if cache.owner is not None:
                # Posing alone does not invalidate the cache of a soft body.
                cache.owner.id_data.update_tag()
        self.target_object.update_tag()

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Switch the downstream modifiers of the target off, such as a subdivision, and restore them afterwards."""
        with downstream_disabled(self.target_object, checks_vertices=False):
            yield


def find_target(scene_rig: SceneRig, name: str, controls: Iterable[Control] = ()) -> Target:
    """Find the target of a rig by the name of its object.

    Args:
        name: name of the target object.
        controls: numbers that may change the target, because the model reads them.

    Raises:
        RigError: there is no such mesh, it is the mesh of the rig, plays a model, is hidden, has other vertices or
            faces, or a cache file is missing.
    """
    mesh_object, scene = scene_rig.mesh_object, bpy.context.scene
    target_object = scene.objects.get(name)
    if target_object is None or target_object.type != "MESH":
        names = ", ".join(f"'{o.name}'" for o in scene.objects if o.type == "MESH" and o != mesh_object) or "none"
        raise RigError(f"The scene has no mesh object '{name}' to be the target; its other mesh objects: {names}.")
    if target_object == mesh_object:
        raise RigError(
            f"'{name}' cannot be its own target: a target is another object, which shows what '{name}' is to learn; "
            "leave the target out to record the rig itself."
        )
    if any(is_playback_modifier(modifier) and modifier.show_viewport for modifier in target_object.modifiers):
        raise RigError(
            f"The target '{name}' plays a model, so there is nothing to learn from it but that model; let it show its "
            "rig, or choose another object."
        )
    if target_object.mode == "EDIT":
        raise RigError(f"The target '{name}' is in edit mode; leave it first.")
    if is_flat(target_object):
        raise RigError(f"The target '{name}' has a scale of zero; give it another.")
    sources = Sources(scene_rig, target_object, [modifier.name for modifier in target_object.modifiers])
    inputs = time_inputs(sources, control_keys(scene_rig, controls))
    caches = [cache for scene_object in sources.objects for cache in _object_caches(scene_object)]
    target = Target(
        scene_rig,
        target_object,
        tuple(dict.fromkeys([*caches, *(Cache(description) for description, _ in inputs)])),
    )
    if not target_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).is_evaluated:
        raise RigError(f"The target '{name}' is hidden, so Blender does not evaluate it; show it in the viewport.")
    with target.prepared():
        target.check_mesh()
    return target


def check_clips(target: Target, clips: Sequence[Clip], pre_roll: int) -> None:
    """Check that a target has the frames of clips, and that a pre-roll is possible.

    Raises:
        RigError: the target lacks frames, shows no mirrored frames, or cannot use the pre-roll.
    """
    if pre_roll and not target.simulations:
        raise RigError(
            f"The target '{target.name}' is no simulation, so there is nothing that a pre-roll would change; leave it "
            "out."
        )
    if target.follows != POSE and (mirrored_clips := [clip for clip in clips if clip.is_mirrored]):
        raise RigError(
            f"The target '{target.name}' shows the frames of '{mirrored_clips[0].name}' as they are, and not mirrored; "
            "leave the mirrored frames out."
        )
    for clip in clips:
        for cache in target.caches:
            first_frame = None if pre_roll and cache in target.simulations else cache.first_frame
            frames, clip_description = clip.frames, f"{clip.kind} '{clip.name}'"
            if (first_frame is not None and frames[0] < first_frame) or (
                cache.last_frame is not None and frames[-1] > cache.last_frame
            ):
                range_end = "on" if cache.last_frame is None else f"to {cache.last_frame:g}"
                raise RigError(
                    f"The {clip_description} has the frames {frames[0]} to {frames[-1]}, and {cache.description} has "
                    f"those from {cache.first_frame:g} {range_end}; record an action within, or give it more frames."
                )
        if pre_roll and clip.frames[0] - pre_roll < 0 and any(c.owner == bpy.context.scene for c in target.simulations):
            raise RigError(
                f"A pre-roll of {pre_roll} frames before frame {clip.frames[0]} of '{clip.name}' begins before frame "
                f"0, where Blender simulates no Geometry Nodes; move the {clip.kind} to later frames."
            )


@contextmanager
def temporary_frame_range(target: Target, first_frame: int | None, last_frame: int) -> Iterator[None]:
    """Extend the frame ranges of a target's simulations, and restore them afterwards.

    Args:
        first_frame: first frame of all simulations; None to keep their first frames.
        last_frame: the ranges end at this frame or later.
    """
    with ExitStack() as stack:
        for cache in target.simulations:
            if cache.owner is not None:
                # Set the end first, because Blender keeps the end after the start.
                stack.enter_context(temporary_attributes(cache.owner, frame_end=max(cache.owner.frame_end, last_frame)))
                if first_frame is not None:
                    stack.enter_context(temporary_attributes(cache.owner, frame_start=first_frame))
        yield


def _sorted_edges(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return the vertex indices of the edges of faces, (E, 2) int32, in an order that does not depend on the mesh."""
    edges = read(mesh.edges, EDGE_ELEMENT)[read(mesh.loops, EDGE_INDEX_ELEMENT)]
    return np.unique(np.sort(edges, axis=1), axis=0)
