# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the simulations and caches on which a target depends, and their frame ranges, without an evaluation."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..core.controls import Control
from ..core.errors import PointCacheError, RigError, os_error_text
from ..core.formats.alembic import read_time_range
from ..core.formats.mesh_cache import read_frame_count
from ..scene.node_groups import SIMULATION_NODES, find_time_node
from ..scene.scene_rig import SceneRig
from ..scene.stored_paths import resolve_path
from .modifier_effects import TIME_DEPENDENT_TYPES
from .sources import Sources
from .time_inputs import control_keys, time_inputs

ALEMBIC_SUFFIXES, USD_SUFFIXES = {".abc"}, {".usd", ".usda", ".usdc", ".usdz"}


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


def read_caches(
    scene_rig: SceneRig, target_object: bpy.types.Object, controls: Iterable[Control] = ()
) -> tuple[Cache, ...]:
    """Find the simulations and caches of a target and of everything that it depends on, except the rig and controls."""
    sources = Sources(scene_rig, target_object, [modifier.name for modifier in target_object.modifiers])
    inputs = time_inputs(sources, control_keys(scene_rig, controls))
    caches = [cache for scene_object in sources.objects for cache in _object_caches(scene_object)]
    return tuple(dict.fromkeys([*caches, *(Cache(time_input.description) for time_input in inputs)]))


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
                yield _mesh_cache(modifier, description)
            elif modifier.type == "MESH_SEQUENCE_CACHE":
                if modifier.cache_file is None:
                    raise RigError(f"{_capitalize(description)} has no cache file; choose one, or another target.")
                yield _file_cache(modifier.cache_file, description)
            elif modifier.type in TIME_DEPENDENT_TYPES:
                is_simulation = TIME_DEPENDENT_TYPES[modifier.type] == "is a simulation"
                yield Cache(description, scene.frame_start if is_simulation else None, None, is_simulation)
    for constraint in scene_object.constraints:
        if constraint.type == "TRANSFORM_CACHE" and constraint.cache_file and not constraint.mute:
            yield _file_cache(constraint.cache_file, f"the constraint '{constraint.name}' of '{object_name}'")


def _mesh_cache(modifier: bpy.types.MeshCacheModifier, description: str) -> Cache:
    path = _existing_path(modifier.filepath, description, modifier.id_data)
    if modifier.time_mode != "FRAME" or modifier.play_mode != "SCENE":
        return Cache(description)
    try:
        frame_count = read_frame_count(path)
    except PointCacheError as error:
        raise RigError(f"{_capitalize(description)} plays a file that cannot be read. {error}") from error
    first_sample_time, scale = modifier.frame_start, modifier.frame_scale
    return Cache(description, first_sample_time / scale, (first_sample_time + frame_count - 1) / scale)


def _file_cache(cache_file: bpy.types.CacheFile, description: str) -> Cache:
    path = _existing_path(cache_file.filepath, description, cache_file)
    frame_range = None
    if not cache_file.is_sequence and not cache_file.override_frame:
        try:
            frame_range = _file_frame_range(path, bpy.context.scene.render.fps / bpy.context.scene.render.fps_base)
        except OSError as error:
            raise RigError(f"'{path}' of {description} cannot be read: {os_error_text(error)}.") from error
    if frame_range is None:
        return Cache(description)
    # Blender reads a file at the frame of the scene minus the offset.
    return Cache(description, *(round(frame + cache_file.frame_offset, 3) for frame in frame_range))


def _file_frame_range(path: Path, fps: float) -> tuple[float, float] | None:
    """Read the first and last frame of a cache file; return None if they are unknown."""
    if path.suffix.lower() in ALEMBIC_SUFFIXES:
        time_range = read_time_range(path)
        return None if time_range is None else (time_range[0] * fps, time_range[1] * fps)
    if path.suffix.lower() in USD_SUFFIXES:
        return _usd_frame_range(path)
    return None


def _usd_frame_range(path: Path) -> tuple[float, float] | None:
    """Read the first and last frame from the metadata of a USD layer; return None if they are unknown."""
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
    # Blender shows time code t at frame t, for any frame rate.
    return layer.startTimeCode, layer.endTimeCode


def _existing_path(filepath: str, description: str, owner: bpy.types.ID) -> Path:
    path = resolve_path(filepath, owner.library).resolve() if filepath else None
    if path is None or not path.is_file():
        raise RigError(
            f"{_capitalize(description)} plays the file '{path or filepath}', which is not there; put it there, "
            "or choose another file in the modifier."
        )
    return path


def _capitalize(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"
