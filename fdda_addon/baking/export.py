# SPDX-License-Identifier: GPL-3.0-or-later
"""Exports the open file as its models deform it, with Blender's exporters; runs in a Blender of its own."""

import os
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import bpy

from ..core.errors import DiskFullError, OutputError, RigError
from ..core.files import file_kind
from ..poses.clip import find_clips
from ..poses.clip_player import clip_player
from ..rig.modifier_stack import check_evaluable, deforming_modifiers, is_fdda_modifier
from ..runtime.binding import bind, check_plays, temporary_mode, unbind
from ..scene.action_slots import dependencies
from ..scene.blend_file import blender_path, report_message, save_copy
from ..scene.compatibility import animation_curves
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.stored_paths import stored_path
from ..scene.temporary_state import temporary_attributes, temporary_visibility
from ..scene.time_stretching import frames_covering, time_ratio
from .run import ALEMBIC_SUFFIX, KINDS, BakeSettings

COLLECTION_NAME = "FDDA Bake"
HIDING_PATHS = ("hide_viewport", "hide_render")
MODIFIER_NAME = "FDDA Bake"
"""Name of the Mesh Sequence Cache modifier of a baked mesh."""


def write_bake(
    rigs_and_models: Sequence[tuple[SceneRig, Path]],
    out: Path,
    temporaries: Sequence[Path],
    settings: BakeSettings,
    show_progress: Callable[[int, int], object],
) -> range:
    """Bake the open file, which is changed and not saved itself, so run this in a process of its own.

    Args:
        rigs_and_models: the rigs, each with the path of its model.
        out: path that the first file gets later.
        temporaries: files to write to, in the order of `output_files`.
        settings: settings of the bake.
        show_progress: function of the number of baked frames and of all frames.

    Returns:
        The baked frames.

    Raises:
        RigError: there is no action of this name, or the rig cannot be posed or replaced.
        ModelError: a model cannot be read or played, or was trained for another rig.
        OutputError: a file cannot be written.
    """
    rigs = [_bind_local(scene_rig, model, settings.linear) for scene_rig, model in rigs_and_models]
    mesh_objects, times = [rig.mesh_object for rig in rigs], []
    with ExitStack() as stack:
        for mesh_object in mesh_objects:
            # No keyframe or driver may show the rig.
            stack.enter_context(temporary_mode(mesh_object, mesh_object.fdda.mode))
        for armature_object in dict.fromkeys(rig.armature_object for rig in rigs) if settings.action else ():
            group = [rig for rig in rigs if rig.armature_object == armature_object]
            clips = find_clips(group, [settings.action])
            stack.enter_context(clip_player([(rig, ()) for rig in group], clips)).start(clips[0])
            times.append(clips[0].frames)
        first, last = settings.frames or _default_frames(rigs, times)
        if KINDS[out.suffix.lower()] is file_kind.USD and first < 0:
            raise RigError(f"Blender writes USD files from frame 0 on, not from {first}; write an .abc file.")
        scene = bpy.context.scene
        # Blender's frame range begins at 0. A saved copy plays only the baked frames.
        scene.frame_start, scene.frame_end, scene.use_preview_range = max(0, first), max(0, last), False
        frames, is_copy_saved = range(first, last + 1), len(temporaries) > 1
        names = _exported_names(mesh_objects)
        with _export_state(names, is_copy_saved):
            _export(temporaries[-1], frames, settings.samples, show_progress)
        for mesh_object in mesh_objects:
            check_plays(mesh_object)
        if is_copy_saved:
            _play_alembic(names, temporaries[-1], out.with_suffix(ALEMBIC_SUFFIX), frames)
            save_copy(temporaries[0])
    return frames


def _bind_local(scene_rig: SceneRig, model: Path, linear: Sequence[str]) -> SceneRig:
    """Play a model in renders, on a local object, because modifiers from a library cannot be removed."""
    scene_rig = SceneRig(scene_rig.mesh_object.make_local(), scene_rig.armature_object)
    mesh_object = scene_rig.mesh_object
    unbind(mesh_object)
    check_evaluable(scene_rig)
    bind(scene_rig, model, use_in_render=True)
    mesh_object.fdda.mode = "LINEAR" if mesh_object.name in linear else "FDDA"
    check_plays(mesh_object)
    return scene_rig


def _default_frames(rigs: Sequence[SceneRig], times: Sequence[range]) -> tuple[int, int]:
    """Return the first and last frame of an action; else of the scene, or of the rigs' animation if that is elsewhere.

    Args:
        times: the times of the action; empty for the animation of the scene.
    """
    scene, is_scene = bpy.context.scene, not times
    if is_scene:
        datablocks = dependencies(*(rig.armature_object for rig in rigs), *(rig.mesh_object for rig in rigs))
        for animation in filter(None, (getattr(datablock, "animation_data", None) for datablock in datablocks)):
            strips = [strip for track in animation.nla_tracks for strip in track.strips] if animation.use_nla else []
            bounds = [(strip.frame_start, strip.frame_end) for strip in strips]
            bounds += [animation.action.frame_range] if animation.action else []
            times = [*times, *(range(round(start), round(end) + 1) for start, end in bounds)]
    covering = [frames_covering(each) for each in times]
    if is_scene and (not covering or any(f[0] <= scene.frame_end and f[-1] >= scene.frame_start for f in covering)):
        return scene.frame_start, scene.frame_end
    return min(frames[0] for frames in covering), max(frames[-1] for frames in covering)


def _exported_names(mesh_objects: Iterable[bpy.types.Object]) -> dict[bpy.types.Object, str]:
    """Return unique names that no exporter changes, by mesh object."""
    names, used = {}, {scene_object.name for scene_object in bpy.data.objects}
    for mesh_object in mesh_objects:
        name = re.sub(r"\W", "_", mesh_object.name)
        while name in used and name != mesh_object.name:
            name += "_"
        used.add(name)
        names[mesh_object] = name
    return names


@contextmanager
def _export_state(names: dict[bpy.types.Object, str], is_copy_saved: bool) -> Iterator[None]:
    """Put meshes into the collection `COLLECTION_NAME` in the block, shown in renders, with other names.

    Args:
        names: the meshes and their names in the exported file.
        is_copy_saved: whether a copy keeps the modifiers after the model, so that they do not count.
    """
    collection = bpy.data.collections.new(COLLECTION_NAME)
    with ExitStack() as stack:
        # Collections of the user may be hidden.
        bpy.context.scene.collection.children.link(collection)
        stack.callback(bpy.data.collections.remove, collection)
        for mesh_object in names:
            collection.objects.link(mesh_object)
            stack.enter_context(temporary_visibility([mesh_object, armature_of(mesh_object)], HIDING_PATHS))
            attributes = {"name": names[mesh_object], "hide_viewport": False, "hide_render": False}
            stack.enter_context(temporary_attributes(mesh_object, **attributes))
            index = max(i for i, modifier in enumerate(mesh_object.modifiers) if is_fdda_modifier(modifier)) + 1
            for modifier in mesh_object.modifiers[index:] if is_copy_saved else ():
                stack.enter_context(temporary_attributes(modifier, show_render=False))
        yield


def _export(path: Path, frames: range, samples: int, show_progress: Callable[[int, int], object]) -> None:
    """Export the meshes of the collection `COLLECTION_NAME`."""
    count = 0

    def on_frame_change(*_: object) -> None:
        nonlocal count
        count += 1
        # The last one restores the frame.
        show_progress(min(count // samples, len(frames)), len(frames))

    options = {"filepath": blender_path(path), "collection": COLLECTION_NAME, "evaluation_mode": "RENDER"}
    bpy.app.handlers.frame_change_post.append(on_frame_change)
    try:
        if path.suffix.lower() == ALEMBIC_SUFFIX:
            result = bpy.ops.wm.alembic_export(
                **options,
                start=frames[0],
                end=frames[-1],
                xsamples=samples,
                gsamples=samples,
                apply_subdiv=True,
                face_sets=True,
                export_hair=False,
                export_particles=False,
            )
        else:
            # Without the skeleton, which would deform the mesh another time.
            result = bpy.ops.wm.usd_export(
                **options,
                export_animation=True,
                export_subdivision="TESSELLATE",
                export_armatures=False,
                export_shapekeys=False,
                export_textures_mode="KEEP",
                convert_world_material=False,
                xform_op_mode="MAT",
                allow_unicode=True,
                # The mesh has the name of its object, not of its data.
                merge_parent_xform=True,
            )
    except RuntimeError as error:
        raise OutputError(f"Blender could not write the file: {report_message(error)}") from error
    finally:
        bpy.app.handlers.frame_change_post.remove(on_frame_change)
    # On a full disk the exporter of USD reports success.
    if result != {"FINISHED"} or not _is_complete(path):
        raise DiskFullError("Blender has written only a part of the file, the disk may be full; make room.")


def _is_complete(path: Path) -> bool:
    """Return whether a USD file has its end. An Alembic file has, if Blender has not ended while writing it."""
    if KINDS[path.suffix.lower()] is not file_kind.USD:
        return True
    with open(path, "rb") as file:
        if not file.read(8).startswith(b"PXR-USDC"):
            file.seek(-4, os.SEEK_END)
            return file.read().rstrip().endswith(b"}")
        # The table of contents is the end: the number of sections, and 32 bytes for each.
        file.seek(16)
        (table_start,) = struct.unpack("<q", file.read(8))
        file.seek(table_start)
        count = file.read(8)
        return len(count) == 8 and len(file.read()) >= 32 * struct.unpack("<q", count)[0]


def _play_alembic(names: dict[bpy.types.Object, str], alembic: Path, stored: Path, frames: range) -> None:
    """Replace models and the modifiers of the rigs by an Alembic file; the modifiers after the rigs stay.

    Args:
        names: the meshes and their names in the file.
        stored: path that the file gets later. A saved .blend file stores it as a relative path.
        frames: the frames of the file.
    """
    objects_before = set(bpy.data.objects)
    bpy.ops.wm.alembic_import(filepath=blender_path(alembic), always_add_cache_reader=True, set_frame_range=False)
    imported = [scene_object for scene_object in bpy.data.objects if scene_object not in objects_before]
    readers = [o.modifiers[0] for o in imported if o.type == "MESH"]
    # A path ends with the names of the object and of its mesh.
    paths = {reader.object_path.split("/")[-2]: reader.object_path for reader in readers}
    cache_file = readers[0].cache_file
    for mesh_object, exported_name in names.items():
        deforming = [modifier.name for modifier in deforming_modifiers(mesh_object)]
        index = next(i for i, m in enumerate(mesh_object.modifiers) if is_fdda_modifier(m)) - len(deforming)
        unbind(mesh_object)
        mesh_object.fdda.models.clear()
        for name in deforming:
            mesh_object.modifiers.remove(mesh_object.modifiers[name])
        modifier = mesh_object.modifiers.new(MODIFIER_NAME, "MESH_SEQUENCE_CACHE")
        # A new modifier is not the last one if another modifier is pinned to the end of the stack.
        mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), index)
        modifier.cache_file, modifier.object_path = cache_file, paths[exported_name]
        modifier.read_data, modifier.use_vertex_interpolation = {"VERT"}, True
    for scene_object in imported:
        bpy.data.objects.remove(scene_object)
    cache_file.name, cache_file.filepath = stored.name, stored_path(stored)
    if time_ratio() != 1:
        # Blender would read the file at the times of the animation, not at the frames of the scene.
        cache_file.override_frame = True
        for frame in (frames[0], frames[-1] + 1):
            cache_file.frame = frame
            cache_file.keyframe_insert("frame", frame=frame * time_ratio())
        (curve,) = animation_curves(cache_file.animation_data.action)
        curve.extrapolation = "LINEAR"
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"
