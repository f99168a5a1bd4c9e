# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked files and exported skinning show in every frame what the model or the weights show, without the add-on."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from fdda_addon.baking import run as bake_run
from fdda_addon.baking.export import write_bake
from fdda_addon.baking.run import BakeSettings, bake_file
from fdda_addon.core.errors import OutputError
from fdda_addon.core.formats.untrained_model import build_untrained_model
from fdda_addon.core.progress import Progress
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.rig import Fingerprint
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import SceneRig

from ..baked_files import import_baked, shown_by_model, world_positions
from ..conftest import ELBOW, ELBOW_RIG, evaluated_positions, run
from ..refusals import file_contents, limited_file_size, save_elbow

TOLERANCE = 1e-4
"""Largest distance of a baked position, as a ratio of the size of the mesh."""


def assert_shown(positions: np.ndarray, expected: np.ndarray) -> None:
    size = np.ptp(expected[0], axis=0).max()
    assert positions.shape == expected.shape
    assert np.abs(positions - expected).max() < TOLERANCE * size < 0.01 < np.ptp(expected, axis=0).max()


def move_far_away(rig: SceneRig) -> None:
    armature_object = rig.armature_object
    armature_object.location, armature_object.rotation_euler = (100, -100, 50), (0.3, 0.1, 0.2)
    armature_object.scale = (1.2, 0.7, 1.0)
    bpy.context.scene.unit_settings.scale_length = 0.01


def stretch_time(rig: SceneRig) -> None:
    bpy.context.scene.render.frame_map_new, bpy.context.scene.frame_end = 170, 51


def subdivide(rig: SceneRig) -> None:
    modifier = rig.mesh_object.modifiers.new("Finer", "SUBSURF")
    modifier.levels = modifier.render_levels = 1
    modifier.use_pin_to_last = True
    rig.mesh_object.data.name = "Mesh.001"


def play_strip(rig: SceneRig) -> None:
    """Play the action in a slower strip, outside of the scene's frames, with other names and where renders hide it."""
    animation = rig.armature_object.animation_data
    strip = animation.nla_tracks.new().strips.new("wave", 101, animation.action)
    strip.scale, animation.action = 1.5, None
    rig.mesh_object.name, rig.mesh_object.data.name, rig.armature_object.name = "é l.bow/1:x", "mésh.001", "rïg 1"
    for frame in (101, 104):
        rig.mesh_object.hide_render = frame > 101
        rig.mesh_object.keyframe_insert("hide_render", frame=frame)


@pytest.mark.parametrize(
    ("change", "out", "options", "frames"),
    [
        (move_far_away, "a.abc", ["--samples", 4], [1, 9, 9.25, 30]),
        (stretch_time, "a.usdc", [], [1, 26, 51]),
        (stretch_time, "a.blend", ["--samples", 2], [-3, 1, 4.5, 26, 51]),
        (subdivide, "a.usda", ["--action", "elbow_wave"], [1, 9, 30]),
        (subdivide, "a.blend", ["--action", "elbow_wave"], [1, 9, 30]),
        (play_strip, "a.abc", [], [101, 120, 144]),
        (play_strip, "a.blend", [], [101, 120, 144]),
    ],
)
def test_a_baked_file_shows_the_model_in_every_frame(elbow_files, tmp_path, change, out, options, frames):
    rig, out = save_elbow(tmp_path / "rig.blend", change), tmp_path / out
    expected = shown_by_model(rig, elbow_files.model, frames)
    name = next(o.name for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound)
    assert run("bake", rig, elbow_files.model, out, *options) == 0
    if out.suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=str(out))
        mesh_object = bpy.data.objects[name]
        kept = ["SUBSURF"] if change is subdivide else []
        assert [modifier.type for modifier in mesh_object.modifiers] == ["MESH_SEQUENCE_CACHE", *kept]
        assert [o.type for o in bpy.data.objects].count("MESH") == 1 and not mesh_object.fdda.is_bound
        assert bpy.context.scene.frame_start, bpy.context.scene.frame_end == (max(frames[0], 1), frames[-1])
    else:
        ((name_in_file, mesh_object),) = import_baked(out).items()
        assert name_in_file == re.sub(r"\W", "_", name)
    assert_shown(world_positions(mesh_object, frames), expected)


CODE_WITHOUT_ADD_ON = """
import sys, bpy, numpy as np
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
mesh_object = bpy.data.objects["elbow"]
assert not hasattr(mesh_object, "fdda") and not any("fdda" in name for name in sys.modules)
bpy.context.scene.frame_set(12)
mesh = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
np.save(sys.argv[2], [vertex.co[:] for vertex in mesh.vertices])
"""


@pytest.mark.parametrize("is_overridden", [False, True], ids=["linked", "overridden"])
def test_a_linked_character_is_baked_to_a_folder_that_is_moved(elbow_files, tmp_path, is_overridden, capfd):
    (tmp_path / "in").mkdir()
    rig, out = tmp_path / "in" / "shot.blend", tmp_path / "out" / "a.blend"
    save_copy(rig)
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    with bpy.data.libraries.load(str(elbow_files.rig), link=True) as (_, into):
        into.objects = [ELBOW, ELBOW_RIG]
    for linked in list(into.objects):
        bpy.context.scene.collection.objects.link(linked)
    if is_overridden:
        for linked in list(into.objects):
            linked.override_create(remap_local_usages=True)
    save_copy(rig)
    out.parent.mkdir()
    capfd.readouterr()
    assert run("bake", rig, elbow_files.model, out, "--frames", 1, 12) == 0
    assert capfd.readouterr().out.splitlines() == [
        f"{out.with_suffix('.abc')}: the positions, to be kept beside a.blend",
        f"{out}: 'elbow' in 12 frames of the scene (1 to 12)",
    ]
    assert sorted(file_contents(out.parent)) == ["a.abc", "a.blend"]
    moved, positions = shutil.move(out.parent, tmp_path / "in" / "moved"), tmp_path / "positions.npy"
    command = [sys.executable, "-I", "-c", CODE_WITHOUT_ADD_ON, moved / "a.blend", positions]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    (expected,) = shown_by_model(elbow_files.rig, elbow_files.model, [12])
    assert np.abs(np.load(positions) - expected).max() < 1e-5


def test_all_meshes_of_a_character_are_baked_to_one_file(elbow_files, tmp_path):
    """The names of the meshes differ only in what Alembic does not allow."""
    rigs, names = [], ("el.bow", "el bow", "el_bow")
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    for name in names:
        mesh_object = bpy.data.objects[ELBOW].copy()
        mesh_object.name = name
        bpy.context.scene.collection.objects.link(mesh_object)
        rigs.append((SceneRig(mesh_object, bpy.data.objects[ELBOW_RIG]), elbow_files.model))
    rigs[1][0].mesh_object.fdda.strength = 0.0
    bpy.data.objects.remove(bpy.data.objects[ELBOW])
    outs = tmp_path / "a.blend", tmp_path / "a.abc"
    assert write_bake(rigs, outs[0], outs, BakeSettings(frames=(-2, 12)), lambda *_: None) == range(-2, 13)
    assert set(import_baked(outs[1])) == {"el_bow", "el_bow_", "el_bow__"}
    bpy.ops.wm.open_mainfile(filepath=str(outs[0]))
    full, linear, other = (world_positions(bpy.data.objects[name], [-2, 12]) for name in names)
    assert np.abs(full - linear).max() > 1e-3 and (full == other).all()
    assert_shown(full, shown_by_model(elbow_files.rig, elbow_files.model, [-2, 12]))


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["a.pc2"], 2, "a.pc2' ends in neither .abc, .usd nor .blend; give it the extension of what to write."),
        (["a.abc", "--frames", 9, 8], 2, "There is nothing to bake from frame 9 to 8; give the first frame first."),
        (["a.abc", "--frames", 1, 2000000], 2, "Blender has frames up to 1048574, not from 1 to 2000000; give fewer."),
        (["a.abc", "--samples", 0], 2, "A frame cannot have 0 samples; give 1 or more."),
        (
            ["a.usd", "--samples", 2],
            2,
            "USD files have one sample per frame; write an .abc file for more.",
        ),
        (["a.usd", "--frames", -3, 4], 1, "Blender writes USD files from frame 0 on, not from -3; write an .abc file."),
        (["b/a.abc"], 1, "does not exist; create it first."),
        (["a.abc", "--action", "jump"], 1, "The file has no action 'jump'; its actions: 'elbow_wave'."),
    ],
)
@pytest.mark.one_blender_version
def test_what_cannot_be_baked_is_refused(elbow_files, tmp_path, capfd, arguments, status, words):
    out, *options = arguments
    assert run("bake", elbow_files.rig, elbow_files.model, tmp_path / out, *options) == status
    captured = capfd.readouterr()
    assert words in captured.err and captured.err.count("\n") == 1 and not captured.out
    assert file_contents(tmp_path) == {}


def test_a_model_of_another_rig_is_refused(refusal, elbow_files, tmp_path):
    def move_vertex(rig):
        rig.mesh_object.data.vertices[0].co.x += 0.01

    rig = save_elbow(tmp_path / "rig.blend", move_vertex)
    text = refusal("bake", rig, elbow_files.model, tmp_path / "a.abc")
    assert f"The model '{elbow_files.model}' was trained for another rig: " in text


@pytest.mark.parametrize("name", ["a.abc", "a.usdc", "a.usda"])
def test_a_full_disk_leaves_the_old_files(refusal_on_a_full_disk, elbow_files, tmp_path, name):
    """Blender ends where its Alembic exporter finds the disk full, and that of USD reports success."""
    (tmp_path / name).write_bytes(b"")
    with limited_file_size(30_000):
        text = refusal_on_a_full_disk("bake", elbow_files.rig, elbow_files.model, tmp_path / name, status=75)
    assert "may be full" in text


def test_a_canceled_bake_leaves_no_files(elbow_files, tmp_path):
    settings = BakeSettings(frames=(1, 100_000))
    job = bake_file(elbow_files.rig, elbow_files.model, tmp_path / "a.blend", settings)
    while not isinstance(next(job), Progress):
        pass
    assert len(file_contents(tmp_path)) == 2
    job.close()
    assert file_contents(tmp_path) == {}


@pytest.mark.one_blender_version
@pytest.mark.parametrize(("name", "option"), [("a.blend", "alembic"), ("a.usd", "usd")])
def test_a_blender_without_the_exporter_is_named(elbow_files, tmp_path, monkeypatch, name, option):
    options = SimpleNamespace(**({"alembic": True, "usd": True} | {option: False}))
    monkeypatch.setattr(bake_run, "bpy", SimpleNamespace(app=SimpleNamespace(build_options=options)))
    with pytest.raises(OutputError, match=f"This Blender was built without {'USD' if option == 'usd' else 'Alembic'};"):
        bake_run.output_files(tmp_path / name, BakeSettings(), ())


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
