# SPDX-License-Identifier: GPL-3.0-or-later
"""Models that are bound in the shot to an override of a linked character."""

import shutil

import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.core.errors import ModelError, RigError
from fdda_addon.models import model_list
from fdda_addon.runtime import model_files
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.session import session

from ..conftest import assert_plays, evaluated_positions
from ..linked import (
    assert_overrides_play,
    link_character,
    overridden_meshes,
    override_character,
    rig_of,
    run_in_another_process,
    save_and_reopen_shot,
    save_character,
    save_new_shot,
    shot_path,
)


def test_binding_to_an_override(elbow_files, tmp_path):
    """A model in the shot for a character whose library has none."""
    source, model = tmp_path / "plain.blend", tmp_path / "shots" / "elbow.onnx"
    save_character(elbow_files.rig, source)
    save_new_shot(tmp_path)
    shutil.copy(elbow_files.model, model)
    mesh_object = override_character(link_character(source), 1.1)
    bpy.context.view_layer.update()
    true = evaluated_positions(mesh_object)
    model_list.bind_entry(rig_of(mesh_object), model_list.add_model(mesh_object, model))
    session.chosen_paths.clear()
    for _ in range(2):
        mesh_object = overridden_meshes()[0]
        assert_plays(mesh_object, model)
        assert [m.name for m in mesh_object.modifiers] == ["Armature", "CorrectiveSmooth", "FDDA", "FDDA Undeformed"]
        assert [entry.path for entry in mesh_object.fdda.models] == [mesh_object.fdda.model] == ["//elbow.onnx"]
        save_and_reopen_shot(tmp_path)
    unbind(overridden_meshes()[0])
    save_and_reopen_shot(tmp_path)
    mesh_object = overridden_meshes()[0]
    assert not mesh_object.fdda.is_bound
    assert [(m.name, m.show_viewport) for m in mesh_object.modifiers] == [
        ("Armature", True),
        ("CorrectiveSmooth", True),
    ]
    assert np.abs(evaluated_positions(mesh_object) - true).max() < 1e-6


def test_an_override_that_was_saved_without_the_addon_is_bound_again(elbow_files, tmp_path):
    source, model = tmp_path / "plain.blend", tmp_path / "shots" / "elbow.onnx"
    save_character(elbow_files.rig, source)
    save_new_shot(tmp_path)
    shutil.copy(elbow_files.model, model)
    bind(rig_of(override_character(link_character(source), 1.1)), model)
    bpy.ops.wm.save_as_mainfile(filepath=str(shot_path(tmp_path)))
    fdda_addon.unregister()
    save_and_reopen_shot(tmp_path)
    save_and_reopen_shot(tmp_path)
    fdda_addon.register()
    mesh_object = overridden_meshes()[0]
    assert not mesh_object.fdda.is_bound
    bind(rig_of(mesh_object), model)
    assert_plays(mesh_object, model)
    assert [m.name for m in mesh_object.modifiers] == ["Armature", "CorrectiveSmooth", "FDDA", "FDDA Undeformed"]
    assert sum("positions" in o.name for o in bpy.data.objects) == 1


def test_another_model_in_the_shot(pair, library, elbow_files, tmp_path):
    """One override unbound and bound to a model beside the shot, which is called as the library's own is."""
    model = tmp_path / "shots" / "elbow.onnx"
    shutil.copy(elbow_files.model, model)
    unbind(pair[0])
    assert [m.show_viewport for m in pair[0].modifiers] == [True, True, False, False]
    save_and_reopen_shot(tmp_path)
    first, second = overridden_meshes()
    assert not first.fdda.is_bound and second.fdda.is_bound
    model_list.bind_entry(rig_of(first), model_list.add_model(first, model))
    session.chosen_paths.clear()
    assert sum(m.type == "NODES" for m in first.modifiers) == 1
    assert model_files.model_path(first) == model
    library.model.unlink()
    save_and_reopen_shot(tmp_path)
    bpy.context.view_layer.update()
    first, second = overridden_meshes()
    assert_plays(first, model)
    assert "elbow.onnx' cannot be read" in second.fdda.status


def test_an_override_keeps_the_name_of_the_librarys_model(pair, library, tmp_path):
    model_list.add_bound_model(pair[0])
    model_list.bind_entry(rig_of(pair[0]), pair[0].fdda.models[0])
    session.chosen_paths.clear()
    assert pair[0].fdda.model == "//elbow.onnx"
    save_and_reopen_shot(tmp_path)
    assert_overrides_play(library)


def test_a_model_of_the_librarys_list_is_not_forgotten(library, elbow_files, tmp_path):
    run_in_another_process(f"pack_model({str(library.path)!r})")
    mesh_object = override_character(link_character(library.path), 0.6)
    own = model_list.add_model(mesh_object, elbow_files.model)
    assert [entry.name for entry in mesh_object.fdda.models] == ["elbow", own.name]
    with pytest.raises(ModelError, match=r"'elbow' is in the list of 'elbow\.blend'; remove it there, or unbind"):
        model_list.remove_entry(mesh_object, 0)
    model_list.remove_entry(mesh_object, 1)
    assert mesh_object.fdda.is_bound and len(mesh_object.fdda.models) == 1


def test_a_linked_character_is_not_bound(library):
    bpy.context.scene.collection.children.link(link_character(library.path))
    linked = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    sentence = "'elbow' is linked from 'elbow.blend' and cannot be changed here; give it a library override"
    with pytest.raises(RigError, match=sentence):
        bind(rig_of(linked), library.model)
    with pytest.raises(RigError, match=sentence):
        unbind(linked)
    assert_plays(linked, library.model)
