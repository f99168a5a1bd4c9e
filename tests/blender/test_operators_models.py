# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the section Model Library: several models of a mesh, packed and checked."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.core.errors import ModelError
from fdda_addon.models.entries import bound_entry, format_file_size
from fdda_addon.runtime import packed_model
from fdda_addon.runtime.binding import bind
from fdda_addon.timing import frame_times

from .. import systems
from .conftest import ELBOW, ELBOW_RIG, assert_plays, pose, write_edited
from .test_operators_playback import refused


@pytest.fixture
def second(elbow, tmp_path):
    """Another model of the elbow: the same, under another name, outside the folder of its file."""
    return Path(shutil.copy(elbow.model, tmp_path / "second.onnx"))


@pytest.fixture
def packed_elbow(bound, elbow):
    """The bound elbow with its model packed, in a file of its own."""
    bpy.context.view_layer.objects.active = bound
    bpy.ops.fdda.pack_model()
    return bound


def test_switching_between_models(rig, elbow, second):
    bpy.ops.fdda.add_model(filepath=str(elbow.model))
    bpy.ops.fdda.add_model(filepath=str(second))
    bpy.ops.fdda.add_model(filepath=str(elbow.model))
    fdda = rig.mesh_object.fdda
    assert [entry.name for entry in fdda.models] == ["elbow", "second"] and fdda.model_index == 0
    for index, name in ((1, "second"), (0, "elbow"), (1, "second")):
        fdda.model_index = index
        fdda.use_in_render = True
        bpy.ops.fdda.bind()
        assert bound_entry(rig.mesh_object).name == name and fdda.use_in_render
        pose(angle=0.5 + index)
        assert_plays(rig.mesh_object, elbow.model)
    assert sum(m.type == "NODES" for m in rig.mesh_object.modifiers) == 1


def test_removing_a_model_unbinds_it(rig, elbow, second):
    bpy.ops.fdda.add_model(filepath=str(second))
    bpy.ops.fdda.bind(filepath=str(elbow.model))
    fdda = rig.mesh_object.fdda
    bpy.ops.fdda.remove_model(index=0)
    assert fdda.is_bound and [entry.name for entry in fdda.models] == ["elbow"]
    bpy.ops.fdda.remove_model()
    assert not fdda.is_bound and not fdda.models and elbow.model.is_file()
    refused(bpy.ops.fdda.remove_model, "The model library is empty")


def test_the_list_comes_back_with_the_file(bound, elbow):
    assert [(entry.name, entry.path) for entry in bound.fdda.models] == [("elbow", "//elbow.onnx")]


def test_a_model_of_another_rig_is_not_added(rig, elbow):
    rig.armature_object.data.bones["lower"].name = "forearm"
    refused(lambda: bpy.ops.fdda.add_model(filepath=str(elbow.model)), "it does not know the joint 'forearm'")
    assert not rig.mesh_object.fdda.models


def test_an_index_that_is_none(bound):
    bpy.context.view_layer.objects.active = bound
    refused(lambda: bpy.ops.fdda.check_model(index=3), "has 1 models and none with index 3")


def test_packed_model_plays_without_its_file(packed_elbow, elbow, tmp_path):
    entry = packed_elbow.fdda.models[0]
    assert entry.packed_bytes == elbow.model.stat().st_size and not entry.packed.use_fake_user
    pose(angle=0.9)
    assert_plays(packed_elbow, elbow.model)
    refused(bpy.ops.fdda.pack_model, "is already packed")
    path = tmp_path / "alone.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    pose(angle=1.4)
    assert_plays(mesh_object, elbow.model)
    assert bytes(packed_model.read(mesh_object.fdda.packed)) == elbow.model.read_bytes()


def test_a_refused_find_model_changes_nothing(packed_elbow, elbow, tmp_path):
    """The model of another rig, and a file that is none."""
    other = tmp_path / "other.onnx"
    shutil.copy(elbow.model, other)
    (tmp_path / "none.onnx").write_bytes(b"no model")
    entry = packed_elbow.fdda.models[0]
    before = entry.name, entry.path, entry.packed, entry.packed_bytes, packed_elbow.fdda.model_index
    paint_weight()
    for name, words in (("other.onnx", "the skin weights differ"), ("none.onnx", "is not a model")):
        refused(lambda name=name: bpy.ops.fdda.relink(filepath=str(tmp_path / name)), words)
        (entry,) = packed_elbow.fdda.models
        assert before == (entry.name, entry.path, entry.packed, entry.packed_bytes, packed_elbow.fdda.model_index)
        assert packed_elbow.fdda.packed == entry.packed and packed_elbow.fdda.is_bound
    # Of a model that is in no list, none is made.
    packed_elbow.fdda.models.clear()
    refused(lambda: bpy.ops.fdda.relink(filepath=str(other)), "the skin weights differ")
    assert not packed_elbow.fdda.models and packed_elbow.fdda.is_bound


def test_undo_with_a_packed_model(packed_elbow, elbow):
    bpy.ops.ed.undo_push(message="packed")
    pose(angle=0.9)
    bpy.ops.ed.undo_push(message="posed")
    bpy.ops.ed.undo()
    pose(angle=1.3)
    assert_plays(bpy.data.objects[ELBOW], elbow.model)
    assert bpy.data.objects[ELBOW].fdda.packed is not None


def test_unbinding_and_binding_a_packed_model(packed_elbow, elbow):
    bpy.ops.fdda.unbind()
    assert len(bpy.data.texts) == 1
    bpy.ops.fdda.bind()
    pose(angle=1.0)
    assert_plays(packed_elbow, elbow.model)
    assert packed_elbow.fdda.packed is not None
    bpy.ops.fdda.measure_model(frames=5)
    assert packed_elbow.fdda.packed is not None and packed_elbow.fdda.is_bound


def test_borrowing_gives_a_packed_model_back(packed_elbow, elbow, second):
    from pathlib import Path

    from fdda_addon.runtime.binding import temporary_binding
    from fdda_addon.scene.scene_rig import find_rig

    before = packed_elbow.fdda.model
    with temporary_binding(find_rig(), Path(second)):
        assert packed_elbow.fdda.packed is None
    assert packed_elbow.fdda.packed is not None and packed_elbow.fdda.model == before
    assert bound_entry(packed_elbow) is not None


def test_unpack_writes_what_was_packed_and_removes_it(packed_elbow, elbow, tmp_path):
    path = tmp_path / "out.onnx"
    path.write_bytes(b"another")
    refused(lambda: bpy.ops.fdda.unpack_model(filepath=str(path)), "There is another file", "choose another name")
    path.unlink()
    bpy.ops.fdda.unpack_model(filepath=str(path))
    assert path.read_bytes() == elbow.model.read_bytes()
    assert not bpy.data.texts and packed_elbow.fdda.packed is None
    pose(angle=1.1)
    assert_plays(packed_elbow, path)
    refused(bpy.ops.fdda.unpack_model, "is not packed")


def test_unpack_beside_the_file_where_the_same_model_lies(packed_elbow, elbow):
    bpy.ops.fdda.unpack_model()
    assert packed_elbow.fdda.model == "//elbow.onnx"
    pose(angle=1.1)
    assert_plays(packed_elbow, elbow.model)


def test_removing_a_packed_model_deletes_it(packed_elbow):
    bpy.ops.fdda.remove_model()
    assert not bpy.data.texts


def test_a_packed_model_passes_the_same_checks(packed_elbow, elbow):
    packed_elbow.fdda.packed[packed_model.PACKED_MODEL_KEY] = b"\x08\x08" + elbow.model.read_bytes()[:100]
    path = elbow.bound.with_name("damaged.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    mesh_object = bpy.data.objects[ELBOW]
    bpy.context.view_layer.update()
    assert "is not a model" in mesh_object.fdda.status and mesh_object.fdda.mode == "RIG"
    del mesh_object.fdda.packed[packed_model.PACKED_MODEL_KEY]
    with pytest.raises(ModelError, match="does not hold a model any more"):
        packed_model.read(mesh_object.fdda.packed)
    with pytest.raises(ModelError, match="is not a model"):
        packed_model.pack("text", b"no model")


def test_a_packed_model_is_appended_with_its_object(packed_elbow, elbow, tmp_path):
    path = tmp_path / "library.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(path)) as (_, wanted):
        wanted.objects = [ELBOW, ELBOW_RIG]
    for appended in wanted.objects:
        bpy.context.scene.collection.objects.link(appended)
    pose(angle=1.2)
    assert_plays(wanted.objects[0], elbow.model)


def move_vertex() -> None:
    bpy.data.objects[ELBOW].data.vertices[3].co.x += 0.02


def add_vertex() -> None:
    bpy.data.objects[ELBOW].data.vertices.add(1)
    bpy.data.objects[ELBOW].vertex_groups["lower"].add([len(bpy.data.objects[ELBOW].data.vertices) - 1], 1.0, "REPLACE")


def paint_weight() -> None:
    bpy.data.objects[ELBOW].vertex_groups["upper"].add([0], 0.37, "REPLACE")
    bpy.data.objects[ELBOW].vertex_groups["lower"].add([0], 0.63, "REPLACE")


def rename_bone() -> None:
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].name = "forearm"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (move_vertex, "the rest pose of the mesh differs"),
        (add_vertex, "vertices, the mesh has"),
        (paint_weight, "the skin weights differ"),
        (rename_bone, "lacks the joint 'lower'"),
    ],
)
def test_a_stale_model_says_what_changed(bound, change, words):
    bpy.context.view_layer.objects.active = bound
    assert bpy.ops.fdda.check_model() == {"FINISHED"}
    bound.fdda.mode = "RIG"
    change()
    refused(
        bpy.ops.fdda.check_model, "elbow was trained for an earlier state of this rig", words, "record and train again"
    )


def test_another_range_of_motion_is_told_and_prevents_nothing(bound, elbow):
    from fdda_addon.models.changes import find_changes
    from fdda_addon.scene.scene_rig import find_rig

    bpy.context.view_layer.objects.active = bound
    assert not find_changes(find_rig(), bound.fdda.models[0]).sentence
    bpy.data.objects[ELBOW_RIG].pose.bones["lower"].constraints[0].max_x += 0.1
    found = find_changes(find_rig(), bound.fdda.models[0])
    assert found.bones_with_changed_range == ("lower",) and not found.prevents_playback
    assert "The range of motion of 'lower' has changed since elbow was trained" in found.sentence
    assert bpy.ops.fdda.check_model() == {"FINISHED"}
    pose(angle=0.1)
    assert_plays(bound, elbow.model)


def test_a_listed_path_out_of_the_folder_is_not_followed(bound, elbow, second):
    bpy.context.view_layer.objects.active = bound
    entry = bound.fdda.models.add()
    entry.name, entry.path = "second", str(second)
    bound.fdda.model_index = 1
    refused(bpy.ops.fdda.bind, "lies outside the folder of 'bound.blend'")
    refused(bpy.ops.fdda.pack_model, "lies outside the folder")
    refused(bpy.ops.fdda.check_model, "lies outside the folder")
    assert bound_entry(bound).name == "elbow"
    bpy.ops.fdda.bind(filepath=str(second))
    assert bound_entry(bound).name == "second" and len(bound.fdda.models) == 2


def test_a_model_that_is_trained_anew_plays_at_once(bound, elbow, second, tmp_path):
    """The file under a bound model is replaced, as a training does."""
    import onnx

    from fdda_addon.evaluation import last_evaluation
    from fdda_addon.models import model_list

    bpy.context.view_layer.objects.active = bound
    path = tmp_path / "second.onnx"
    bpy.ops.fdda.bind(filepath=str(path))
    bpy.ops.fdda.evaluate(source="RANDOM", poses=1)
    bpy.ops.fdda.measure_model(frames=5)
    assert frame_times.get(bound) is not None
    pose(angle=1.3)
    before = assert_plays(bound, path)

    def double(proto: onnx.ModelProto) -> None:
        node = next(node for node in proto.graph.node if "positions" in node.output)
        node.output[0] = "before"
        proto.graph.node.append(onnx.helper.make_node("Add", ["before", "before"], ["positions"]))

    write_edited(path, path, double)
    model_list.add_model(bound, path)
    bpy.context.view_layer.update()
    after = assert_plays(bound, path)
    np.testing.assert_allclose(after, 2 * before, atol=1e-5)
    assert last_evaluation.get(bound) is None and frame_times.get(bound) is None
    assert len(bound.fdda.models) == 2


def test_what_the_section_says_of_the_models(bound, elbow):
    from fdda_addon.panels import checks
    from fdda_addon.panels import models as section
    from fdda_addon.scene.scene_rig import find_rig

    bpy.context.view_layer.objects.active = bound
    checks.check_now(find_rig())
    assert section._problem_values.compute_now(bound) == {}
    bpy.data.objects[ELBOW_RIG].pose.bones["lower"].constraints[0].max_x += 0.1
    checks.check_now(find_rig())
    ((icon, sentence),) = section._problem_values.compute_now(bound).values()
    assert icon == "INFO" and sentence.startswith("The range of motion of 'lower' has changed")
    bound.fdda.models[0].path = "//away.onnx"
    ((icon, sentence),) = section._problem_values.compute_now(bound).values()
    assert icon == "ERROR" and f"cannot be read: {systems.NOT_FOUND}; find it, or choose another." in sentence


def test_megabytes():
    assert [format_file_size(count) for count in (2_340, 1_340_169)] == ["2.3 kB", "1.3 MB"]


def test_a_model_of_equal_size_that_replaces_another_plays(rig, second, tmp_path):
    from onnx import numpy_helper

    def negate(proto) -> None:
        """Negate the largest array."""
        tensor = max(proto.graph.initializer, key=lambda tensor: len(tensor.raw_data))
        tensor.CopyFrom(numpy_helper.from_array(-numpy_helper.to_array(tensor), tensor.name))

    path = write_edited(second, tmp_path / "m.onnx", lambda proto: None)
    size = path.stat().st_size
    bind(rig, path)
    pose(angle=1.3)
    before = assert_plays(rig.mesh_object, path)
    assert write_edited(path, path, negate).stat().st_size == size
    bind(rig, path)
    bpy.context.view_layer.update()
    assert np.abs(assert_plays(rig.mesh_object, path) - before).max() > 1e-3
