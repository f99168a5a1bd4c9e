# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes an action: what a model makes of it, frame by frame, in a file that plays without the add-on."""

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ..core import file_kind
from ..core.errors import FDDAError, OutputError, WrongUsageError, os_error_text
from ..core.mask import SkinningBlend
from ..core.output import atomic_write, atomic_write_all, check_outputs
from ..core.point_cache import PointCacheWriter, read_point_cache
from ..core.progress import Progress
from ..poses.action_range import action_frames
from ..poses.clip import find_action
from ..rig.modifier_stack import check_evaluable, read_stack
from ..rig.reading import PoseReader
from ..runtime.binding import model_disabled
from ..runtime.network import Network
from ..runtime.opened_model import OpenedModel, open_model
from ..scene.armature import clear_pose
from ..scene.blend_file import save_copy
from ..scene.controls import ControlReader
from ..scene.mask import read_mask
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import assign_action, temporary_attributes, temporary_pose, temporary_visibility
from .baked_mesh import check_local, play_point_cache, play_shape_keys, temporary_copy

POINT_CACHE, BLEND = ".pc2", ".blend"
MAX_FRAME = 1048574
"""Blender counts to it, and as far below zero."""
BATCH_FRAMES = 32
BATCH_BYTES = 6 << 20
"""The model is asked for at most so many frames at once, and for no more bytes, so that no step takes long."""


@dataclass(frozen=True)
class BakeSettings:
    """What to bake.

    Attributes:
        action: name of the action; empty for the scene as it is animated.
        frames: first and last frame; None for those of the action, or of the scene.
        shape_keys: write the positions as shape keys into the .blend file, not into a point cache beside it.
        overwrite: as in `core.output.check_outputs`.
        strength: 0 for linear skinning alone, 1 for the model; None for the object's own, frame by frame.
    """

    action: str = ""
    frames: tuple[int, int] | None = None
    shape_keys: bool = False
    overwrite: bool = False
    strength: float | None = None


@dataclass(frozen=True)
class Bake:
    """What was baked: the frames, and the files that were written, that of the mesh first."""

    frames: range
    files: tuple[Path, ...]


def bake(scene_rig: SceneRig, model: Path | Network, out: Path, settings: BakeSettings) -> Iterator[Progress | Bake]:
    """Bake an action; a generator that does the work while it is iterated.

    A .pc2 file holds the positions in mesh-object space. A .blend file is a copy of the open file in which the mesh
    plays them: from a point cache of its name beside it, or from shape keys. The scene is as before when the generator
    ends, is closed, or raises, and no file is half written.

    Args:
        scene_rig: the rig.
        model: of it.
        out: where to write, a .pc2 or a .blend file.
        settings: what to bake.

    Yields:
        Progress, and as the last thing the Bake.

    Raises:
        WrongUsageError: `out` has another extension, or there are no frames.
        RigError: there is no such action, or the rig cannot be posed or replaced.
        ModelError: the model cannot be read, or is of another rig.
        OutputError: a file cannot be written.
    """
    files = output_files(out, settings, [model.path if isinstance(model, Network) else model])
    action = find_action(settings.action) if settings.action else None
    frames = _frames(action, settings.frames)
    if out.suffix == BLEND:
        check_local(scene_rig.mesh_object)
    with model_disabled(scene_rig.mesh_object), ExitStack() as borrowed:
        check_evaluable(scene_rig)
        reader = FrameReader(scene_rig, open_model(scene_rig, model), settings.strength)
        stack = read_stack(scene_rig.mesh_object)
        borrowed.enter_context(_animated(scene_rig.armature_object, action))
        if out.suffix == POINT_CACHE:
            with atomic_write(out) as cache:
                yield from _write_frames(cache, reader, frames)
        elif settings.shape_keys:
            with _scratch(out) as cache:
                yield from _write_frames(cache, reader, frames)
                with temporary_copy(scene_rig.mesh_object) as mesh_object:
                    play_shape_keys(mesh_object, stack, read_point_cache(cache).positions, frames.start)
                    save_copy(out)
        else:
            with atomic_write_all(*files) as (blend, cache):
                yield from _write_frames(cache, reader, frames)
                with temporary_copy(scene_rig.mesh_object) as mesh_object:
                    play_point_cache(mesh_object, stack, files[1], frames.start)
                    save_copy(blend)
    yield Bake(frames, files)


def output_files(out: Path, settings: BakeSettings, inputs: Iterable[Path]) -> tuple[Path, ...]:
    """The files that a bake writes, that of the mesh first.

    Args:
        out, settings: as for `bake`.
        inputs: what is read beside the open file.

    Raises:
        WrongUsageError: another extension than .pc2 and .blend, or shape keys in a .pc2 file.
        OutputError: one cannot be written, or is read, or is a file of another kind.
    """
    if out.suffix not in {POINT_CACHE, BLEND}:
        raise WrongUsageError(f"'{out}' ends in neither .pc2 nor .blend; give it the extension of what to write.")
    if settings.shape_keys and out.suffix != BLEND:
        raise WrongUsageError(f"Shape keys are written into a .blend file; give '{out}' that extension.")
    with_cache = out.suffix == BLEND and not settings.shape_keys
    files = (out, out.with_suffix(POINT_CACHE)) if with_cache else (out,)
    kinds = {BLEND: file_kind.BLEND, POINT_CACHE: file_kind.POINT_CACHE}
    check_outputs(
        [(path, kinds[path.suffix]) for path in files], [Path(bpy.data.filepath), *inputs], settings.overwrite
    )
    return files


def _frames(action: bpy.types.Action | None, frames: tuple[int, int] | None) -> range:
    scene = bpy.context.scene
    if frames is None:
        return range(scene.frame_start, scene.frame_end + 1) if action is None else action_frames(action)
    first, last = frames
    if first > last:
        raise WrongUsageError(f"There is nothing to bake from frame {first} to {last}; give the first frame first.")
    if max(abs(first), abs(last)) > MAX_FRAME:
        raise WrongUsageError(f"Blender has frames up to {MAX_FRAME}, not from {first} to {last}; give fewer.")
    return range(first, last + 1)


class FrameReader:
    """Reads what a model wants to know of a frame, and asks it for many at once."""

    def __init__(self, scene_rig: SceneRig, opened: OpenedModel, strength: float | None = None):
        """Args:
            scene_rig: the rig; its modifiers may be off.
            opened: the model, of this rig.
            strength: as in `BakeSettings`.

        Raises:
            RigError: the rig lacks a control of the model.
        """
        self.scene_rig, self.network = scene_rig, opened.network
        info = opened.network.info
        self._reader = PoseReader(scene_rig, info.joint_names, info.rest_matrices)
        self._controls = ControlReader(scene_rig, info.controls)
        self._strength = strength
        # The rest pose of the model: the objects may have moved since.
        rig = replace(opened.linear_rig, rest_matrices=info.rest_matrices)
        self._blend = SkinningBlend(rig, read_mask(scene_rig.mesh_object))

    def read(self, frame: int) -> tuple[np.ndarray, ...]:
        """Go to a frame; returns the inputs of the model, each without its first axis, and its strength there."""
        bpy.context.scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        scene_objects = (self.scene_rig.mesh_object, self.scene_rig.armature_object)
        pose = self._reader.read(*(scene_object.evaluated_get(depsgraph) for scene_object in scene_objects))
        strength = self.scene_rig.mesh_object.fdda.strength if self._strength is None else self._strength
        return pose, self._controls.read(self.scene_rig, depsgraph), np.float32(strength)

    def positions(self, inputs: list[tuple[np.ndarray, ...]]) -> np.ndarray:
        """(N, V, 3) float32 of frames that were read, mesh-object space, mesh units; valid until the next call.

        Raises:
            ModelError: the model fails.
            FDDAError: it gives positions that are not numbers.
        """
        poses, controls, strengths = (np.stack(values) for values in zip(*inputs, strict=True))
        positions = self.network.positions(poses, controls)
        positions = self._blend.apply(positions, poses, strengths)
        if not np.isfinite(positions).all():
            raise FDDAError(
                f"The model '{self.network.path}' gives positions that are not numbers; look for a scale of zero or a "
                "broken driver in the rig, else train again."
            )
        return positions


def _write_frames(path: Path, reader: FrameReader, frames: range) -> Iterator[Progress]:
    """Write a point cache; the frame is as before afterwards."""
    scene, count = bpy.context.scene, reader.network.info.vertex_count
    frame, subframe = scene.frame_current, scene.frame_subframe
    size = max(1, min(BATCH_FRAMES, BATCH_BYTES // (12 * count)))
    scene_rig = reader.scene_rig
    shown = temporary_visibility((scene_rig.mesh_object, scene_rig.armature_object))
    with open(path, "wb") as file, shown, _undeformed(scene_rig.mesh_object):
        writer = PointCacheWriter(file, count, frames.start, len(frames))
        inputs = []
        for done, number in enumerate(frames, 1):
            inputs.append(reader.read(number))
            if len(inputs) == size or done == len(frames):
                writer.append(reader.positions(inputs))
                inputs.clear()
            yield Progress("frames", done, len(frames))
        writer.finish()
    scene.frame_set(frame, subframe=subframe)


@contextmanager
def _animated(armature_object: bpy.types.Object, action: bpy.types.Action | None) -> Iterator[None]:
    """Let an action alone drive an armature for a while, or what drives it anyway."""
    with temporary_pose(armature_object, [action] if action else (), keep_animation=action is None):
        if action is not None:
            clear_pose(armature_object)
            assign_action(armature_object, action)
        yield


@contextmanager
def _undeformed(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Spare Blender the deformation of a mesh, most of the time of a frame: the pose is all that is read."""
    with ExitStack() as stack:
        for modifier in mesh_object.modifiers:
            stack.enter_context(temporary_attributes(modifier, show_viewport=False))
        if mesh_object.data.shape_keys is not None:
            # A pinned key is merely copied.
            stack.enter_context(temporary_attributes(mesh_object, show_only_shape_key=True, active_shape_key_index=0))
        yield


@contextmanager
def _scratch(out: Path) -> Iterator[Path]:
    """A temporary point cache on the disk that `out` is on."""
    try:
        with tempfile.TemporaryDirectory(prefix=".fdda-", dir=out.parent, ignore_cleanup_errors=True) as folder:
            yield Path(folder) / f"positions{POINT_CACHE}"
    except OSError as error:
        raise OutputError(f"Cannot write '{out}': {os_error_text(error)}; nothing was changed.") from error
