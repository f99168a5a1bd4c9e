# SPDX-License-Identifier: GPL-3.0-or-later
"""Record, bind and compare the characters of `rows`. Between recording and binding, `training` trains the models."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.poses import Channel
from fdda_addon.core.progress import run_job
from fdda_addon.evaluation.run import evaluate, set_held_out_pose
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.poses.sampling import model_channels
from fdda_addon.recording.run import record
from fdda_addon.rig.modifier_stack import read_stack
from fdda_addon.rig.reading import read_model_rig
from fdda_addon.runtime.binding import bind
from fdda_addon.runtime.network import Network
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.mesh import evaluated_positions, rest_positions
from fdda_addon.scene.scene_rig import SceneRig, armature_of, find_rig
from fdda_addon.scene.unit import metres_per_unit

from .base import predicted_positions
from .rows import Row

HELD_OUT_SETTINGS = EvaluationSettings(poses=25, seed=1, surface=False)
PLAYED_POSES = 5
"""Number of poses in which the shown mesh is compared with the model's output."""


@dataclass(frozen=True)
class Result:
    """Errors of the model of one mesh of a character.

    Attributes:
        mesh: name of the mesh object.
        linear_mm, fdda_mm: mean error of linear skinning and of the model on held-out poses.
        moved_mm: mean distance of the vertices from their rest positions in these poses.
        difference: largest difference of a coordinate between the shown mesh and the model's output, meters.
    """

    mesh: str
    linear_mm: float
    fdda_mm: float
    moved_mm: float
    difference: float


def record_row(row: Row, folder: Path) -> Iterator[tuple[Path, Path]]:
    """Build a character, save it as `rig.blend` and record each of its meshes.

    Yields:
        For each mesh, the folder of the recording and the path for the model.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    row.build()
    bpy.context.view_layer.update()
    save_copy(folder / "rig.blend")
    for name in row.meshes:
        model = model_path(row, folder, name)
        model.parent.mkdir()
        for _ in record(find_rig(name), model.with_name("recording"), row.recording):
            pass
        yield model.with_name("recording"), model


def model_path(row: Row, folder: Path, mesh: str) -> Path:
    """Return the path for the model of a mesh. Each model has a separate folder, because its report is beside it."""
    assert mesh in row.meshes
    return folder / mesh / f"{mesh}.onnx"


def compare_row(row: Row, folder: Path) -> list[Result]:
    """Measure the errors of the models of a character, bind and play all of them; return one result per mesh."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "rig.blend"))
    rigs = [find_rig(name) for name in row.meshes]
    networks = [Network(model_path(row, folder, name)) for name in row.meshes]
    errors = [_measure_errors(row, scene_rig, network) for scene_rig, network in zip(rigs, networks, strict=True)]
    units = [metres_per_unit(scene_rig.mesh_object) for scene_rig in rigs]
    channels = model_channels(rigs[0], read_model_rig(rigs[0], networks[0].info), networks[0].info)
    for scene_rig, network in zip(rigs, networks, strict=True):
        downstream_names = read_stack(scene_rig.mesh_object).downstream
        bind(scene_rig, network.path)
        for name in downstream_names:
            scene_rig.mesh_object.modifiers[name].show_viewport = False
    if row.is_linked:
        rigs = _link_and_override(rigs[0], folder)
        differences = [max(_measure_differences(rigs, networks * len(rigs), channels))]
    else:
        differences = _measure_differences(rigs, networks, channels)
    return [
        Result(name, *mesh_errors, difference * unit)
        for name, mesh_errors, difference, unit in zip(row.meshes, errors, differences, units, strict=True)
    ]


def _measure_errors(row: Row, scene_rig: SceneRig, network: Network) -> tuple[float, float, float]:
    """Return `linear_mm`, `fdda_mm` and `moved_mm` of a Result."""
    settings = replace(HELD_OUT_SETTINGS, target=row.recording.target)
    if not row.recording.poses:
        settings = replace(settings, poses=0, actions=row.recording.actions)
    held_out = run_job(evaluate(scene_rig, network, settings)).held_out
    rest = rest_positions(scene_rig.mesh_object.data)
    moved_distances = distances(held_out.positions, rest, metres_per_unit(scene_rig.mesh_object))
    return tuple(float(meters.mean()) * 1000 for meters in (held_out.linear, held_out.fdda, moved_distances))


def _measure_differences(rigs: list[SceneRig], networks: list[Network], channels: tuple[Channel, ...]) -> list[float]:
    """Play bound rigs, each armature with different poses.

    Returns:
        For each rig, the largest difference between the shown mesh and the model's output, in units of its mesh.
    """
    armatures = {scene_rig.armature_object: scene_rig for scene_rig in rigs}
    for armature_object in armatures:
        if armature_object.animation_data is not None:
            armature_object.animation_data.action = None
    differences = [0.0] * len(rigs)
    for pose in range(PLAYED_POSES):
        for seed, scene_rig in enumerate(armatures.values(), HELD_OUT_SETTINGS.seed + 1):
            set_held_out_pose(scene_rig, channels, seed, pose)
        bpy.context.view_layer.update()
        pose_differences = [_difference(scene_rig, network) for scene_rig, network in zip(rigs, networks, strict=True)]
        differences = [max(pair) for pair in zip(differences, pose_differences, strict=True)]
    return differences


def _difference(scene_rig: SceneRig, network: Network) -> float:
    """Return the largest difference between the shown mesh and the model's output, computed without the player."""
    if problem := scene_rig.mesh_object.fdda.status:
        raise AssertionError(problem)
    shown_positions = evaluated_positions(scene_rig.mesh_object, bpy.context.evaluated_depsgraph_get())
    return float(np.abs(shown_positions - predicted_positions(scene_rig, network)).max())


def _link_and_override(scene_rig: SceneRig, folder: Path) -> list[SceneRig]:
    """Save the bound character as a library, link it into a new file, and create two library overrides of it."""
    collection = bpy.data.collections.new("Character")
    bpy.context.scene.collection.children.link(collection)
    for scene_object in (scene_rig.mesh_object, scene_rig.armature_object):
        bpy.context.scene.collection.objects.unlink(scene_object)
        collection.objects.link(scene_object)
    library = folder / "library.blend"
    save_copy(library)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    with bpy.data.libraries.load(str(library), link=True, relative=True) as (_, linked_data):
        linked_data.collections = ["Character"]
    rigs = []
    for _ in range(2):
        override = linked_data.collections[0].override_hierarchy_create(
            bpy.context.scene, bpy.context.view_layer, do_fully_editable=True
        )
        mesh_object = next(o for o in override.all_objects if o.type == "MESH")
        rigs.append(SceneRig(mesh_object, armature_of(mesh_object)))
    return rigs
