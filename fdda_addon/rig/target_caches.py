# SPDX-License-Identifier: GPL-3.0-or-later
"""What in a target depends on time: simulations and caches, with the frames that they have. Nothing is evaluated."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..core.alembic import time_range
from ..core.errors import PointCacheError, RigError, os_error_text
from ..core.mesh_cache import mesh_cache_frames
from ..scene.node_groups import SIMULATION_NODES, find_time_node
from ..scene.scene_rig import SceneRig
from ..scene.stored_paths import resolve_path
from .modifier_stack import TIME_DEPENDENT
from .sources import Sources
from .time_inputs import time_inputs

ALEMBIC, USD = {".abc"}, {".usd", ".usda", ".usdc", ".usdz"}


@dataclass(frozen=True)
class Cache:
    """A simulation or a cache that a target shows.

    Attributes:
        words: what it is, "the modifier 'Cloth' of 'flesh'".
        first, last: the frames that it has; None where there is no end, or nothing says one.
        is_simulation: each frame follows from the one before it, unless it is baked.
        owner: RNA struct whose frames bound it, where they can be set.
    """

    words: str
    first: float | None = None
    last: float | None = None
    is_simulation: bool = False
    owner: "bpy.types.PointCache | bpy.types.Scene | None" = None


def read_caches(scene_rig: SceneRig, target_object: bpy.types.Object) -> tuple[Cache, ...]:
    """The simulations and caches of a target and of all that it reads, the rig left out.

    Raises:
        RigError: a file is missing or damaged.
    """
    sources = Sources(scene_rig, target_object, [modifier.name for modifier in target_object.modifiers])
    found = [cache for scene_object in sources.objects for cache in _caches_of(scene_object)]
    return tuple(dict.fromkeys([*found, *(Cache(moving.words) for moving in time_inputs(sources))]))


def _caches_of(scene_object: bpy.types.Object) -> Iterator[Cache]:
    name = scene_object.name
    for modifier in scene_object.modifiers:
        if modifier.show_viewport:
            yield from _of_modifier(modifier, f"the modifier '{modifier.name}' of '{name}'")
    for constraint in scene_object.constraints:
        if constraint.type == "TRANSFORM_CACHE" and constraint.cache_file and not constraint.mute:
            yield _of_file(constraint.cache_file, f"the constraint '{constraint.name}' of '{name}'")


def _of_modifier(modifier: bpy.types.Modifier, words: str) -> Iterator[Cache]:
    scene = bpy.context.scene
    if modifier.type in {"CLOTH", "SOFT_BODY"}:
        cache = modifier.point_cache
        yield Cache(words, cache.frame_start, cache.frame_end, not cache.is_baked, cache)
    elif modifier.type == "NODES":
        node = find_time_node(modifier.node_group)
        if node is not None and node.bl_idname in SIMULATION_NODES:
            yield Cache(words, scene.frame_start, scene.frame_end, True, scene)
        elif node is not None:
            yield Cache(words)
    elif modifier.type == "MESH_CACHE":
        yield _of_mesh_cache(modifier, words)
    elif modifier.type == "MESH_SEQUENCE_CACHE":
        if modifier.cache_file is None:
            raise RigError(f"{words[0].upper()}{words[1:]} has no cache file; choose one, or another target.")
        yield _of_file(modifier.cache_file, words)
    elif modifier.type in TIME_DEPENDENT:
        is_simulation = TIME_DEPENDENT[modifier.type] == "is a simulation"
        yield Cache(words, scene.frame_start if is_simulation else None, None, is_simulation)


def _of_mesh_cache(modifier: bpy.types.MeshCacheModifier, words: str) -> Cache:
    path = _existing(modifier.filepath, words, modifier.id_data)
    if modifier.time_mode != "FRAME" or modifier.play_mode != "SCENE":
        return Cache(words)
    try:
        frames = mesh_cache_frames(path)
    except PointCacheError as error:
        raise RigError(f"{words[0].upper()}{words[1:]} plays what cannot be read. {error}") from error
    return Cache(words, modifier.frame_start, modifier.frame_start + (frames - 1) / modifier.frame_scale)


def _of_file(cache_file: bpy.types.CacheFile, words: str) -> Cache:
    path = _existing(cache_file.filepath, words, cache_file)
    found = None
    if not cache_file.is_sequence and not cache_file.override_frame:
        try:
            found = _frames_of(path, bpy.context.scene.render.fps / bpy.context.scene.render.fps_base)
        except OSError as error:
            raise RigError(f"'{path}' of {words} cannot be read: {os_error_text(error)}.") from error
    if found is None:
        return Cache(words)
    # Blender asks a file for the frame of the scene less the offset.
    return Cache(words, *(round(frame + cache_file.frame_offset, 3) for frame in found))


def _frames_of(path: Path, fps: float) -> tuple[float, float] | None:
    """First and last frame of a cache file, as far as it says."""
    if path.suffix.lower() in ALEMBIC:
        seconds = time_range(path)
        return None if seconds is None else (seconds[0] * fps, seconds[1] * fps)
    if path.suffix.lower() in USD:
        return _usd_frames(path)
    return None


def _usd_frames(path: Path) -> tuple[float, float] | None:
    """What the head of a USD layer says; None where it says nothing, or cannot be read."""
    bpy.utils.expose_bundled_modules()
    try:
        from pxr import Sdf, Tf
    except ImportError:
        return None
    try:
        layer = Sdf.Layer.OpenAsAnonymous(str(path), True)
    except Tf.ErrorException:
        return None
    if layer is None or not (layer.HasStartTimeCode() and layer.HasEndTimeCode()):
        return None
    # Blender shows time code t at the frame t, whatever the rates.
    return layer.startTimeCode, layer.endTimeCode


def _existing(filepath: str, words: str, owner: bpy.types.ID) -> Path:
    path = resolve_path(filepath, owner.library).resolve() if filepath else None
    if path is None or not path.is_file():
        raise RigError(
            f"{words[0].upper()}{words[1:]} plays the file '{path or filepath}', which is not there; put it there, "
            "or choose another file in the modifier."
        )
    return path
