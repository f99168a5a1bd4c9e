# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators that pack and unpack models: playback, undo, append and refusals with a packed model."""

import shutil
from pathlib import Path

import bpy
import pytest

from fdda_addon.core.errors import ModelError
from fdda_addon.models.model_list import bound_entry
from fdda_addon.runtime import packed_model

from ..conftest import ELBOW, assert_plays, pose
from ..refusals import refused
from ..rig_changes import paint_weight


@pytest.fixture
def packed_elbow(bound_elbow, elbow_files):
    """The bound elbow with its model packed."""
    bpy.context.view_layer.objects.active = bound_elbow
    bpy.ops.fdda.pack_model()
    return bound_elbow


def test_a_packed_model_plays_without_its_file(packed_elbow, elbow_files, tmp_path):
    entry = packed_elbow.fdda.models[0]
    assert entry.packed_bytes == elbow_files.model.stat().st_size and not entry.packed.use_fake_user
    pose(angle=0.9)
    assert_plays(packed_elbow, elbow_files.model)
    refused(bpy.ops.fdda.pack_model, "is already packed")
    path = tmp_path / "alone.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    pose(angle=1.4)
    assert_plays(mesh_object, elbow_files.model)
    assert bytes(packed_model.read(mesh_object.fdda.packed)) == elbow_files.model.read_bytes()


def test_find_model_with_an_unsuitable_file_changes_nothing(packed_elbow, elbow_files, tmp_path):
    """The chosen files are a model of another rig and a file that is not a model."""
    other = tmp_path / "other.onnx"
    shutil.copy(elbow_files.model, other)
    (tmp_path / "none.onnx").write_bytes(b"no model")
    entry = packed_elbow.fdda.models[0]
    before = entry.name, entry.path, entry.packed, entry.packed_bytes, packed_elbow.fdda.model_index
    paint_weight()
    for name, words in (("other.onnx", "the skin weights differ"), ("none.onnx", "it is not an ONNX file")):
        refused(lambda name=name: bpy.ops.fdda.relink(filepath=str(tmp_path / name)), words)
        (entry,) = packed_elbow.fdda.models
        assert before == (entry.name, entry.path, entry.packed, entry.packed_bytes, packed_elbow.fdda.model_index)
        assert packed_elbow.fdda.packed == entry.packed and packed_elbow.fdda.is_bound
    # Without an entry in the list, none is added.
    packed_elbow.fdda.models.clear()
    refused(lambda: bpy.ops.fdda.relink(filepath=str(other)), "the skin weights differ")
    assert not packed_elbow.fdda.models and packed_elbow.fdda.is_bound


def test_a_packed_model_can_be_unbound_bound_again_and_measured(packed_elbow, elbow_files):
    bpy.ops.fdda.unbind()
    assert len(bpy.data.texts) == 1
    bpy.ops.fdda.bind()
    pose(angle=1.0)
    assert_plays(packed_elbow, elbow_files.model)
    assert packed_elbow.fdda.packed is not None
    bpy.ops.fdda.measure(frames=5)
    assert packed_elbow.fdda.packed is not None and packed_elbow.fdda.is_bound


def test_a_temporary_binding_restores_a_packed_model(packed_elbow, elbow_files, tmp_path):
    from fdda_addon.runtime.binding import temporary_binding
    from fdda_addon.scene.scene_rig import find_rig

    before = packed_elbow.fdda.model
    with temporary_binding(find_rig(), Path(shutil.copy(elbow_files.model, tmp_path / "other.onnx"))):
        assert packed_elbow.fdda.packed is None
    assert packed_elbow.fdda.packed is not None and packed_elbow.fdda.model == before
    assert bound_entry(packed_elbow) is not None


def test_unpacking_writes_the_model_and_removes_it_from_the_file(packed_elbow, elbow_files, tmp_path):
    path = tmp_path / "out.onnx"
    path.write_bytes(b"another")
    refused(lambda: bpy.ops.fdda.unpack_model(filepath=str(path)), "There is another file", "choose another name")
    path.unlink()
    bpy.ops.fdda.unpack_model(filepath=str(path))
    assert path.read_bytes() == elbow_files.model.read_bytes()
    assert not bpy.data.texts and packed_elbow.fdda.packed is None
    pose(angle=1.1)
    assert_plays(packed_elbow, path)
    refused(bpy.ops.fdda.unpack_model, "is not packed")


def test_unpacking_keeps_an_identical_file_beside_the_blend_file(packed_elbow, elbow_files):
    bpy.ops.fdda.unpack_model()
    assert packed_elbow.fdda.model == "//elbow.onnx"
    pose(angle=1.1)
    assert_plays(packed_elbow, elbow_files.model)


def test_removing_a_packed_model_deletes_it(packed_elbow):
    bpy.ops.fdda.remove_model()
    assert not bpy.data.texts


def test_a_damaged_packed_model_is_refused(packed_elbow, elbow_files):
    packed_elbow.fdda.packed[packed_model.PACKED_MODEL_KEY] = b"\x08\x08" + elbow_files.model.read_bytes()[:100]
    path = elbow_files.bound.with_name("damaged.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    bpy.context.view_layer.update()
    assert "it is not an ONNX file" in mesh_object.fdda.status and mesh_object.fdda.mode == "RIG"
    del mesh_object.fdda.packed[packed_model.PACKED_MODEL_KEY]
    with pytest.raises(ModelError, match="does not hold a model any more"):
        packed_model.read(mesh_object.fdda.packed)
    with pytest.raises(ModelError, match="it is not an ONNX file"):
        packed_model.pack("text", b"no model")
