# SPDX-License-Identifier: GPL-3.0-or-later
"""Saved shots with linked characters: stored overrides, paths of models, and changes of the library."""

from pathlib import Path

import bpy
import numpy as np

import fdda_addon
from fdda_addon.models import model_list
from fdda_addon.runtime.session import session

from ..conftest import ADDED, ELBOW, ELBOW_RIG, assert_plays, evaluated_positions
from ..linked import (
    ANGLES,
    COLLECTION,
    Library,
    assert_overrides_play,
    bend_elbow,
    link_character,
    overridden_meshes,
    override_character,
    run_in_another_process,
    save_and_reopen_shot,
    save_new_shot,
    shot_path,
)

EXPECTED_OVERRIDES = {"parent", 'modifiers["Armature"].object', 'modifiers["FDDA"].properties.inputs.Socket_1.value'}
"""Properties that every override of the elbow's mesh changes: its armature and the object with its positions."""


def test_overrides_keep_mode_strength_and_use_in_render(pair, library, tmp_path):
    first, second = pair
    first.fdda.mode, second.fdda.strength, second.fdda.use_in_render = "RIG", 0.25, True
    bpy.context.view_layer.update()
    saved_positions = evaluated_positions(first), evaluated_positions(second)
    save_and_reopen_shot(tmp_path)
    first, second = overridden_meshes()
    assert (first.fdda.mode, first.fdda.is_playing) == ("RIG", False)
    assert (second.fdda.mode, second.fdda.strength, second.fdda.use_in_render) == ("FDDA", 0.25, True)
    for mesh_object, positions in zip((first, second), saved_positions, strict=True):
        assert np.abs(evaluated_positions(mesh_object) - positions).max() < 1e-6


def positions_in_mode(mesh_objects: list[bpy.types.Object], mode: str) -> list[np.ndarray]:
    """Set the mode of characters, and return the evaluated positions (V, 3) of each."""
    for mesh_object in mesh_objects:
        mesh_object.fdda.mode = mode
    bpy.context.view_layer.update()
    return [evaluated_positions(mesh_object) for mesh_object in mesh_objects]


def test_saved_overrides_show_their_rig_without_the_add_on(pair, library, tmp_path):
    pair[0].fdda.use_in_render = True
    rig_shapes, model_shapes = (positions_in_mode(pair, mode) for mode in ("RIG", "FDDA"))
    for rig_shape, model_shape in zip(rig_shapes, model_shapes, strict=True):
        assert np.abs(rig_shape - model_shape).max() > 1e-5, "rig and model differ"
    bpy.ops.ed.undo_push(message="playing")
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(tmp_path)))
    for mesh_object, positions in zip(overridden_meshes(), rig_shapes, strict=True):
        assert not hasattr(mesh_object, "fdda")
        shown = {m.name: (m.show_viewport, m.show_render) for m in mesh_object.modifiers}
        assert shown == {"Armature": (True, True), "CorrectiveSmooth": (True, True), **ADDED}
        assert np.abs(evaluated_positions(mesh_object) - positions).max() < 1e-6


def overridden_paths(mesh_object: bpy.types.Object) -> set[str]:
    """Return the paths of the properties that an override changes, as Blender 5.2 spells them."""
    paths = {entry.rna_path for entry in mesh_object.override_library.properties}
    return {path.replace('["Socket_1"]', ".properties.inputs.Socket_1.value") for path in paths}


def test_a_saved_shot_contains_only_changed_properties(pair, library, tmp_path):
    pair[0].fdda.strength = 0.5
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="playing")
    save_and_reopen_shot(tmp_path)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    # Saving updates the list of changed properties.
    assert overridden_paths(overridden_meshes()[0]) - EXPECTED_OVERRIDES == {"fdda.strength"}
    assert overridden_paths(overridden_meshes()[1]) - EXPECTED_OVERRIDES == set()
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(tmp_path)))
    first, second = overridden_meshes()
    # The shot contains no objects with positions.
    assert [o for o in bpy.data.objects if o.library is None and o.type == "MESH"] == [first, second]
    assert {mesh.library is None for mesh in bpy.data.meshes} == {False}


def test_an_auto_saved_shot_plays(library, tmp_path):
    """Auto Save calls no handler, so it saves an override while its model plays, unlike its library."""
    run_in_another_process(f"pack_model({str(library.path)!r})")
    mesh_object = override_character(link_character(library.path), 0.6)
    mesh_object.fdda.mode = "FDDA"
    expected = assert_plays(mesh_object, library.model)
    handlers = [bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:]]
    bpy.app.handlers.save_pre.clear()
    bpy.app.handlers.save_post.clear()
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    bpy.app.handlers.save_pre[:], bpy.app.handlers.save_post[:] = handlers
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(tmp_path)))
    mesh_object = overridden_meshes()[0]
    assert np.array_equal(assert_plays(mesh_object, library.model), expected)
    mesh_object.fdda.mode = "RIG"
    assert [m.show_viewport for m in mesh_object.modifiers] == [True, True, False, False]


def test_a_packed_model_is_found_in_the_library(library, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    mesh_object = bpy.data.objects[ELBOW]
    model_list.add_bound_model(mesh_object)
    model_list.pack_entry(mesh_object, mesh_object.fdda.models[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))
    moved = library.model.rename(tmp_path / "moved.onnx")
    save_new_shot(tmp_path)
    collection = link_character(library.path)
    for angle in ANGLES:
        override_character(collection, angle)
    bpy.context.scene.collection.children.link(collection)
    assert_overrides_play(Library(library.path, moved))
    save_and_reopen_shot(tmp_path)
    assert_overrides_play(Library(library.path, moved))
    assert overridden_meshes()[0].fdda.packed.library is not None
    assert_plays(overridden_meshes()[0].override_library.reference, moved)


def test_a_model_outside_the_library_s_folder_is_not_loaded(library, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    outside_path = library.model.rename(tmp_path / "shots" / "elbow.onnx")
    bpy.data.objects[ELBOW].fdda.model = f"//../shots/{outside_path.name}"
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))
    session.chosen_paths.clear()
    save_new_shot(tmp_path)
    mesh_object = override_character(link_character(library.path), 0.5)
    bpy.context.view_layer.update()
    assert "lies outside the folder of 'elbow.blend' and is not followed" in mesh_object.fdda.status
    assert (mesh_object.fdda.mode, mesh_object.modifiers["Armature"].show_viewport) == ("RIG", True)


def change_library(library: Library, edit, folder: Path) -> None:
    """Save the shot, then open the library's file, edit it and save it."""
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(folder)))
    bpy.ops.wm.open_mainfile(filepath=str(library.path))
    edit()
    bpy.ops.wm.save_as_mainfile(filepath=str(library.path))


def add_hat_and_modifiers() -> None:
    """Add an object and modifiers to the library, so that overrides must be resynchronized."""
    hat = bpy.data.objects.new("hat", bpy.data.meshes.new("hat"))
    hat.parent = bpy.data.objects[ELBOW_RIG]
    bpy.data.collections[COLLECTION].objects.link(hat)
    bpy.data.objects[ELBOW].modifiers.new("Cast", "CAST").factor = 0
    bpy.data.objects[ELBOW].modifiers.new("Subdivision", "SUBSURF").show_viewport = False


def test_a_resynchronized_override_plays(pair, library, tmp_path):
    assert_overrides_play(library)
    change_library(library, add_hat_and_modifiers, tmp_path)
    bpy.ops.wm.open_mainfile(filepath=str(shot_path(tmp_path)))
    assert sum("hat" in o.name and o.library is None for o in bpy.data.objects) == 2
    pair = [o for o in overridden_meshes() if o.fdda.is_bound]
    assert [[m.name for m in o.modifiers][2:] for o in pair] == [["FDDA", "FDDA Undeformed", "Cast", "Subdivision"]] * 2
    for mesh_object in pair:
        assert_plays(mesh_object, library.model)
        bend_elbow(mesh_object, 0.5)
    bpy.context.view_layer.update()
    for mesh_object in pair:
        assert_plays(mesh_object, library.model)


def test_overrides_play_after_the_library_is_reloaded(pair, library, tmp_path):
    bpy.context.scene.collection.children.link(pair[0].override_library.reference.users_collection[0])
    assert_overrides_play(library)
    bpy.data.libraries[0].reload()
    assert_overrides_play(library)
    bend_elbow(overridden_meshes()[0], 0.6)
    assert_overrides_play(library, (0.6, 1.4))
    assert_plays(overridden_meshes()[0].override_library.reference, library.model)
    save_and_reopen_shot(tmp_path)
    assert_overrides_play(library, (0.6, 1.4))


def test_overrides_play_the_new_model_of_a_reloaded_library(pair, library, tmp_path, elbow_files):
    """While the shot is open, another process packs the model, sets mode RIG and saves the library."""
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)), copy=True)
    pair[1].fdda.mode = "LINEAR"
    bpy.context.view_layer.update()
    run_in_another_process(f"pack_model({str(library.path)!r})")
    library.model.unlink()
    bpy.data.libraries[0].reload()
    bpy.context.view_layer.update()
    first, second = overridden_meshes()
    # The first override has the mode of its library. The second override has a mode of its own.
    assert [(o.fdda.mode, o.fdda.is_playing) for o in (first, second)] == [("RIG", False), ("LINEAR", True)]
    assert first.modifiers["Armature"].show_viewport and not second.modifiers["Armature"].show_viewport
    first.fdda.mode = second.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    for mesh_object in (first, second):
        assert mesh_object.fdda.packed is not None
        assert_plays(mesh_object, elbow_files.model)


def test_an_override_of_an_override_plays(library, tmp_path):
    """The shot links a set which contains an override of the character, so the model is two libraries away."""
    mesh_object = override_character(link_character(library.path), 0.2)
    collection = mesh_object.users_collection[0]
    collection.name = COLLECTION
    folder = tmp_path / "sets"
    folder.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "set.blend"), copy=True)
    save_new_shot(tmp_path)
    collection = link_character(folder / "set.blend")
    for angle in ANGLES:
        override_character(collection, angle)
    save_and_reopen_shot(tmp_path)
    mesh_objects = [o for o in overridden_meshes() if o.library is None]
    for mesh_object in mesh_objects:
        assert mesh_object.override_library.reference.override_library
        assert_plays(mesh_object, library.model)
    assert len(mesh_objects) == 2
