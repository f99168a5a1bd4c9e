# SPDX-License-Identifier: GPL-3.0-or-later
"""Exported skinning: fitted weights on bones alone, which other programs play as Blender does."""

from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.core.formats.untrained_model import build_untrained_model
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.rig import Fingerprint

from ..baked_files import world_positions
from ..conftest import ELBOW, ELBOW_RIG, evaluated_positions, run
from ..refusals import save_elbow

POSES = 40


def add_bones(rig) -> None:
    """Remove the weights, so that only a cage deforms the mesh; add shape keys and a later modifier."""
    mesh_object, armature_object = rig.mesh_object, rig.armature_object
    cage = mesh_object.copy()
    cage.data, cage.name, cage.display_type = mesh_object.data.copy(), "cage", "WIRE"
    bpy.context.scene.collection.objects.link(cage)
    mesh_object.vertex_groups.clear()
    mesh_object.modifiers.clear()
    modifier = mesh_object.modifiers.new("Cage", "SURFACE_DEFORM")
    modifier.target = cage
    with bpy.context.temp_override(object=mesh_object):
        bpy.context.view_layer.objects.active = mesh_object
        bpy.ops.object.surfacedeform_bind(modifier="Cage")
    mesh_object.modifiers.new("Finer", "SUBSURF")
    mesh_object.parent = None
    armature_object.data.bones["upper"].bbone_segments = 4


@pytest.fixture(params=["own weights", "cage"])
def files(request, tmp_path, capfd) -> tuple[Path, Path, str]:
    """The paths of a recording and of a file with its exported skinning, and the output of the verb."""
    rig = save_elbow(tmp_path / "rig.blend", add_bones if request.param == "cage" else lambda rig: None)
    recording, out = tmp_path / "recording", tmp_path / "out.blend"
    options = ("--object", ELBOW, "--poses", POSES, "--action", "elbow_wave")
    assert run("record", rig, recording, *options) == 0
    capfd.readouterr()
    assert run("export-skinning", rig, recording, out, "--hold-out", "elbow_wave", "--influences", 8) == 0
    return recording, out, capfd.readouterr().out


def skinned_positions(recording, mesh_object: bpy.types.Object, poses) -> np.ndarray:
    """Compute linear skinning with the vertex groups of a mesh, in recorded poses."""
    names = recording.rig.joint_names
    skin = recording.pose_matrices[poses] @ np.linalg.inv(recording.rig.rest_matrices.astype(np.float64))
    rest = np.array([(*vertex.co, 1) for vertex in mesh_object.data.vertices])
    positions = np.zeros((len(poses), len(rest), 3))
    for vertex in mesh_object.data.vertices:
        assert 1 <= len(vertex.groups) <= 8 and abs(sum(group.weight for group in vertex.groups) - 1) < 1e-5
        for group in vertex.groups:
            joint = names.index(mesh_object.vertex_groups[group.group].name)
            positions[:, vertex.index] += group.weight * (skin[:, joint] @ rest[vertex.index])[:, :3]
    return positions


def test_the_copy_follows_fitted_weights_alone_and_its_glb_equals_it(files, tmp_path):
    recording, out, text = files
    recording = read_recording(recording)
    assert text.startswith(f"{out}: 'elbow' follows 2 bones by at most 8 weights per vertex; mm:\n")
    rows = {line.strip().rsplit(maxsplit=3)[0]: float(line.split()[-3]) for line in text.splitlines()[2:]}
    assert ("held-out poses, own weights" in rows) == recording.rig.has_weights
    bpy.ops.wm.open_mainfile(filepath=str(out))
    scene, mesh_object, armature_object = bpy.context.scene, bpy.data.objects[ELBOW], bpy.data.objects[ELBOW_RIG]
    assert [modifier.type for modifier in mesh_object.modifiers] == ["ARMATURE"]
    assert mesh_object.parent == armature_object and not mesh_object.data.shape_keys
    # The frames of the held-out action follow the random poses.
    poses = np.arange(POSES, POSES + 30)
    expected = skinned_positions(recording, mesh_object, poses)
    shown = []
    for frame in range(1, 31):
        scene.frame_set(frame)
        shown.append(evaluated_positions(mesh_object).copy())
    assert np.abs(np.array(shown) - expected).max() < 1e-5
    error = 1000 * np.linalg.norm(expected - recording.positions[poses], axis=2).mean()
    assert rows["elbow_wave, fitted weights"] == pytest.approx(error, abs=2e-3)
    if recording.rig.has_weights:
        assert rows["held-out poses, fitted weights"] < rows["held-out poses, own weights"]
    for scene_object in scene.objects:
        scene_object.select_set(scene_object in (mesh_object, armature_object))
    frames = (1, 9, 20)
    world = world_positions(mesh_object, frames)
    path = str(tmp_path / "a.glb")
    bpy.ops.export_scene.gltf(filepath=path, use_selection=True, export_influence_nb=8, export_frame_range=False)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=path)
    (imported,) = (o for o in bpy.data.objects if o.type == "MESH" and o.name.startswith(ELBOW))
    # A glTF file has vertices of its own, one for each corner with other attributes.
    for positions, frame_positions in zip(world_positions(imported, frames), world, strict=True):
        nearest = np.linalg.norm(positions[:, None] - frame_positions, axis=2).min(axis=1)
        assert nearest.max() < 1e-4


@pytest.mark.one_blender_version
def test_recordings_of_other_rigs_and_wrong_numbers_are_refused(refusal, elbow_files, tmp_path):
    def move_vertex(rig):
        rig.mesh_object.data.vertices[0].co.x += 0.01

    rig, out = save_elbow(tmp_path / "rig.blend", move_vertex), tmp_path / "out.blend"
    text = refusal("export-skinning", rig, elbow_files.recording, out)
    assert text == f"The recording '{elbow_files.recording}' is not of 'elbow' as it is now; record again."
    text = refusal("export-skinning", elbow_files.rig, elbow_files.recording, out, "--hold-out", "jump")
    assert f"The recording '{elbow_files.recording}' has no action 'jump'; record it, too." in text
    assert run("export-skinning", rig, elbow_files.recording, out, "--influences", 17) == 2
    recording, model = read_recording(elbow_files.recording), tmp_path / "longer.onnx"
    mesh = replace(recording.rig.meshes[0], fingerprint=Fingerprint("", "", ""))
    model.write_bytes(build_untrained_model(replace(recording.rig, meshes=(mesh,)), {}))
    text = refusal("export-skinning", elbow_files.rig, elbow_files.recording, out, "--model", model)
    assert f"The model '{model}' is not of the recorded meshes; record all of its meshes, or leave --model out." in text
