# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that bakes the open file, as it is shown."""

import re

import bpy
import numpy as np

from fdda_addon.jobs.job import state_of
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
