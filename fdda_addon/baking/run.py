# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes an action: writes the positions of a model in each frame to a file that plays without the add-on."""

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import FDDAError, OutputError, WrongUsageError, os_error_text
from ..core.files import file_kind
from ..core.files.output import atomic_write, atomic_write_all, check_outputs
from ..core.formats.point_cache import PointCacheWriter, read_point_cache
from ..core.mathematics.mask import SkinningBlend
from ..core.progress import Job, Progress
from ..poses.clip import Clip, find_clips
from ..poses.clip_player import clip_player
from ..rig.modifier_stack import check_evaluable, read_stack
from ..rig.reading import PoseReader
from ..runtime.binding import model_disabled
from ..runtime.network import Network
from ..runtime.opened_model import OpenedModel, open_model
from ..scene.blend_file import save_copy
from ..scene.control_reader import ControlReader
from ..scene.mask import read_mask
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import deformation_disabled, temporary_attributes, temporary_pose, temporary_visibility
from ..scene.time_stretching import frames_covering
from .baked_mesh import check_local, play_point_cache, play_shape_keys, temporary_copy

POINT_CACHE_SUFFIX, BLEND_SUFFIX = ".pc2", ".blend"
MAX_FRAME = 1048574
"""Largest frame number of Blender; the smallest frame number is -MAX_FRAME."""
MAX_BATCH_FRAMES = 32
MAX_BATCH_BYTES = 6 << 20
"""Limits of a batch of frames for which the model runs at once: the number of frames, and the size of their positions.
They keep each step of the generator short."""


@dataclass(frozen=True)
class BakeSettings:
    """Settings of a bake.

    Attributes:
        action: name of the action; empty for the animation of the scene.
        frames: first and last frame; None for the frames of the action, or of the scene if there is no action.
        shape_keys: whether to write the positions as shape keys into the .blend file, instead of into a point cache.
        overwrite: whether to replace existing files (`core.files.output.check_outputs`).
        strength: 0 for linear skinning alone, 1 for the model; None for the strength of the object in each frame.
    """

    action: str = ""
    frames: tuple[int, int] | None = None
    shape_keys: bool = False
    overwrite: bool = False
    strength: float | None = None


@dataclass(frozen=True)
class Bake:
    """The result of a bake.

    Attributes:
        frames: the baked frames.
        files: paths of the written files; the file with the mesh is the first.
    """

    frames: range
    files: tuple[Path, ...]


def bake(scene_rig: SceneRig, model: Path | Network, out: Path, settings: BakeSettings) -> Job[Bake]:
    """Bake an action while the generator is iterated.

    A .pc2 file contains the positions in mesh-object space. A .blend file is a copy of the open file in which the mesh
    plays the positions from a point cache beside the file, or from shape keys. The scene is restored when the generator
    ends, is closed, or raises, and no incomplete file is left.

    Args:
        model: path of the model, or the loaded model.
        out: path of the .pc2 or .blend file to write.
        settings: settings of the bake.

    Raises:
        WrongUsageError: `out` has another extension, or the range of frames is empty or invalid.
        RigError: there is no action of this name, or the rig cannot be posed or replaced.
        ModelError: the model cannot be read, or was trained for another rig.
        OutputError: a file cannot be written.
    """
    files = output_files(out, settings, [model.path if isinstance(model, Network) else model])
    clips = find_clips([scene_rig], [settings.action] if settings.action else [])
    frames = _select_frames(clips, settings.frames)
    if out.suffix == BLEND_SUFFIX:
        check_local(scene_rig.mesh_object)
    with model_disabled(scene_rig.mesh_object), ExitStack() as exit_stack:
        check_evaluable(scene_rig)
        reader = FrameReader(scene_rig, open_model(scene_rig, model), settings.strength)
        stack = read_stack(scene_rig.mesh_object)
        if clips:
            exit_stack.enter_context(clip_player([(scene_rig, ())], clips)).start(clips[0])
        else:
            exit_stack.enter_context(temporary_pose(scene_rig.armature_object, keep_animation=True))
        if out.suffix == POINT_CACHE_SUFFIX:
            with atomic_write(out) as cache:
                yield from _write_frames(cache, reader, frames)
        elif settings.shape_keys:
            with _temporary_point_cache(out) as cache:
                yield from _write_frames(cache, reader, frames)
                with temporary_copy(scene_rig.mesh_object) as mesh_object, _scene_range(frames):
                    play_shape_keys(mesh_object, stack, read_point_cache(cache).positions, frames.start)
                    save_copy(out)
        else:
            with atomic_write_all(*files) as (blend, cache):
                yield from _write_frames(cache, reader, frames)
                with temporary_copy(scene_rig.mesh_object) as mesh_object, _scene_range(frames):
                    play_point_cache(mesh_object, stack, files[1], frames.start)
                    save_copy(blend)
    return Bake(frames, files)


def output_files(out: Path, settings: BakeSettings, inputs: Iterable[Path]) -> tuple[Path, ...]:
    """Return the paths of the files that a bake writes, and check that the files can be written.

    Args:
        out, settings: as for `bake`.
        inputs: paths of the files that the bake reads, besides the open file.

    Returns:
        The paths; the file with the mesh is the first.

    Raises:
        WrongUsageError: the extension is not .pc2 or .blend, or shape keys are requested in a .pc2 file.
        OutputError: a file cannot be written, is an input, or exists as another kind of file.
    """
    if out.suffix not in {POINT_CACHE_SUFFIX, BLEND_SUFFIX}:
        raise WrongUsageError(f"'{out}' ends in neither .pc2 nor .blend; give it the extension of what to write.")
    if settings.shape_keys and out.suffix != BLEND_SUFFIX:
        raise WrongUsageError(f"Shape keys are written into a .blend file; give '{out}' that extension.")
    has_point_cache = out.suffix == BLEND_SUFFIX and not settings.shape_keys
    files = (out, out.with_suffix(POINT_CACHE_SUFFIX)) if has_point_cache else (out,)
    kinds = {BLEND_SUFFIX: file_kind.BLEND, POINT_CACHE_SUFFIX: file_kind.POINT_CACHE}
    check_outputs(
        [(path, kinds[path.suffix]) for path in files], [Path(bpy.data.filepath), *inputs], settings.overwrite
    )
    return files


def _select_frames(clips: tuple[Clip, ...], frames: tuple[int, int] | None) -> range:
    scene = bpy.context.scene
    if frames is None:
        return frames_covering(clips[0].frames) if clips else range(scene.frame_start, scene.frame_end + 1)
    first, last = frames
    if first > last:
        raise WrongUsageError(f"There is nothing to bake from frame {first} to {last}; give the first frame first.")
    if max(abs(first), abs(last)) > MAX_FRAME:
        raise WrongUsageError(f"Blender has frames up to {MAX_FRAME}, not from {first} to {last}; give fewer.")
    return range(first, last + 1)


def _scene_range(frames: range) -> AbstractContextManager[None]:
    """Limit the scene to the baked frames in a block; the saved copy then plays only these."""
    # Blender's frame range begins at 0.
    first, last = max(0, frames.start), max(0, frames[-1])
    scene = bpy.context.scene
    return temporary_attributes(scene, frame_start=first, frame_end=last, use_preview_range=False)


class FrameReader:
    """Reads the inputs of a model frame by frame, and runs the model for several frames at once."""

    def __init__(self, scene_rig: SceneRig, opened: OpenedModel, strength: float | None = None):
        """Prepare to read the inputs of a model.

        Args:
            scene_rig: the rig; its modifiers may be off.
            opened: the model of the rig.
            strength: as in `BakeSettings`.

        Raises:
            RigError: the rig lacks a control of the model.
        """
        self.scene_rig, self.network = scene_rig, opened.network
        info = opened.network.info
        self._pose_reader = PoseReader(scene_rig, info.joint_names, info.rest_matrices)
        self._control_reader = ControlReader(scene_rig, info.controls)
        self._strength = strength
        # The objects may have moved since training; pose matrices refer to the rest pose of the model.
        rig = replace(opened.linear_rig, rest_matrices=info.rest_matrices)
        self._blend = SkinningBlend(rig, read_mask(scene_rig.mesh_object))

    def read(self, frame: int) -> tuple[np.ndarray, ...]:
        """Read the inputs of the model in a frame.

        Returns:
            Pose matrices, (J, 4, 4) float32, mesh-object space; controls, (C,) float32; and the strength.
        """
        bpy.context.scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        scene_objects = (self.scene_rig.mesh_object, self.scene_rig.armature_object)
        pose_matrices = self._pose_reader.read(*(o.evaluated_get(depsgraph) for o in scene_objects))
        strength = self.scene_rig.mesh_object.fdda.strength if self._strength is None else self._strength
        return pose_matrices, self._control_reader.read(self.scene_rig, depsgraph), np.float32(strength)

    def positions(self, inputs: list[tuple[np.ndarray, ...]]) -> np.ndarray:
        """Run the model for several frames.

        Args:
            inputs: for each of N frames, the inputs that `read` returns.

        Returns:
            (N, V, 3) float32, mesh-object space, mesh units; valid until the next call.

        Raises:
            ModelError: the model fails.
            FDDAError: the positions are not finite.
        """
        pose_matrices, controls, strengths = (np.stack(values) for values in zip(*inputs, strict=True))
        positions = self.network.positions(pose_matrices, controls)
        positions = self._blend.apply(positions, pose_matrices, strengths)
        if not np.isfinite(positions).all():
            raise FDDAError(
                f"The model '{self.network.path}' gives positions that are not numbers; look for a scale of zero or a "
                "broken driver in the rig, else train again."
            )
        return positions


def _write_frames(path: Path, reader: FrameReader, frames: range) -> Iterator[Progress]:
    """Write a point cache, and restore the current frame."""
    scene, vertex_count = bpy.context.scene, reader.network.info.vertex_count
    original_frame, original_subframe = scene.frame_current, scene.frame_subframe
    bytes_per_frame = 12 * vertex_count
    batch_size = max(1, min(MAX_BATCH_FRAMES, MAX_BATCH_BYTES // bytes_per_frame))
    scene_rig = reader.scene_rig
    visible_objects = temporary_visibility((scene_rig.mesh_object, scene_rig.armature_object))
    # Only the pose is read.
    deformation = deformation_disabled(scene_rig.mesh_object, scene_rig.mesh_object.modifiers)
    with open(path, "wb") as file, visible_objects, deformation:
        writer = PointCacheWriter(file, vertex_count, frames.start, len(frames))
        batch_inputs = []
        for frame_count, frame in enumerate(frames, 1):
            batch_inputs.append(reader.read(frame))
            if len(batch_inputs) == batch_size or frame_count == len(frames):
                writer.append(reader.positions(batch_inputs))
                batch_inputs.clear()
            yield Progress("frames", frame_count, len(frames))
        writer.finish()
    scene.frame_set(original_frame, subframe=original_subframe)


@contextmanager
def _temporary_point_cache(out: Path) -> Iterator[Path]:
    """Yield the path of a temporary point cache on the same disk as `out`."""
    try:
        with tempfile.TemporaryDirectory(prefix=".fdda-", dir=out.parent, ignore_cleanup_errors=True) as folder:
            yield Path(folder) / f"positions{POINT_CACHE_SUFFIX}"
    except OSError as error:
        raise OutputError(f"Cannot write '{out}': {os_error_text(error)}; nothing was changed.") from error
