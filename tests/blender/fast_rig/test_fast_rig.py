# SPDX-License-Identifier: GPL-3.0-or-later
"""Fast rigs: the files that the verb writes or refuses, and what a shot with one shows and renders."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters.bones import NewBone, add_bones, wave
from blend_fixtures.characters.dependencies import CONTROLS, DEPENDENCIES, SOURCE, UNUSED, studio_arm
from fdda_addon.fast_rig import frame_times
from fdda_addon.fast_rig import removal as fast_rig_removal
from fdda_addon.fast_rig.compared_poses import ComparedPoses, differing_bones, infinite_bones
from fdda_addon.fast_rig.graph_reader import read_graph
from fdda_addon.rig.references import Node
from fdda_addon.runtime.binding import bind
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import find_rig
from fdda_addon.scene.temporary_state import assign_action
from fdda_addon.timing.durations import time_calls

from ..conftest import (
    ELBOW,
    ELBOW_RIG,
    Trained,
    assert_plays,
    build_and_train,
    edit_metadata,
    output_of,
    run,
    write_edited,
)
from ..playback import set_camera, still

CHARACTER = "Character"


@pytest.fixture(scope="module")
def studio_files(tmp_path_factory) -> Trained:
    """An arm with all dependencies, in a collection, and its model."""

    def build() -> None:
        # With IK and Spline IK on one bone, Blender does not repeat its own result. Shots have other view layers.
        objects = studio_arm(*(name for name in DEPENDENCIES if name not in {"spline_ik", "view_layer_property"}))
        wave(objects[1], "control")
        wave(objects[1], UNUSED)
        collection = bpy.data.collections.new(CHARACTER)
        bpy.context.scene.collection.children.link(collection)
        for scene_object in list(bpy.context.scene.collection.objects):
            bpy.context.scene.collection.objects.unlink(scene_object)
            collection.objects.link(scene_object)

    options = ("--object", ELBOW, "--poses", 60)
    return build_and_train(tmp_path_factory.mktemp("studio"), build, *options, training=("--passes", 3))


@pytest.fixture
def folder(studio_files, tmp_path) -> Path:
    """Copy the files, so that a test may change them."""
    shutil.copy(studio_files.rig, tmp_path / "full.blend")
    shutil.copy(studio_files.model, tmp_path)
    return tmp_path


def fast_rig_arguments(folder: Path, *options: object) -> list[object]:
    files = [folder / name for name in ("full.blend", "model.onnx", "fast.blend")]
    return ["fast-rig", *files, "--object", ELBOW, *options]


def test_a_fast_rig_has_the_same_names_and_plays(folder):
    source = (folder / "full.blend").read_bytes()
    lines = output_of(*fast_rig_arguments(folder, "--controls", "visible", "--frames", 6)).out
    assert (folder / "full.blend").read_bytes() == source
    bpy.ops.wm.open_mainfile(filepath=str(folder / "full.blend"))
    full_count = len(bpy.data.objects[ELBOW_RIG].data.bones)

    # The model is packed, so the file plays without it.
    (folder / "model.onnx").rename(folder / "moved.onnx")
    bpy.ops.wm.open_mainfile(filepath=str(folder / "fast.blend"))
    mesh_object, armature_object = bpy.data.collections[CHARACTER].objects[ELBOW], bpy.data.objects[ELBOW_RIG]
    assert find_rig(ELBOW).armature_object == armature_object
    assert not {UNUSED, f"{UNUSED}_child"} & set(armature_object.data.bones.keys())
    assert {"cage"} & set(bpy.data.objects.keys()) == set()
    assert {m.type for m in mesh_object.modifiers} == {"ARMATURE", "NODES", "SMOOTH"}
    assert {"wave control", f"wave {UNUSED}"} <= set(bpy.data.actions.keys())
    armature_object.pose.bones["control"].rotation_euler = (0.5, 0.2, 0.0)
    bpy.context.view_layer.update()
    assert_plays(mesh_object, folder / "moved.onnx")

    assert f"has {full_count - 2} of {full_count} bones" in lines[0] and "animators pose 1" in lines[0]
    assert "1 object ('cage'), 2 modifiers ('Mush' and 'Lattice')" in lines[1]
    assert "the joints, the controls and 2 rendered objects are as in the full rig in 240 poses (largest" in lines[2]
    assert lines[3].strip() == f"'wave {UNUSED}': 3 keyed channels have no bone any more: '{UNUSED}'"
    assert "times as fast" in lines[4] and len(lines) == 5


def test_both_rigs_play_the_same_action_without_the_models_of_the_full_rig(folder, monkeypatch):
    """The full rig has an action more, which keys only removed bones, and a second bound mesh."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "full.blend"))
    wave(bpy.data.objects[ELBOW_RIG], UNUSED).name = "a first action"
    bind(find_rig(ELBOW), folder / "model.onnx")
    bpy.data.collections[CHARACTER].objects.link(bpy.data.objects[ELBOW].copy())
    bpy.ops.wm.save_mainfile()
    played, models = [], []

    def assign(armature_object, action, slot):
        played.append(action.name)
        assign_action(armature_object, action, slot)

    def count_models(calls):
        bpy.context.view_layer.update()
        models.append(sum(m.type == "NODES" and m.show_viewport for o in bpy.data.objects for m in o.modifiers))
        return time_calls(calls)

    monkeypatch.setattr(frame_times, "assign_action", assign)
    monkeypatch.setattr(frame_times, "time_calls", count_models)
    assert run(*fast_rig_arguments(folder, "--controls", "visible", "--frames", 3)) == 0
    assert set(played) == {"wave control"}
    assert sorted(set(models)) == [0, 2]


def drop_needs_of_bone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the dependency graph lack what needs a bone."""

    def read_incomplete_graph(*arguments):
        graph = read_graph(*arguments)
        for needed in graph.needs.values():
            needed.discard(Node(arguments[0][0].armature_object, name))
        return graph

    monkeypatch.setattr(fast_rig_removal, "read_graph", read_incomplete_graph)


def test_bones_that_differ_are_named_and_nothing_is_written(folder, monkeypatch, capsys):
    """Without one dependency, the comparison refuses the fast rig."""
    drop_needs_of_bone(f"{SOURCE}.distance", monkeypatch)
    assert run(*fast_rig_arguments(folder)) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert "Without the removed bones, 1 bone ('lower' by " in error
    assert "which the model reads or animators pose, would move differently" in error
    assert not (folder / "fast.blend").exists()


@pytest.mark.parametrize("owner", ["prop", "control"])
def test_what_would_differ_besides_joints_is_named(folder, monkeypatch, capsys, owner):
    """Only one of the actions moves the removed bone."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "full.blend"))
    armature_object = bpy.data.objects[ELBOW_RIG]
    if owner == "prop":
        prop = bpy.data.objects.new("prop", None)
        bpy.context.scene.collection.objects.link(prop)
        prop.parent, prop.parent_type, prop.parent_bone = armature_object, "BONE", UNUSED
    else:
        armature_object.data.collections[CONTROLS].assign(armature_object.data.bones[f"{UNUSED}_child"])
    bpy.ops.wm.save_mainfile()
    drop_needs_of_bone(UNUSED, monkeypatch)
    assert run(*fast_rig_arguments(folder, "--controls", "visible")) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    if owner == "prop":
        assert "renders would show another object 'prop' (relative difference " in error
    else:
        assert f"1 bone ('{UNUSED}_child' by " in error
    assert not (folder / "fast.blend").exists()


def add_to_itself(struct: bpy.types.bpy_struct, name: str) -> None:
    """Add a driver that adds to its own result in each evaluation, as simulations depend on the poses before."""
    driver = struct.driver_add(name, 0).driver
    driver.type = "SUM"
    path = name if struct == struct.id_data else struct.path_from_id(name)
    for owner, each in ((struct.id_data, path), (bpy.data.objects[ELBOW_RIG], 'pose.bones["control"].scale')):
        target = driver.variables.new().targets[0]
        target.id, target.data_path = owner, f"{each}[0]"


def test_the_comparison_leaves_the_file_as_it_was_and_objects_out_that_do_not_repeat(folder):
    """It links objects, shows them, and assigns actions, all for a while."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "full.blend"))
    swinging, prop = bpy.data.objects.new("swinging", None), bpy.data.objects.new("prop", None)
    for scene_object in (swinging, prop):
        bpy.context.scene.collection.objects.link(scene_object)
    add_to_itself(swinging, "location")
    prop.keyframe_insert("hide_render", frame=1)
    prop.animation_data.action.use_fake_user = True
    prop.animation_data_clear()
    prop.hide_viewport = prop.hide_render = True
    prop.hide_set(True)
    bpy.ops.wm.save_mainfile()
    collections = len(bpy.data.collections)
    lines = output_of(*fast_rig_arguments(folder, "--frames", 0)).out
    assert lines[3] == "  not compared, because the full rig does not repeat it: object 'swinging'"
    bpy.ops.wm.open_mainfile(filepath=str(folder / "fast.blend"))
    prop = bpy.data.objects["prop"]
    assert len(bpy.data.collections) == collections and prop.animation_data is None
    assert prop.hide_render and prop.hide_viewport and prop.hide_get()


def test_a_rig_that_does_not_repeat_itself_is_refused(folder, capsys):
    """Where the full rig moves differently in the same pose, no comparison is possible."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "full.blend"))
    add_to_itself(bpy.data.objects[ELBOW_RIG].pose.bones[f"{SOURCE}.target"], "rotation_euler")
    bpy.ops.wm.save_mainfile()
    assert run(*fast_rig_arguments(folder)) == 1
    assert "of the size) of 'elbow_rig' differently, so a fast rig cannot be compared" in capsys.readouterr().err
    assert not (folder / "fast.blend").exists()


def test_transforms_that_are_infinite_in_both_rigs_are_equal(folder):
    bpy.ops.wm.open_mainfile(filepath=str(folder / "full.blend"))
    driver = bpy.data.objects[ELBOW_RIG].pose.bones["upper"].driver_add("scale", 0).driver
    driver.expression = "3e38 if var > 0.8 else 1"
    target = driver.variables.new().targets[0]
    target.id, target.data_path = bpy.data.objects[ELBOW_RIG], 'pose.bones["control"].rotation_euler[0]'
    bpy.ops.wm.save_mainfile()
    lines = output_of(*fast_rig_arguments(folder, "--frames", 0)).out
    assert lines[3].strip().startswith("in up to ")
    assert "of these, both rigs give no finite transform to 'upper' and 'lower'" in lines[3]
    count = int(lines[3].split()[3])
    assert 0 < count < 100

    bpy.ops.wm.open_mainfile(filepath=str(folder / "fast.blend"))
    assert bpy.data.objects[ELBOW].fdda.mode == "FDDA" and not bpy.data.objects[ELBOW].fdda.status


def test_a_joint_that_is_infinite_in_one_rig_differs():
    before = np.zeros((2, 2, 4, 4), np.float32)
    after = before.copy()
    before[0, 0, 0, 3] = after[0, 0, 0, 3] = np.nan
    poses = ComparedPoses(None, ("first", "second"), (), (), 1.0)
    assert differing_bones(poses, before, after, 1e-5) == {}
    assert infinite_bones(poses, before) == {"first": 1}
    after[1, 1, 2, 2] = np.nan
    assert differing_bones(poses, before, after, 1e-5) == {"second": np.inf}


def test_refusals(folder, capsys):
    assert run(*fast_rig_arguments(folder, "--controls", "shown")) == 2
    assert "'shown' chooses no control bones; give visible, keyed or collection:NAME" in capsys.readouterr().err
    full = folder / "full.blend"
    assert run("fast-rig", full, folder / "model.onnx", full, "--object", ELBOW, "--overwrite") == 1
    assert "is the full rig, which renders need; give the fast rig another name." in capsys.readouterr().err
    assert run(*fast_rig_arguments(folder, "--frames", 0)) == 0
    again = folder / "again.blend"
    assert run("fast-rig", folder / "fast.blend", folder / "model.onnx", again, "--object", ELBOW) == 1
    assert "'elbow' is a fast rig already; give the file of the full rig." in capsys.readouterr().err
    bpy.ops.wm.open_mainfile(filepath=str(full))
    other = bpy.data.objects.new("other", bpy.data.objects[ELBOW_RIG].data)
    bpy.context.scene.collection.objects.link(other)
    bpy.ops.wm.save_mainfile()
    assert run("fast-rig", full, folder / "model.onnx", again, "--object", ELBOW) == 1
    assert "'other' uses the armature of 'elbow_rig' too, and would lose its bones" in capsys.readouterr().err
    assert not again.exists()


def open_shot(path: Path) -> bpy.types.Object:
    """Open an empty shot with an override of the character of a file and return the armature object.

    Its rotation comes from the linked action, its location from an action of the shot.
    """
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with bpy.data.libraries.load(str(path), link=True) as (_, linked):
        linked.collections, linked.actions = [CHARACTER], ["wave control"]
    root = linked.collections[0].override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    set_camera()
    armature_object = next(o for o in root.all_objects if o.type == "ARMATURE")
    animation = armature_object.animation_data_create()
    animation.nla_tracks.new().strips.new("strip", 1, linked.actions[0])
    bone = armature_object.pose.bones["control"]
    animation.action = bpy.data.actions.new("shot")
    for frame, x in ((1, 0.0), (20, 0.05)):
        bone.location = (x, 0.5 * x, 0.0)
        assert bone.keyframe_insert("location", frame=frame)
    return armature_object


def shown(armature_object: bpy.types.Object, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the evaluated matrix of `lower` and the rendered pixels of a frame."""
    bpy.context.scene.frame_set(15)
    evaluated = armature_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    control = evaluated.pose.bones["control"]
    assert control.location.length > 0.03 and abs(control.rotation_euler.x) > 0.2
    return np.array(evaluated.pose.bones["lower"].matrix), still(path)


def relocate(fast: Path, full: Path) -> None:
    """Relocate the library as a script of a render farm does, in the saved shot."""
    shot = fast.with_name("shot.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(shot))
    bpy.ops.wm.open_mainfile(filepath=str(shot))
    library = next(lib for lib in bpy.data.libraries if Path(bpy.path.abspath(lib.filepath)).samefile(fast))
    library.filepath = str(full)
    library.reload()


def test_a_shot_that_is_relocated_to_the_full_rig_renders_as_the_full_rig(folder):
    """Link the fast rig, override it, animate it, relocate the library to the full rig, save, reopen and render."""
    assert run(*fast_rig_arguments(folder, "--controls", "visible", "--frames", 0)) == 0
    armature_object = open_shot(folder / "full.blend")
    expected_matrix, expected = shown(armature_object, folder / "expected.png")

    armature_object = open_shot(folder / "fast.blend")
    mesh_object = next(o for o in bpy.data.objects if o.type == "MESH" and o.override_library)
    matrix, preview = shown(armature_object, folder / "preview.png")
    assert_plays(mesh_object, folder / "model.onnx")
    assert np.array_equal(matrix, expected_matrix)
    assert not np.array_equal(preview, expected)

    relocate(folder / "fast.blend", folder / "full.blend")
    for _ in range(2):
        mesh_object, armature_object = (
            next(o for o in bpy.data.objects if o.type == kind and o.override_library and o.name.startswith(ELBOW))
            for kind in ("MESH", "ARMATURE")
        )
        assert {m.name for m in mesh_object.modifiers if m.show_viewport} == {"Armature", "Mush", "Lattice"}
        matrix, rendered = shown(armature_object, folder / "rendered.png")
        assert np.array_equal(matrix, expected_matrix)
        assert np.array_equal(rendered, expected)
        assert not mesh_object.fdda.status and not mesh_object.fdda.is_fast_rig
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / "relocated.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(folder / "relocated.blend"))


OTHER = "a second: arm"


def test_a_folder_of_models_makes_one_fast_rig_with_all_meshes(elbow_files, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    other = bpy.data.objects[ELBOW].copy()
    other.name, other.data = OTHER, other.data.copy()
    bpy.context.scene.collection.objects.link(other)
    save_copy(tmp_path / "full.blend")
    models = tmp_path / "models"
    models.mkdir()
    (models / "one.onnx").write_bytes(elbow_files.model.read_bytes())
    rename = edit_metadata(lambda info: info["meshes"][0].update(name=OTHER))
    write_edited(elbow_files.model, models / "two.onnx", rename)

    assert run("fast-rig", tmp_path / "full.blend", models, tmp_path / "fast.blend", "--frames", 0) == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "fast.blend"))
    bpy.data.objects[ELBOW_RIG].pose.bones[-1].rotation_mode = "XYZ"
    bpy.data.objects[ELBOW_RIG].pose.bones[-1].rotation_euler = (0.5, 0.0, 0.3)
    bpy.context.view_layer.update()
    for name in (ELBOW, OTHER):
        mesh_object = bpy.data.objects[name]
        assert mesh_object.fdda.is_fast_rig and not mesh_object.fdda.status
        assert "CorrectiveSmooth" not in mesh_object.modifiers
        assert_plays(mesh_object, elbow_files.model)


def test_relative_paths_lead_to_the_same_files_from_another_folder(elbow_files, tmp_path):
    source, out = tmp_path / "character", tmp_path / "animation" / "rigs"
    (source / "textures").mkdir(parents=True)
    out.mkdir(parents=True)
    texture = source / "textures" / "skin.png"
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    made = bpy.data.images.new("made", 4, 4)
    made.save(filepath=str(texture))
    bpy.data.images.remove(made)
    full = source / "full.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(full))
    image = bpy.data.images.load("//textures/skin.png")
    image.name, image.use_fake_user = "skin", True
    bpy.ops.wm.save_mainfile()
    fast = out / "fast.blend"
    assert run("fast-rig", full, elbow_files.model, fast, "--object", ELBOW, "--frames", 0) == 0
    bpy.ops.wm.open_mainfile(filepath=str(fast))
    path = bpy.data.images["skin"].filepath
    assert path.startswith("//") and Path(bpy.path.abspath(path)).resolve() == texture.resolve()


def test_controls_that_choose_no_bone_are_refused_and_those_that_move_no_joint_prove_nothing(elbow_files, tmp_path):
    full, fast = tmp_path / "full.blend", tmp_path / "fast.blend"
    words = ("fast-rig", full, elbow_files.model, fast, "--controls", "keyed", "--frames", 0)
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    for action in list(bpy.data.actions):
        bpy.data.actions.remove(action)
    armature_object = bpy.data.objects[ELBOW_RIG]
    add_bones(armature_object, NewBone("aside", (0.0, 0.0, 0.3), (0.1, 0.0, 0.3), is_deforming=False))
    save_copy(full)
    refused = output_of(*words, status=1).err
    assert "'elbow_rig' has no bones for --controls keyed, so the fast rig would have" in refused[-1]
    assert not fast.exists()
    bpy.ops.wm.open_mainfile(filepath=str(full))
    wave(bpy.data.objects[ELBOW_RIG], "aside")
    save_copy(full)
    lines = output_of(*words).out
    assert len(lines) == 3 and lines[2].startswith("  no joint moves in 220 poses of these controls, so nothing shows ")
