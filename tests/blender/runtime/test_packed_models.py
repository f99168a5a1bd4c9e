# SPDX-License-Identifier: GPL-3.0-or-later
"""Models are packed into their .blend file, or loaded from folders that the user trusts, and released with the file."""

import gc
import shutil
import weakref

import bpy
import pytest

from fdda_addon.core.errors import ModelError
from fdda_addon.models.model_list import add_bound_model, bound_entry, pack_entry
from fdda_addon.operators import playback
from fdda_addon.properties import character
from fdda_addon.runtime import model_files, packed_model
from fdda_addon.runtime.model_files import network_of
from fdda_addon.runtime.session import session
from fdda_addon.scene import folder_trust
from fdda_addon.scene.blend_file import save_copy

from ... import systems
from ..conftest import ELBOW, ELBOW_RIG, assert_plays, pose, run


@pytest.fixture
def model(elbow_files, tmp_path):
    """The elbow's model in another folder than the .blend file."""
    folder = tmp_path / "models"
    folder.mkdir()
    return shutil.copy(elbow_files.model, folder / "elbow.onnx")


def save_elsewhere(tmp_path):
    """Save the open file into a new folder and open it again."""
    path = tmp_path / "elsewhere" / "shot.blend"
    path.parent.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    session.chosen_paths.clear()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.data.objects[ELBOW]


def test_a_bound_model_is_saved_with_save_as(rig, elbow_files, model, tmp_path):
    bpy.ops.fdda.bind(filepath=str(model))
    assert rig.mesh_object.fdda.packed is not None
    mesh_object = save_elsewhere(tmp_path)
    pose(angle=1.1)
    assert_plays(mesh_object, elbow_files.model)


def test_a_relinked_model_is_packed(bound_elbow, elbow_files, model, tmp_path):
    bpy.ops.fdda.relink(object=ELBOW, filepath=str(model))
    assert bound_elbow.fdda.packed is not None
    pose(angle=0.8)
    assert_plays(save_elsewhere(tmp_path), elbow_files.model)


def test_a_bound_model_is_appended_with_its_object(rig, elbow_files, model, tmp_path):
    bpy.ops.fdda.bind(filepath=str(model))
    path = tmp_path / "library" / "character.blend"
    path.parent.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    session.chosen_paths.clear()
    before = set(bpy.context.scene.objects.keys())
    with bpy.data.libraries.load(str(path)) as (_, wanted):
        wanted.objects = [ELBOW, ELBOW_RIG]
    for appended in wanted.objects:
        bpy.context.scene.collection.objects.link(appended)
    pose(angle=1.2)
    assert_plays(wanted.objects[0], elbow_files.model)
    assert set(bpy.context.scene.objects.keys()) - before == {ELBOW, ELBOW_RIG}


def test_a_large_model_is_not_packed_and_this_is_reported(rig, model, monkeypatch):
    monkeypatch.setattr(playback, "LARGE_MODEL_BYTES", 1000)
    assert playback.bind_model(rig, model_files.Path(model))[0].endswith("pack it in the Model Library.")
    assert rig.mesh_object.fdda.is_bound and rig.mesh_object.fdda.packed is None


def test_models_are_not_packed_if_the_preferences_say_so(rig, model, monkeypatch):
    monkeypatch.setattr(playback, "packs_models", lambda: False)
    bpy.ops.fdda.bind(filepath=str(model))
    assert rig.mesh_object.fdda.packed is None and not bpy.data.texts


def test_a_packed_model_that_is_trained_again_is_packed_again(rig, elbow_files, model):
    from fdda_addon.models.model_list import add_model

    bpy.ops.fdda.bind(filepath=str(model))
    before = rig.mesh_object.fdda.packed.session_uid
    add_model(rig.mesh_object, model_files.Path(model))
    assert rig.mesh_object.fdda.packed.session_uid == before, "the same file is not packed again"
    with open(model, "ab") as file:
        # A documentation string changes the file but not the model.
        file.write(b"\x32\x01x")
    add_model(rig.mesh_object, model_files.Path(model))
    assert packed_model.read(rig.mesh_object.fdda.packed) == model_files.Path(model).read_bytes()
    assert len(rig.mesh_object.fdda.models) == 1 and len(bpy.data.texts) == 1


def test_models_are_loaded_from_trusted_folders_only(bound_elbow, elbow_files, model, tmp_path, monkeypatch):
    bound_elbow.fdda.model = bound_elbow.fdda.models[0].path = str(model)
    session.chosen_paths.clear()
    with pytest.raises(ModelError, match="or add its folder in the preferences"):
        model_files.model_path(bound_elbow)
    monkeypatch.setattr(folder_trust, "trusted_folders", lambda: [(tmp_path / "other").resolve()])
    with pytest.raises(ModelError, match="is not followed"):
        model_files.model_path(bound_elbow)
    monkeypatch.setattr(folder_trust, "trusted_folders", lambda: [tmp_path.resolve()])
    assert model_files.model_path(bound_elbow) == model_files.Path(model)


@systems.symbolic_links
def test_a_link_out_of_the_folder_of_the_file_is_not_followed(bound_elbow, elbow_files, model, tmp_path):
    (tmp_path / "shots").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shots" / "shot.blend"))
    (tmp_path / "shots" / "way_out.onnx").symlink_to(model)
    session.chosen_paths.clear()
    bound_elbow.fdda.model = "//way_out.onnx"
    with pytest.raises(ModelError, match="lies outside the folder of"):
        model_files.model_path(bound_elbow)


@systems.symbolic_links
def test_a_link_out_of_a_trusted_folder_is_not_followed(elbow_files, tmp_path, monkeypatch):
    trusted = tmp_path / "trusted"
    trusted.mkdir()
    (trusted / "way_out.onnx").symlink_to(elbow_files.model)
    monkeypatch.setattr(folder_trust, "trusted_folders", lambda: [trusted.resolve()])
    assert not folder_trust.is_trusted(trusted / "way_out.onnx")
    assert not folder_trust.is_trusted(trusted / ".." / "m.onnx") and folder_trust.is_trusted(trusted / "m.onnx")


@pytest.fixture
def followed(rig, model, tmp_path, monkeypatch):
    """The elbow in a saved file, bound to a model that stays in a trusted folder; a recording is named as well."""
    monkeypatch.setattr(playback, "packs_models", lambda: False)
    monkeypatch.setattr(folder_trust, "trusted_folders", lambda: [tmp_path.resolve()])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "first.blend"))
    bpy.ops.fdda.bind(filepath=str(model))
    settings = bpy.data.objects[ELBOW].fdda.settings
    settings.recording, settings.model = "//poses/elbow", "//models/trained.onnx"
    return bpy.data.objects[ELBOW]


def named_paths(mesh_object):
    binding = mesh_object.fdda
    return [binding.model, binding.models[0].path, binding.settings.recording, binding.settings.model]


def test_a_model_outside_is_found_after_save_as(followed, elbow_files, tmp_path):
    assert named_paths(followed) == ["//models/elbow.onnx"] * 2 + ["//poses/elbow", "//models/trained.onnx"]
    mesh_object = save_elsewhere(tmp_path)
    there = ["//../models/elbow.onnx"] * 2 + ["//../poses/elbow", "//../models/trained.onnx"]
    assert named_paths(mesh_object) == there
    pose(angle=1.1)
    assert_plays(mesh_object, elbow_files.model)


def test_paths_that_blender_on_windows_has_stored_are_followed(followed, tmp_path):
    settings = followed.fdda.settings
    followed.fdda.model = followed.fdda.models[0].path = r"//models\elbow.onnx"
    settings.recording, settings.model = r"//poses\elbow", r"//models\trained.onnx"
    assert model_files.model_path(followed) == tmp_path / "models" / "elbow.onnx"
    assert character.recording_folder(followed) == tmp_path / "poses" / "elbow"
    there = ["//../models/elbow.onnx"] * 2 + ["//../poses/elbow", "//../models/trained.onnx"]
    assert named_paths(save_elsewhere(tmp_path)) == there


def test_a_saved_copy_and_the_open_file_both_find_the_model(followed, elbow_files, tmp_path):
    before, copy = named_paths(followed), tmp_path / "copies" / "copy.blend"
    copy.parent.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(copy), copy=True)
    assert named_paths(followed) == before
    pose(angle=0.7)
    assert_plays(followed, elbow_files.model)
    with pytest.raises(RuntimeError):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "nowhere" / "shot.blend"))
    assert named_paths(followed) == before
    pose(angle=0.8)
    assert_plays(followed, elbow_files.model)
    bpy.ops.wm.open_mainfile(filepath=str(copy))
    pose(angle=0.9)
    assert_plays(bpy.data.objects[ELBOW], elbow_files.model)


@pytest.mark.parametrize(("folder", "stored"), [(".", "//models/elbow.onnx"), ("elsewhere", None)])
def test_absolute_paths_stay_absolute_unless_they_are_below_the_file(followed, model, tmp_path, folder, stored):
    bpy.data.objects[ELBOW].fdda.model = followed.fdda.models[0].path = str(model)
    (tmp_path / "source").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "source" / "first.blend"))
    assert named_paths(followed)[:2] == [str(model)] * 2
    path = tmp_path / folder / "second.blend"
    path.parent.mkdir(exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    assert named_paths(followed)[:2] == [stored or str(model)] * 2


@systems.symbolic_links
def test_a_file_opened_through_a_link_stores_the_model_path_relative(elbow_files, tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    model = shutil.copy(elbow_files.model, tmp_path / "real" / "elbow.onnx")
    assert run("bind", elbow_files.rig, model, tmp_path / "link" / "bound.blend") == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "link" / "bound.blend"))
    assert bpy.data.objects[ELBOW].fdda.model == "//elbow.onnx"


def opened(path) -> weakref.ref:
    """Open a bound file and return a weak reference to its network."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return weakref.ref(network_of(bpy.data.objects[ELBOW]))


def copy_of(elbow_files, folder):
    folder.mkdir()
    shutil.copy(elbow_files.model, folder / elbow_files.model.name)
    return shutil.copy(elbow_files.bound, folder / elbow_files.bound.name)


@pytest.mark.parametrize("packed", [False, True])
def test_the_networks_of_files_that_were_open_are_released(elbow_files, tmp_path, packed):
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.bound))
    paths = [copy_of(elbow_files, tmp_path / str(number)) for number in range(4)]
    if packed:
        for path in paths:
            opened(path)
            mesh_object = bpy.data.objects[ELBOW]
            add_bound_model(mesh_object)
            pack_entry(mesh_object, bound_entry(mesh_object))
            save_copy(path)
    networks = [opened(path) for path in paths]
    gc.collect()
    assert [network() is not None for network in networks] == [False, False, False, True]
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    gc.collect()
    assert networks[-1]() is None
