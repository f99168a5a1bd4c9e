# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the section Model Library: several models of a mesh, changes of the rig, and packed models."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.core.errors import ModelError
from fdda_addon.models.model_list import bound_entry, format_file_size
from fdda_addon.panels import checks, models
from fdda_addon.panels.timed_value import timed_values
from fdda_addon.runtime import packed_model
from fdda_addon.runtime.binding import bind
from fdda_addon.scene.scene_rig import find_rig
from fdda_addon.timing import measurements

from ... import systems
from ..conftest import ELBOW, ELBOW_RIG, assert_plays, pose, write_edited
from ..refusals import refused
from ..rig_changes import paint_weight


@pytest.fixture
def second(elbow_files, tmp_path):
    """A copy of the elbow's model with another name, outside the folder of the .blend file."""
    return Path(shutil.copy(elbow_files.model, tmp_path / "second.onnx"))


def test_switching_between_models(rig, elbow_files, second):
    bpy.ops.fdda.add_model(filepath=str(elbow_files.model))
    bpy.ops.fdda.add_model(filepath=str(second))
    bpy.ops.fdda.add_model(filepath=str(elbow_files.model))
    fdda = rig.mesh_object.fdda
    assert [entry.name for entry in fdda.models] == ["elbow", "second"] and fdda.model_index == 0
    for index, name in ((1, "second"), (0, "elbow"), (1, "second")):
        fdda.model_index = index
        fdda.use_in_render = True
        bpy.ops.fdda.bind()
        assert bound_entry(rig.mesh_object).name == name and fdda.use_in_render
        pose(angle=0.5 + index)
        assert_plays(rig.mesh_object, elbow_files.model)
    assert sum(m.type == "NODES" for m in rig.mesh_object.modifiers) == 1


def test_removing_a_model_unbinds_it(rig, elbow_files, second):
    bpy.ops.fdda.add_model(filepath=str(second))
    bpy.ops.fdda.bind(filepath=str(elbow_files.model))
    fdda = rig.mesh_object.fdda
    bpy.ops.fdda.remove_model(index=0)
    assert fdda.is_bound and [entry.name for entry in fdda.models] == ["elbow"]
    bpy.ops.fdda.remove_model()
    assert not fdda.is_bound and not fdda.models and elbow_files.model.is_file()
    refused(bpy.ops.fdda.remove_model, "The model library is empty")


def test_a_model_of_another_rig_is_not_added(rig, elbow_files):
    rig.armature_object.data.bones["lower"].name = "forearm"
    refused(lambda: bpy.ops.fdda.add_model(filepath=str(elbow_files.model)), "it does not know the joint 'forearm'")
    assert not rig.mesh_object.fdda.models


def move_vertex() -> None:
    bpy.data.objects[ELBOW].data.vertices[3].co.x += 0.02


def add_vertex() -> None:
    bpy.data.objects[ELBOW].data.vertices.add(1)
    bpy.data.objects[ELBOW].vertex_groups["lower"].add([len(bpy.data.objects[ELBOW].data.vertices) - 1], 1.0, "REPLACE")


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
def test_the_section_names_the_change_that_outdates_a_model(active, change, words):
    assert problem_of(active) is None
    active.fdda.mode = "RIG"
    change()
    icon, sentence = problem_of(active)
    assert icon == "ERROR" and sentence.startswith("elbow was trained for an earlier state of this rig")
    assert words in sentence and sentence.endswith("record and train again.")


def problem_of(mesh_object: bpy.types.Object) -> tuple[str, str] | None:
    """Return icon and sentence of the section about the only model of a mesh; None for a model without a problem."""
    checks.unregister()
    checks.check_now(find_rig())
    return next(iter(timed_values.compute_now(models._find_problems, mesh_object).values()), None)


def test_a_changed_range_of_motion_is_reported_and_does_not_prevent_playback(active, elbow_files):
    bpy.data.objects[ELBOW_RIG].pose.bones["lower"].constraints[0].max_x += 0.1
    icon, sentence = problem_of(active)
    assert icon == "INFO"
    assert sentence.startswith("The range of motion of 'lower' has changed since elbow was trained: it plays")
    pose(angle=0.1)
    assert_plays(active, elbow_files.model)
    active.fdda.models[0].path = "//away.onnx"
    icon, sentence = problem_of(active)
    assert icon == "ERROR" and f"cannot be read: {systems.NOT_FOUND}; find it, or choose another." in sentence


def test_a_listed_model_outside_the_folder_of_the_file_is_refused(active, elbow_files, second):
    entry = active.fdda.models.add()
    entry.name, entry.path = "second", str(second)
    active.fdda.model_index = 1
    refused(bpy.ops.fdda.bind, "lies outside the folder of 'bound.blend'")
    refused(bpy.ops.fdda.pack_model, "lies outside the folder")
    refused(lambda: bpy.ops.fdda.pack_model(index=3), "has 2 models and none with index 3")
    assert bound_entry(active).name == "elbow"
    bpy.ops.fdda.bind(filepath=str(second))
    assert bound_entry(active).name == "second" and len(active.fdda.models) == 2


def test_a_model_file_that_is_replaced_is_reloaded(active, elbow_files, second, tmp_path):
    """Training again replaces the file of a bound model."""
    import onnx

    from fdda_addon.evaluation import last_evaluation
    from fdda_addon.models import model_list

    path = tmp_path / "second.onnx"
    bpy.ops.fdda.bind(filepath=str(path))
    bpy.ops.fdda.evaluate(source="RANDOM", poses=1)
    bpy.ops.fdda.measure(frames=5)
    armature_object = bpy.data.objects[ELBOW_RIG]
    assert measurements.last(measurements.MEASURE, armature_object) is not None
    pose(angle=1.3)
    before = assert_plays(active, path)

    def double(proto: onnx.ModelProto) -> None:
        node = next(node for node in proto.graph.node if "positions" in node.output)
        node.output[0] = "before"
        proto.graph.node.append(onnx.helper.make_node("Add", ["before", "before"], ["positions"]))

    write_edited(path, path, double)
    model_list.add_model(active, path)
    bpy.context.view_layer.update()
    after = assert_plays(active, path)
    np.testing.assert_allclose(after, 2 * before, atol=1e-5)
    assert last_evaluation.get(active) is None and measurements.last(measurements.MEASURE, armature_object) is None
    assert len(active.fdda.models) == 2


def test_file_sizes_are_formatted_in_kilobytes_and_megabytes():
    assert [format_file_size(count) for count in (2_340, 1_340_169)] == ["2.3 kB", "1.3 MB"]


def test_a_replaced_model_file_of_equal_size_is_reloaded_when_it_is_bound(rig, second, tmp_path):
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
