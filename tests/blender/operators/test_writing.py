# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators that write files in another Blender, from the open or saved file: Bake, Export Skinning, Fast Rig."""

import re
import subprocess
import sys
import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from fdda_addon.core.progress import Progress
from fdda_addon.jobs import job, verb_process
from fdda_addon.jobs.job import state_of
from fdda_addon.jobs.verb_process import VerbProcess
from fdda_addon.operators.baking import FDDA_OT_bake
from fdda_addon.operators.fast_rig import FDDA_OT_fast_rig
from fdda_addon.runtime.model_files import write_models
from fdda_addon.scene.scene_rig import find_rig

from ..baked_files import import_baked, read_baked
from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose
from ..refusals import file_contents, refused
from ..scene_state import assert_same_state, scene_state


def test_the_open_file_is_baked_and_stays_as_it_is(active, elbow_files, tmp_path):
    """Unsaved changes are baked too: a keyed strength, and the frames of the scene."""
    bpy.ops.fdda.pack_model()
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 3, 20
    for frame, strength in ((1, 0.0), (20, 1.0)):
        active.fdda.strength = strength
        active.keyframe_insert("fdda.strength", frame=frame)
    before, out = scene_state(find_rig()), tmp_path / "a.blend"
    assert bpy.ops.fdda.bake(filepath=str(out), samples=2) == {"FINISHED"}
    assert_same_state(before, scene_state(find_rig()))
    shown = []
    for frame in (3, 9, 20):
        scene.frame_set(frame)
        shown.append(evaluated_positions(active).copy())
    active.animation_data_clear()
    active.fdda.strength = 1.0
    pose(angle=0.7)
    assert_plays(active, elbow_files.model)
    assert np.abs(read_baked(tmp_path / "a.abc", (3, 9, 20)) - shown).max() < 1e-5
    bpy.ops.wm.open_mainfile(filepath=str(out))
    mesh_object = bpy.data.objects[ELBOW]
    assert (bpy.context.scene.frame_start, bpy.context.scene.frame_end) == (3, 20)
    assert not bpy.data.texts and not mesh_object.fdda.models and mesh_object.parent == bpy.data.objects[ELBOW_RIG]
    bpy.context.scene.frame_set(9)
    assert np.abs(evaluated_positions(mesh_object) - shown[1]).max() < 1e-5


def test_linear_skinning_and_a_range_of_frames_are_baked(active, tmp_path):
    active.fdda.mode = "LINEAR"
    bpy.context.scene.frame_set(9)
    linear = evaluated_positions(active).copy()
    active.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    assert np.abs(linear - evaluated_positions(active)).max() > 1e-4, "the pose tells the two apart"
    active.fdda.mode = "LINEAR"
    options = {"action": "elbow_wave", "use_frames": True, "frame_start": 5, "frame_end": 9}
    assert bpy.ops.fdda.bake(filepath=str(tmp_path / "a.usdc"), **options) == {"FINISHED"}
    import_baked(tmp_path / "a.usdc")
    assert (bpy.context.scene.frame_start, bpy.context.scene.frame_end) == (5, 9)
    assert np.abs(read_baked(tmp_path / "a.usdc", [9])[0] - linear).max() < 1e-5


def test_a_wrong_path_action_or_binding_is_refused(active, tmp_path):
    refused(bpy.ops.fdda.bake, "No file was chosen; give the name of an .abc, .usd or .blend file.")
    refused(lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.txt")), "ends in neither .abc, .usd nor .blend")
    refused(lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.abc"), action="jump"), "The file has no action 'jump'")
    bpy.ops.fdda.unbind()
    refused(lambda: bpy.ops.fdda.bake(filepath=str(tmp_path / "a.abc")), "No model is bound; bind one first")
    assert file_contents(tmp_path) == {}


@pytest.mark.parametrize(
    ("typed", "old_format", "chosen", "file", "file_format"),
    [
        ("a.blend", ".blend", ".abc", "a.abc", ".abc"),
        ("hero.v2", ".abc", ".usdc", "hero.v2.usdc", ".usdc"),
        ("a.USDA", ".blend", ".blend", "a.USDA", ".usdc"),
        ("film/", ".blend", ".abc", "film/", ".abc"),
        ("/", ".blend", ".abc", "/", ".abc"),
    ],
)
def test_file_and_format_in_the_browser_follow_each_other(typed, old_format, chosen, file, file_format):
    browser = SimpleNamespace(filepath=typed, format=chosen, _checked_format=old_format, samples=2)
    changed = (file, file_format) != (typed, chosen) or file_format == ".usdc"
    assert FDDA_OT_bake.check(browser, None) == changed, "the browser is drawn again"
    assert (browser.filepath, browser.format) == (file, file_format)
    assert browser.samples == (1 if file_format == ".usdc" else 2), "USD has one sample per frame"


def test_no_operator_reuses_the_path_or_object_of_its_last_call():
    """Blender would fill missing arguments with those of the last call, and so overwrite another character's file."""
    from importlib import import_module

    from fdda_addon import operators

    classes = [c for name in operators.MODULES for c in import_module(f"fdda_addon.operators.{name}").CLASSES]
    names = [c.bl_idname.partition(".")[2] for c in classes if issubclass(c, bpy.types.Operator)]
    rna = [getattr(bpy.ops.fdda, name).get_rna_type() for name in names]
    subjects = {"FILE_PATH", "DIR_PATH"}
    found = [
        (kind.identifier, p.identifier, p.is_skip_save)
        for kind in rna
        for p in kind.properties
        if p.type == "STRING" and (p.subtype in subjects or p.identifier in {"object", "action", "bone"})
    ]
    assert len(found) > 20 and [entry for entry in found if not entry[2]] == []


def test_the_skinning_of_the_recorded_mesh_is_exported(saved, elbow_files, tmp_path):
    saved.mesh_object.fdda.settings.recording = str(elbow_files.recording)
    out = tmp_path / "skinned.blend"
    assert bpy.ops.fdda.export_skinning(filepath=str(out)) == {"FINISHED"}
    outcome = state_of("export_skinning").outcome
    assert re.fullmatch(r"Wrote skinned.blend\. Mean .*, mm: own weights [\d.]+, fitted weights [\d.]+\.", outcome)
    bpy.ops.wm.open_mainfile(filepath=str(out))
    assert [modifier.type for modifier in bpy.data.objects[ELBOW].modifiers] == ["ARMATURE"]
    assert {group.name for group in bpy.data.objects[ELBOW].vertex_groups} == {"upper", "lower"}


@pytest.fixture
def packed(bound_elbow, tmp_path):
    """Save the bound elbow, with its model packed, into a folder without the model's file."""
    bpy.context.view_layer.objects.active = bound_elbow
    bpy.ops.fdda.pack_model()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "elbow.blend"))
    return tmp_path


def test_a_fast_rig_is_written_and_the_open_file_stays(packed, elbow_files):
    """A point in the name is kept."""
    content = (packed / "elbow.blend").read_bytes()
    assert bpy.ops.fdda.fast_rig(filepath=str(packed / "fast.v2")) == {"FINISHED"}
    assert "fast.v2.blend: 'elbow_rig' has 2 of 2 bones; the model reads 2" in job.state_of("fast_rig").outcome
    assert "times as fast" in job.state_of("fast_rig").outcome
    assert bpy.data.filepath == str(packed / "elbow.blend") and (packed / "elbow.blend").read_bytes() == content
    assert not bpy.data.objects[ELBOW].fdda.is_fast_rig
    bpy.ops.wm.open_mainfile(filepath=str(packed / "fast.v2.blend"))
    mesh_object = bpy.data.objects[ELBOW]
    assert mesh_object.fdda.is_fast_rig and "CorrectiveSmooth" not in mesh_object.modifiers
    pose(angle=0.7)
    assert_plays(mesh_object, elbow_files.model)
    refused(lambda: bpy.ops.fdda.fast_rig(filepath=str(packed / "again.blend")), "'elbow' is a fast rig already")


def test_a_fast_rig_is_not_compared_with_what_is_left_of_the_rig(bound_elbow):
    bound_elbow.fdda.is_fast_rig = True
    bpy.context.view_layer.objects.active = bound_elbow
    sentence = "'elbow' belongs to a fast rig, which lacks modifiers and bones of the full rig"
    for operator in (
        lambda: bpy.ops.fdda.set_mode(mode="RIG"),
        lambda: bpy.ops.fdda.set_mode(mode="NEXT"),
        lambda: bpy.ops.fdda.show_rig(placement="BESIDE"),
        lambda: bpy.ops.fdda.evaluate(source="RANDOM", poses=2),
        bpy.ops.fdda.measure,
        bpy.ops.fdda.profile_frame,
        bpy.ops.fdda.record,
    ):
        refused(operator, sentence)
    assert bound_elbow.fdda.mode == "FDDA"
    assert bpy.ops.fdda.set_mode(mode="LINEAR") == {"FINISHED"}


REMAINING = "'elbow' belongs to a fast rig: without a model, only what is left of its bones and modifiers deforms it."


@pytest.mark.parametrize("is_fast_rig", [False, True])
def test_a_fast_rig_without_a_model_says_what_deforms_the_mesh(packed, is_fast_rig, capfd):
    bpy.data.objects[ELBOW].fdda.is_fast_rig = is_fast_rig
    assert bpy.ops.fdda.unbind() == {"FINISHED"}
    assert (REMAINING in capfd.readouterr().out) == is_fast_rig
    assert bpy.ops.fdda.bind() == {"FINISHED"}
    assert bpy.data.objects[ELBOW].fdda.use_in_render == is_fast_rig
    assert bpy.ops.fdda.remove_model() == {"FINISHED"}
    assert capfd.readouterr().out.count(REMAINING) == is_fast_rig


def test_the_sentence_of_the_verb_is_the_report(packed):
    """The other Blender refuses an armature that another object uses."""
    other = bpy.data.objects.new("other", bpy.data.objects[ELBOW_RIG].data)
    bpy.context.scene.collection.objects.link(other)
    bpy.ops.wm.save_mainfile()
    out = packed / "fast.blend"
    refused(lambda: bpy.ops.fdda.fast_rig(filepath=str(out)), "'other' uses the armature of 'elbow_rig' too")
    assert not out.exists()


def test_a_canceled_job_ends_the_other_blender_and_writes_nothing(packed, elbow_files):
    before = sorted(path.name for path in packed.iterdir())
    arguments = [str(packed / "elbow.blend"), str(elbow_files.model), str(packed / "fast.blend"), "--frames", "100000"]
    with VerbProcess("fast-rig", arguments) as process:
        steps = process.steps()
        while not isinstance(next(steps), Progress):
            time.sleep(0.01)
        assert process.is_running
    assert not process.is_running
    assert sorted(path.name for path in packed.iterdir()) == before


def test_the_other_blender_registers_an_add_on_that_it_does_not_load(monkeypatch):
    """Blender evaluates the expression before it runs the command."""
    monkeypatch.setattr(verb_process, "bpy", SimpleNamespace(app=SimpleNamespace(binary_path="/blender")))
    program, option, expression, *command = verb_process._command()
    assert (program, option, command) == ("/blender", "--python-expr", ["--command", "fdda"])
    script = f"{expression}\n{expression}\nassert sys.modules['fdda_addon'].is_registered()\nprint('done')"
    result = subprocess.run([sys.executable, "-P", "-c", script], cwd="/", capture_output=True, text=True, check=False)
    assert result.stdout.endswith("done\n"), result.stderr


def test_unsaved_files_and_missing_choices_are_refused(packed):
    out = str(packed / "fast.blend")
    refused(lambda: bpy.ops.fdda.fast_rig(filepath=out, visible=False, keyed=False), "No controls were chosen")
    refused(lambda: bpy.ops.fdda.fast_rig(filepath=out, collection="Faces"), "has no bone collection 'Faces'")
    refused(bpy.ops.fdda.fast_rig, "No file was chosen; give the name of a .blend file.")


@pytest.mark.parametrize("name", ["fast.blend", "FAST.BLEND"])
def test_the_report_has_a_sentence_for_each_line_of_the_verb(name):
    output = f"/folder/{name}: 'rig' has 2 of 3 bones\n  removed 1 object\n/folder/{name}: a frame took 1 ms\n"
    expected = f"{name}: 'rig' has 2 of 3 bones. Removed 1 object. A frame took 1 ms."
    assert FDDA_OT_fast_rig.finish(None, None, output) == expected


def test_meshes_of_one_model_share_its_file(packed, tmp_path_factory):
    mesh_object = bpy.data.objects[ELBOW]
    other = mesh_object.copy()
    bpy.context.scene.collection.objects.link(other)
    mesh_object.name = "left arm"
    folder = tmp_path_factory.mktemp("models")
    assert write_models([mesh_object, other], folder) == folder / "0" / "left_arm.onnx"
    assert len(list(folder.glob("*/*.onnx"))) == 1
