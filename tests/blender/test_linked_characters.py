# SPDX-License-Identifier: GPL-3.0-or-later
"""Linked characters: with library overrides in poses of their own, without, as instances, duplicated, reloaded."""

import itertools
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import pytest
from conftest import ELBOW, ELBOW_RIG, ElbowFiles, assert_plays, evaluated, predicted
from test_renders import render_positions, rig_pixels, set_camera, still

import fdda_addon
from fdda_addon import models
from fdda_addon.core.errors import ModelError, RigError
from fdda_addon.runtime import model_files, nodes, playback
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.scene.rig import SceneRig, armature_modifier

COLLECTION = "Character"
CROWD = 20
ANGLES = (0.3, 1.4)
OWN = {"parent", 'modifiers["Armature"].object', 'modifiers["FDDA"].properties.inputs.Socket_1.value'}
"""What an override of the elbow's mesh differs in anyway: it follows its own armature and has its own positions."""


@dataclass(frozen=True)
class Library:
    """A character that is linked: its file, and its model beside it."""

    path: Path
    model: Path


def save_character(source: Path, path: Path) -> None:
    """Save what a file holds, in a collection to be linked."""
    bpy.ops.wm.open_mainfile(filepath=str(source))
    collection = bpy.data.collections.new(COLLECTION)
    bpy.context.scene.collection.children.link(collection)
    for name in (ELBOW, ELBOW_RIG):
        bpy.context.scene.collection.objects.unlink(bpy.data.objects[name])
        collection.objects.link(bpy.data.objects[name])
    bpy.data.objects[ELBOW].fdda.model = "//elbow.onnx" if bpy.data.objects[ELBOW].fdda.is_bound else ""
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)


@pytest.fixture
def library(elbow: ElbowFiles, tmp_path: Path) -> Library:
    """The bound elbow in a folder of its own; the open file is empty, saved in another."""
    model_files._chosen.clear()
    files = Library(tmp_path / "characters" / "elbow.blend", tmp_path / "characters" / "elbow.onnx")
    files.path.parent.mkdir()
    shutil.copy(elbow.model, files.model)
    save_character(elbow.bound, files.path)
    new_shot(tmp_path)
    return files


def new_shot(folder: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fdda_addon.register()
    (folder / "shots").mkdir(exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(folder)))


def shot(folder: Path) -> Path:
    return folder / "shots" / "shot.blend"


def save_and_open(folder: Path) -> None:
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(folder)))
    bpy.ops.wm.open_mainfile(filepath=str(shot(folder)))


def link(path: Path) -> bpy.types.Collection:
    with bpy.data.libraries.load(str(path), link=True, relative=True) as (_, wanted):
        wanted.collections = [COLLECTION]
    return wanted.collections[0]


def override(collection: bpy.types.Collection, angle: float | None = None, is_editable: bool = True):
    """A library override of a linked character in a pose, without its action; its mesh object."""
    root = collection.override_hierarchy_create(
        bpy.context.scene, bpy.context.view_layer, do_fully_editable=is_editable
    )
    mesh_object = next(o for o in root.all_objects if o.type == "MESH")
    if angle is not None:
        armature_of(mesh_object).animation_data.action = None
        bend(mesh_object, angle)
    return mesh_object


def armature_of(mesh_object: bpy.types.Object) -> bpy.types.Object:
    return armature_modifier(mesh_object).object


def bend(mesh_object: bpy.types.Object, angle: float) -> None:
    armature_of(mesh_object).pose.bones["lower"].rotation_euler[0] = angle


def own_characters() -> list[bpy.types.Object]:
    """The mesh objects of the open file's overrides, by name."""
    return [o for o in bpy.data.objects if o.type == "MESH" and o.override_library]


def overridden_paths(mesh_object: bpy.types.Object) -> set[str]:
    """What an override differs in from its library; spelled as in 5.2."""
    paths = {found.rna_path for found in mesh_object.override_library.properties}
    return {path.replace('["Socket_1"]', ".properties.inputs.Socket_1.value") for path in paths}


def assert_play(library: Library, angles: tuple[float, ...] = ANGLES) -> list[np.ndarray]:
    """Each override shows the model's output for its own pose; their positions."""
    bpy.context.view_layer.update()
    mesh_objects = own_characters()
    found = [armature_of(o).pose.bones["lower"].rotation_euler[0] for o in mesh_objects]
    assert found == pytest.approx(angles)
    positions = [assert_plays(o, library.model) for o in mesh_objects]
    for one, other in itertools.pairwise(positions):
        assert np.abs(one - other).max() > 1e-3
    return positions


def elsewhere(call: str) -> None:
    """Call a function of this file in a process of its own, which has done nothing before."""
    folders = [str(Path(fdda_addon.__file__).parents[1]), str(Path(__file__).parent)]
    code = f"""
import sys
sys.path[:0] = {folders!r}
import fdda_addon, test_linked_characters
fdda_addon.register()
try:
    test_linked_characters.{call}
finally:
    fdda_addon.unregister()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def open_shot(path: str, model: str) -> None:
    """Open a shot; its overrides play as they were saved."""
    bpy.ops.wm.open_mainfile(filepath=path)
    assert_play(Library(Path(), Path(model)))


def pack_model(path: str) -> None:
    """Pack the model into the file of the character, and let the character be saved with the rig shown."""
    bpy.ops.wm.open_mainfile(filepath=path)
    mesh_object = bpy.data.objects[ELBOW]
    models.adopt(mesh_object)
    models.pack_entry(mesh_object, mesh_object.fdda.models[0])
    mesh_object.fdda.mode = "RIG"
    bpy.ops.wm.save_mainfile()


@pytest.fixture
def pair(library: Library) -> list[bpy.types.Object]:
    """Two overrides of the elbow in two poses."""
    collection = link(library.path)
    return [override(collection, angle) for angle in ANGLES]


def test_overrides_play_their_own_poses(pair, library):
    assert_play(library)
    bend(pair[0], 0.8)
    assert_play(library, (0.8, 1.4))


@pytest.mark.parametrize("is_editable", [True, False], ids=["editable", "system override"])
def test_overrides_play_when_the_shot_is_opened_elsewhere(library, tmp_path, is_editable):
    collection = link(library.path)
    for angle in ANGLES:
        override(collection, angle, is_editable)
    assert_play(library)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(tmp_path)))
    assert_play(library)
    elsewhere(f"open_shot({str(shot(tmp_path))!r}, {str(library.model)!r})")


def test_overrides_keep_mode_strength_and_use_in_render(pair, library, tmp_path):
    first, second = pair
    first.fdda.mode, second.fdda.strength, second.fdda.use_in_render = "RIG", 0.25, True
    bpy.context.view_layer.update()
    before = evaluated(first), evaluated(second)
    save_and_open(tmp_path)
    first, second = own_characters()
    assert (first.fdda.mode, first.fdda.is_playing) == ("RIG", False)
    assert (second.fdda.mode, second.fdda.strength, second.fdda.use_in_render) == ("FDDA", 0.25, True)
    for mesh_object, positions in zip((first, second), before, strict=True):
        assert np.abs(evaluated(mesh_object) - positions).max() < 1e-6


def show_all(mesh_objects: list[bpy.types.Object], mode: str) -> list[np.ndarray]:
    for mesh_object in mesh_objects:
        mesh_object.fdda.mode = mode
    bpy.context.view_layer.update()
    return [evaluated(mesh_object) for mesh_object in mesh_objects]


def test_saved_overrides_hold_the_true_rig(pair, library, tmp_path):
    pair[0].fdda.use_in_render = True
    true, shown = (show_all(pair, mode) for mode in ("RIG", "FDDA"))
    assert all(np.abs(a - b).max() > 1e-4 for a, b in zip(true, shown, strict=True))
    bpy.ops.ed.undo_push(message="playing")
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(tmp_path)))
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(shot(tmp_path)))
    for mesh_object, positions in zip(own_characters(), true, strict=True):
        assert not hasattr(mesh_object, "fdda")
        shown = {m.name: (m.show_viewport, m.show_render) for m in mesh_object.modifiers}
        assert shown == {"Armature": (True, True), "CorrectiveSmooth": (True, True), "FDDA": (False, False)}
        assert np.abs(evaluated(mesh_object) - positions).max() < 1e-6


def test_a_saved_shot_holds_what_was_changed_and_no_more(pair, library, tmp_path):
    pair[0].fdda.strength = 0.5
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="playing")
    save_and_open(tmp_path)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(tmp_path)))
    # Blender has just looked for what differs.
    assert overridden_paths(own_characters()[0]) - OWN == {"fdda.strength"}
    assert overridden_paths(own_characters()[1]) - OWN == set()
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(shot(tmp_path)))
    first, second = own_characters()
    # The linked elbow itself plays nowhere, and its positions have no place in the shot.
    own = {o.name for o in bpy.data.objects if o.library is None and o.type == "MESH"}
    assert own == {*(o.name for o in (first, second)), *(cache_name(o) for o in (first, second))}


def cache_name(mesh_object: bpy.types.Object) -> str:
    return nodes.cache_of(nodes.find_modifier(mesh_object)).name


def test_overrides_follow_their_actions(library, tmp_path):
    collection = link(library.path)
    override(collection)
    second = override(collection)
    armature_object = armature_of(second)
    armature_object.animation_data.action = None
    for frame, angle in ((1, 1.5), (30, 0.1)):
        bend(second, angle)
        armature_object.pose.bones["lower"].keyframe_insert("rotation_euler", index=0, frame=frame)
    save_and_open(tmp_path)
    seen = []
    for frame in (2, 15, 27):
        bpy.context.scene.frame_set(frame)
        seen.append([assert_plays(mesh_object, library.model) for mesh_object in own_characters()])
        assert np.abs(seen[-1][0] - seen[-1][1]).max() > 1e-3
    assert np.abs(seen[0][1] - seen[2][1]).max() > 1e-2


def test_overrides_after_undo_and_redo(pair, library):
    assert_play(library)
    bpy.ops.ed.undo_push(message="start")
    bend(pair[0], 0.9)
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="bent")
    pair[1].fdda.mode = "RIG"
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="rig")
    bpy.ops.ed.undo()
    assert_play(library, (0.9, 1.4))
    bpy.ops.ed.undo()
    assert_play(library)
    bpy.ops.ed.redo()
    bpy.ops.ed.redo()
    first, second = own_characters()
    assert (second.fdda.mode, second.fdda.is_playing) == ("RIG", False)
    assert_plays(first, library.model)
    second.fdda.mode = "FDDA"
    assert_play(library, (0.9, 1.4))


@pytest.mark.parametrize("use_in_render", [False, True])
def test_renders_of_overrides(pair, library, tmp_path, use_in_render):
    first, second = pair
    second.hide_render = True
    set_camera()
    first.fdda.use_in_render = use_in_render
    bpy.context.view_layer.update()
    rendered = still(tmp_path / "still.png")
    model = render_positions(first, predicted(first, library.model), tmp_path / "plain.png")
    rig = rig_pixels(first, tmp_path)
    assert not np.array_equal(model, rig)
    assert np.array_equal(rendered, model if use_in_render else rig)
    assert_play(library)


def test_a_linked_character_without_override_plays_its_action(library, tmp_path):
    bpy.context.scene.collection.children.link(link(library.path))
    save_and_open(tmp_path)
    linked = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    assert linked.library is not None and linked.override_library is None
    frames = [assert_plays(linked, library.model) for f in (5, 12, 25) if not bpy.context.scene.frame_set(f)]
    assert np.abs(frames[0] - frames[1]).max() > 1e-3
    bpy.ops.ed.undo_push(message="start")
    bpy.context.scene.frame_set(8)
    bpy.ops.ed.undo_push(message="frame")
    bpy.ops.ed.undo()
    assert_plays(next(o for o in bpy.context.scene.objects if o.type == "MESH"), library.model)


def test_an_override_of_what_plays_already(library, tmp_path):
    """As users do it: link with an instance, then make an override of what it shows."""
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", link(library.path)
    bpy.context.scene.collection.objects.link(empty)
    bpy.context.scene.frame_set(9)
    empty.select_set(True)
    bpy.context.view_layer.objects.active = empty
    bpy.ops.object.make_override_library()
    mesh_object = own_characters()[0]
    armature_of(mesh_object).animation_data.action = None
    bend(mesh_object, 0.8)
    assert_play(library, (0.8,))
    cache = nodes.cache_of(nodes.find_modifier(mesh_object))
    assert not cache.is_runtime_data
    save_and_open(tmp_path)
    assert_play(library, (0.8,))


@pytest.mark.parametrize("is_linked", [True, False], ids=["linked", "local"])
def test_instances_of_a_collection_show_one_pose(library, is_linked):
    if is_linked:
        collection = link(library.path)
    else:
        bpy.ops.wm.open_mainfile(filepath=str(library.path))
        collection = bpy.data.collections[COLLECTION]
        bpy.context.scene.collection.children.unlink(collection)
    for place in range(2):
        empty = bpy.data.objects.new(f"instance {place}", None)
        empty.instance_type, empty.instance_collection, empty.location.x = "COLLECTION", collection, place
        bpy.context.scene.collection.objects.link(empty)
    mesh_object = next(o for o in collection.all_objects if o.type == "MESH")
    for frame in (4, 21):
        bpy.context.scene.frame_set(frame)
        expected = predicted(mesh_object, library.model)
        places = []
        for instance in bpy.context.evaluated_depsgraph_get().object_instances:
            if instance.object.type == "MESH":
                places.append(instance.matrix_world.translation.x)
                positions = np.array([vertex.co[:] for vertex in instance.object.data.vertices])
                assert np.abs(positions - expected).max() < 1e-5
        assert places == [0, 1]
        assert not mesh_object.fdda.status


def test_a_duplicated_override_has_its_own_positions(pair, library, tmp_path):
    bpy.context.view_layer.update()
    for mesh_object in (pair[1], armature_of(pair[1])):
        mesh_object.select_set(True)
    bpy.ops.object.duplicate()
    copy = next(o for o in bpy.context.selected_objects if o.type == "MESH")
    assert copy not in pair and copy.override_library and armature_of(copy) != armature_of(pair[1])
    bend(copy, 0.7)
    assert_play(library, (*ANGLES, 0.7))
    assert len({cache_name(o) for o in own_characters()}) == 3
    save_and_open(tmp_path)
    assert_play(library, (*ANGLES, 0.7))


def test_a_packed_model_is_found_in_the_library(library, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    mesh_object = bpy.data.objects[ELBOW]
    models.adopt(mesh_object)
    models.pack_entry(mesh_object, mesh_object.fdda.models[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))
    moved = library.model.rename(tmp_path / "moved.onnx")
    new_shot(tmp_path)
    collection = link(library.path)
    for angle in ANGLES:
        override(collection, angle)
    bpy.context.scene.collection.children.link(collection)
    assert_play(Library(library.path, moved))
    save_and_open(tmp_path)
    assert_play(Library(library.path, moved))
    assert own_characters()[0].fdda.packed.library is not None
    assert_plays(own_characters()[0].override_library.reference, moved)


def test_a_path_out_of_the_folder_of_the_library_is_not_followed(library, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    outside = library.model.rename(tmp_path / "shots" / "elbow.onnx")
    bpy.data.objects[ELBOW].fdda.model = f"//../shots/{outside.name}"
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))
    model_files._chosen.clear()
    new_shot(tmp_path)
    mesh_object = override(link(library.path), 0.5)
    bpy.context.view_layer.update()
    assert "lies outside the folder of 'elbow.blend' and is not followed" in mesh_object.fdda.status
    assert (mesh_object.fdda.mode, mesh_object.modifiers["Armature"].show_viewport) == ("RIG", True)


def change_library(library: Library, change, folder: Path) -> None:
    """Change the library's file; the shot, saved before, is open again."""
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(folder)))
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    change()
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))


def add_a_hat() -> None:
    """Something new in the character, so that its overrides have to be made anew."""
    hat = bpy.data.objects.new("hat", bpy.data.meshes.new("hat"))
    hat.parent = bpy.data.objects[ELBOW_RIG]
    bpy.data.collections[COLLECTION].objects.link(hat)
    bpy.data.objects[ELBOW].modifiers.new("Cast", "CAST").factor = 0
    bpy.data.objects[ELBOW].modifiers.new("Subdivision", "SUBSURF").show_viewport = False


def test_a_resynced_override_plays_on(pair, library, tmp_path):
    assert_play(library)
    change_library(library, add_a_hat, tmp_path)
    bpy.ops.wm.open_mainfile(filepath=str(shot(tmp_path)))
    assert sum("hat" in o.name and o.library is None for o in bpy.data.objects) == 2
    pair = [o for o in own_characters() if o.fdda.is_bound]
    assert [[m.name for m in o.modifiers][2:] for o in pair] == [["FDDA", "Cast", "Subdivision"]] * 2
    for mesh_object in pair:
        assert_plays(mesh_object, library.model)
        bend(mesh_object, 0.5)
    bpy.context.view_layer.update()
    for mesh_object in pair:
        assert_plays(mesh_object, library.model)


def test_a_reloaded_library_plays_on(pair, library, tmp_path):
    bpy.context.scene.collection.children.link(pair[0].override_library.reference.users_collection[0])
    assert_play(library)
    bpy.data.libraries[0].reload()
    assert_play(library)
    bend(own_characters()[0], 0.6)
    assert_play(library, (0.6, 1.4))
    assert_plays(own_characters()[0].override_library.reference, library.model)
    save_and_open(tmp_path)
    assert_play(library, (0.6, 1.4))


def test_a_reloaded_library_brings_its_new_model(pair, library, tmp_path, elbow):
    """Reloaded while the shot is open; another process has saved the library with its model packed and mode RIG."""
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(tmp_path)), copy=True)
    pair[1].fdda.mode = "LINEAR"
    bpy.context.view_layer.update()
    elsewhere(f"pack_model({str(library.path)!r})")
    library.model.unlink()
    bpy.data.libraries[0].reload()
    bpy.context.view_layer.update()
    first, second = own_characters()
    # The first has the mode of its library, the second its own.
    assert [(o.fdda.mode, o.fdda.is_playing) for o in (first, second)] == [("RIG", False), ("LINEAR", True)]
    assert first.modifiers["Armature"].show_viewport and not second.modifiers["Armature"].show_viewport
    first.fdda.mode = second.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    for mesh_object in (first, second):
        assert mesh_object.fdda.packed is not None
        assert_plays(mesh_object, elbow.model)


def test_binding_to_an_override(elbow, tmp_path):
    """A model in the shot for a character whose library has none."""
    source, model = tmp_path / "plain.blend", tmp_path / "shots" / "elbow.onnx"
    save_character(elbow.rig, source)
    new_shot(tmp_path)
    shutil.copy(elbow.model, model)
    mesh_object = override(link(source), 1.1)
    bpy.context.view_layer.update()
    true = evaluated(mesh_object)
    models.bind_entry(rig_of(mesh_object), models.remember(mesh_object, model))
    model_files._chosen.clear()
    for _ in range(2):
        mesh_object = own_characters()[0]
        assert_plays(mesh_object, model)
        assert [m.name for m in mesh_object.modifiers] == ["Armature", "CorrectiveSmooth", "FDDA"]
        assert [entry.path for entry in mesh_object.fdda.models] == [mesh_object.fdda.model] == ["//elbow.onnx"]
        save_and_open(tmp_path)
    unbind(own_characters()[0])
    save_and_open(tmp_path)
    mesh_object = own_characters()[0]
    assert not mesh_object.fdda.is_bound
    assert [(m.name, m.show_viewport) for m in mesh_object.modifiers] == [
        ("Armature", True),
        ("CorrectiveSmooth", True),
    ]
    assert np.abs(evaluated(mesh_object) - true).max() < 1e-6


def test_an_override_that_was_saved_without_the_addon_is_bound_again(elbow, tmp_path):
    source, model = tmp_path / "plain.blend", tmp_path / "shots" / "elbow.onnx"
    save_character(elbow.rig, source)
    new_shot(tmp_path)
    shutil.copy(elbow.model, model)
    bind(rig_of(override(link(source), 1.1)), model)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(tmp_path)))
    fdda_addon.unregister()
    save_and_open(tmp_path)
    save_and_open(tmp_path)
    fdda_addon.register()
    mesh_object = own_characters()[0]
    assert not mesh_object.fdda.is_bound
    bind(rig_of(mesh_object), model)
    assert_plays(mesh_object, model)
    assert [m.name for m in mesh_object.modifiers] == ["Armature", "CorrectiveSmooth", "FDDA"]
    assert sum("positions" in o.name for o in bpy.data.objects) == 1


def rig_of(mesh_object: bpy.types.Object) -> SceneRig:
    return SceneRig(mesh_object, armature_of(mesh_object))


def test_another_model_in_the_shot(pair, library, elbow, tmp_path):
    """One override unbound and bound to a model beside the shot, which is called as the library's own is."""
    model = tmp_path / "shots" / "elbow.onnx"
    shutil.copy(elbow.model, model)
    unbind(pair[0])
    assert [m.show_viewport for m in pair[0].modifiers] == [True, True, False]
    save_and_open(tmp_path)
    first, second = own_characters()
    assert not first.fdda.is_bound and second.fdda.is_bound
    models.bind_entry(rig_of(first), models.remember(first, model))
    model_files._chosen.clear()
    assert sum(m.type == "NODES" for m in first.modifiers) == 1
    assert model_files.model_path(first) == model
    library.model.unlink()
    save_and_open(tmp_path)
    bpy.context.view_layer.update()
    first, second = own_characters()
    assert_plays(first, model)
    assert "elbow.onnx' cannot be read" in second.fdda.status


def test_an_override_keeps_the_name_of_the_librarys_model(pair, library, tmp_path):
    models.adopt(pair[0])
    models.bind_entry(rig_of(pair[0]), pair[0].fdda.models[0])
    model_files._chosen.clear()
    assert pair[0].fdda.model == "//elbow.onnx"
    save_and_open(tmp_path)
    assert_play(library)


def test_a_model_of_the_librarys_list_is_not_forgotten(library, elbow, tmp_path):
    elsewhere(f"pack_model({str(library.path)!r})")
    mesh_object = override(link(library.path), 0.6)
    own = models.remember(mesh_object, elbow.model)
    assert [entry.name for entry in mesh_object.fdda.models] == ["elbow", own.name]
    with pytest.raises(ModelError, match=r"'elbow' is in the list of 'elbow\.blend'; remove it there, or unbind"):
        models.forget_entry(mesh_object, 0)
    models.forget_entry(mesh_object, 1)
    assert mesh_object.fdda.is_bound and len(mesh_object.fdda.models) == 1


def test_a_shot_that_was_saved_by_itself(library, tmp_path):
    """An auto-save calls no handler: the override of a character that is saved with its rig is caught playing."""
    elsewhere(f"pack_model({str(library.path)!r})")
    mesh_object = override(link(library.path), 0.6)
    mesh_object.fdda.mode = "FDDA"
    expected = assert_plays(mesh_object, library.model)
    handlers = [bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:]]
    bpy.app.handlers.save_pre.clear()
    bpy.app.handlers.save_post.clear()
    bpy.ops.wm.save_as_mainfile(filepath=str(shot(tmp_path)))
    bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:] = handlers
    bpy.ops.wm.open_mainfile(filepath=str(shot(tmp_path)))
    mesh_object = own_characters()[0]
    assert np.array_equal(assert_plays(mesh_object, library.model), expected)
    mesh_object.fdda.mode = "RIG"
    assert [m.show_viewport for m in mesh_object.modifiers] == [True, True, False]


def test_an_override_of_an_override(library, tmp_path):
    """The shot links a set that holds an override of the character: two libraries away, the model is found."""
    mesh_object = override(link(library.path), 0.2)
    collection = mesh_object.users_collection[0]
    collection.name = COLLECTION
    folder = tmp_path / "sets"
    folder.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "set.blend"), copy=True)
    new_shot(tmp_path)
    collection = link(folder / "set.blend")
    for angle in ANGLES:
        override(collection, angle)
    save_and_open(tmp_path)
    mesh_objects = [o for o in own_characters() if o.library is None]
    for mesh_object in mesh_objects:
        assert mesh_object.override_library.reference.override_library
        assert_plays(mesh_object, library.model)
    assert len(mesh_objects) == 2


def test_a_crowd_of_overrides_is_one_call(library, monkeypatch):
    collection = link(library.path)
    crowd = [override(collection, 1.2 * number / CROWD) for number in range(CROWD)]
    bpy.context.view_layer.update()
    calls, real = [], playback.Network.positions

    def positions(network, pose_matrices, *arguments):
        calls.append(len(pose_matrices))
        return real(network, pose_matrices, *arguments)

    monkeypatch.setattr(playback.Network, "positions", positions)
    for mesh_object in crowd:
        bend(mesh_object, armature_of(mesh_object).pose.bones["lower"].rotation_euler[0] + 0.1)
    bpy.context.view_layer.update()
    assert calls == [CROWD]
    for mesh_object in crowd:
        assert_plays(mesh_object, library.model)
    assert len({cache_name(mesh_object) for mesh_object in crowd}) == CROWD


def test_a_linked_character_is_not_bound(library):
    bpy.context.scene.collection.children.link(link(library.path))
    linked = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    sentence = "'elbow' is linked from 'elbow.blend' and cannot be changed here; give it a library override"
    with pytest.raises(RigError, match=sentence):
        bind(rig_of(linked), library.model)
    with pytest.raises(RigError, match=sentence):
        unbind(linked)
    assert_plays(linked, library.model)
