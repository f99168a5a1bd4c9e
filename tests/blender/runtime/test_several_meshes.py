# SPDX-License-Identifier: GPL-3.0-or-later
"""A model of three meshes of one armature: one reading of the pose and one run a frame, whatever the meshes show."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from blend_fixtures.characters.meshes import dressed_limb
from fdda_addon.rig.reading import PoseEvaluator, PoseReader
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.confidence import partition_confidence
from fdda_addon.runtime.model_files import network_of
from fdda_addon.runtime.session import session
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import armature_of, find_rig

from ..baked_files import import_baked, world_positions
from ..conftest import (
    ELBOW,
    ELBOW_RIG,
    assert_plays,
    evaluated_positions,
    output_of,
    pose,
    predicted_positions,
    rig_positions,
    run,
    train,
)
from ..playback import count_calls, set_camera, still

SLEEVE, CUFF = "sleeve", "cuff"
NAMES = (ELBOW, SLEEVE, CUFF)
MAX_ERROR_M = 8e-3


@dataclass(frozen=True)
class Files:
    """Paths of the files of the character, all in one folder."""

    rig: Path
    model: Path
    bound: Path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("three")
    made = Files(*(folder / name for name in ("rig.blend", "model.onnx", "bound.blend")))
    fdda_addon.register()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    dressed_limb()
    save_copy(made.rig)
    recording = folder / "recording"
    assert run("record", made.rig, recording, "--all", "--poses", 60, "--action", "elbow_wave") == 0
    train(recording, made.model, "--passes", 20, "--hidden", 16)
    assert len(output_of("bind", made.rig, made.model, made.bound).out) == 3
    fdda_addon.unregister()
    return made


@pytest.fixture
def meshes(files) -> dict[str, bpy.types.Object]:
    """The three mesh objects of the opened bound file, by name."""
    bpy.ops.wm.open_mainfile(filepath=str(files.bound))
    return {name: bpy.data.objects[name] for name in NAMES}


@pytest.fixture
def counts(monkeypatch) -> Iterator[tuple[list, list]]:
    """The number of poses of each run, and the names of the mesh objects from which poses were read."""
    readings, read = [], PoseReader.read
    monkeypatch.setattr(
        PoseReader, "read", lambda reader, o, armature: readings.append(o.name) or read(reader, o, armature)
    )
    return count_calls(monkeypatch), readings


def play(frame: int, counts: tuple[list, list]) -> tuple[list, list]:
    """Evaluate a frame, and return the runs and readings of it."""
    for each in counts:
        each.clear()
    bpy.context.scene.frame_set(frame)
    return tuple(map(list, counts))


def duplicate() -> dict[str, bpy.types.Object]:
    """Duplicate the three meshes and their armature, and return the new meshes by their names in the model."""
    for scene_object in bpy.data.objects:
        if scene_object.name in bpy.context.scene.objects:
            scene_object.select_set(scene_object.name in (*NAMES, ELBOW_RIG))
    bpy.ops.object.duplicate()
    return {o.fdda.model_mesh: o for o in bpy.context.selected_objects if o.type == "MESH"}


def test_the_meshes_share_reading_run_and_driver(meshes, files, counts):
    play(3, counts)
    runs, readings = play(12, counts)
    assert (runs, len(readings)) == ([1], 1)
    for mesh_object in meshes.values():
        shown = assert_plays(mesh_object, files.model)
        scale = mesh_object.matrix_world.median_scale
        assert scale * np.abs(shown - rig_positions(mesh_object)).max() < MAX_ERROR_M, mesh_object.name
    buffers = [o for o in bpy.data.objects if o.animation_data and o.is_runtime_data]
    assert sorted(len(o.animation_data.drivers[0].driver.variables) for o in buffers)[:2] == [1, 1]
    assert len(session.batches) == 1


@pytest.mark.parametrize(
    ("hidden", "expected"), [((ELBOW,), [1]), ((SLEEVE, CUFF), [1]), (NAMES, [])], ids=["first", "others", "all"]
)
def test_hidden_meshes(meshes, files, counts, hidden, expected):
    for name in hidden:
        meshes[name].hide_viewport = True
    bpy.context.view_layer.update()
    play(3, counts)
    runs, readings = play(12, counts)
    assert (runs, len(readings)) == (expected, len(expected))
    for name in set(NAMES) - set(hidden):
        assert_plays(meshes[name], files.model)
    for name in hidden:
        meshes[name].hide_viewport = False
    bpy.context.view_layer.update()
    for mesh_object in meshes.values():
        assert_plays(mesh_object, files.model)


def test_mode_strength_and_mask_belong_to_each_mesh(meshes, files, counts):
    pose(angle=1.1)
    full = {name: evaluated_positions(mesh_object) for name, mesh_object in meshes.items()}
    meshes[SLEEVE].fdda.mode = "LINEAR"
    bpy.context.view_layer.update()
    linear = evaluated_positions(meshes[SLEEVE])
    assert np.abs(linear - full[SLEEVE]).max() > 1e-3
    meshes[SLEEVE].fdda.mode, meshes[SLEEVE].fdda.strength = "FDDA", 0.25
    group = meshes[SLEEVE].vertex_groups.new(name="mask")
    group.add(range(100), 1.0, "REPLACE")
    bpy.context.view_layer.update()
    assert np.abs(evaluated_positions(meshes[SLEEVE]) - (0.75 * linear + 0.25 * full[SLEEVE])).max() < 1e-5
    meshes[SLEEVE].fdda.strength, meshes[SLEEVE].fdda.mask = 1.0, "mask"
    for counted in counts:
        counted.clear()
    bpy.context.view_layer.update()
    assert not counts[0], "the pose is the same"
    expected = np.concatenate([full[SLEEVE][:100], linear[100:]])
    assert np.abs(evaluated_positions(meshes[SLEEVE]) - expected).max() < 1e-5
    meshes[CUFF].fdda.mode = "RIG"
    bpy.context.view_layer.update()
    assert [not player.error for batch in session.batches.values() for player in batch.groups[0].members.values()] == [
        True,
        True,
    ]
    assert np.array_equal(assert_plays(meshes[ELBOW], files.model), full[ELBOW])


def test_all_meshes_as_linear_skinning_do_not_run_the_model(meshes, counts):
    for mesh_object in meshes.values():
        mesh_object.fdda.mode = "LINEAR"
    play(3, counts)
    assert play(12, counts)[0] == []


@pytest.mark.parametrize("name", NAMES)
def test_a_mesh_that_moves_alone_reads_its_own_pose(meshes, files, counts, name):
    meshes[name].location.z += 0.05
    play(3, counts)
    runs, readings = play(12, counts)
    assert len(runs) == len(readings) and set(runs) == {1} and len(runs) in (2, 3)
    for mesh_object in meshes.values():
        assert_plays(mesh_object, files.model)
    meshes[name].location.z -= 0.05
    play(3, counts)
    assert play(12, counts)[0] == [1]


@pytest.mark.parametrize(("scale", "distance"), [(1.0, 100.0), (0.001, 0.1)], ids=["meters", "millimeters"])
def test_far_from_the_origin_the_meshes_share_the_pose(meshes, files, counts, scale, distance):
    armature_object = bpy.data.objects[ELBOW_RIG]
    armature_object.location, armature_object.rotation_euler = (distance, -distance, distance / 2), (0.4, 1.0, -2.0)
    armature_object.scale = (scale,) * 3
    play(3, counts)
    assert play(12, counts)[0] == [1]
    for mesh_object in meshes.values():
        differences = evaluated_positions(mesh_object) - predicted_positions(mesh_object, files.model)
        assert np.abs(differences).max() < 1e-5 + 1e-6 * distance / scale


@pytest.mark.parametrize(
    ("action", "name"),
    [*itertools.product(["unbind", "fail"], NAMES), ("delete", SLEEVE), ("delete", CUFF)],
)
def test_without_one_mesh_the_others_play(meshes, files, counts, action, name):
    """Sleeve and cuff cannot play without the body, on which their modifiers depend."""
    removed = meshes.pop(name)
    if action == "unbind":
        unbind(removed)
    elif action == "delete":
        bpy.data.objects.remove(removed)
    else:
        removed.data.vertices.add(1)
        removed.data.update()
    bpy.context.view_layer.update()
    play(3, counts)
    runs, readings = play(12, counts)
    assert runs == [1] and len(readings) == 1
    for mesh_object in meshes.values():
        # The body plays without the numbers of the sleeve, and says so.
        lacks_inputs = (action, name) == ("delete", SLEEVE)
        assert ("'sleeve' of the model is missing" in mesh_object.fdda.status) == lacks_inputs
        mesh_object.fdda.status = ""
        assert_plays(mesh_object, files.model)
    if action == "unbind":
        bind(find_rig(name), files.model)
        play(4, counts)
        assert play(12, counts)[0] == [1]
        assert_plays(removed, files.model)


def test_a_mesh_plays_another_model(meshes, files, counts, tmp_path):
    other = tmp_path / "other.onnx"
    other.write_bytes(files.model.read_bytes())
    bind(find_rig(SLEEVE), other)
    play(3, counts)
    assert play(12, counts)[0] == [1, 1]
    for mesh_object in meshes.values():
        assert_plays(mesh_object, files.model)


def test_the_confidence_of_a_mesh_has_its_own_parts(meshes):
    bpy.context.scene.frame_set(12)
    network = network_of(meshes[ELBOW])
    parts = {name: {part for part, _ in partition_confidence(meshes[name])} for name in NAMES}
    assert set.union(*parts.values()) == {network.info.joint_names[p.joint] for p in network.info.partitions}
    for name in NAMES:
        sums = dict.fromkeys(network.info.joint_names, 0.0)
        mesh_object = meshes[name]
        if name == CUFF:
            continue  # It has fitted weights.
        for vertex in mesh_object.data.vertices:
            largest = max(vertex.groups, key=lambda g: g.weight)
            sums[mesh_object.vertex_groups[largest.group].name] += 1
        assert parts[name] == {joint for joint, count in sums.items() if count}


@pytest.mark.parametrize("count", [3, 4])
def test_characters_of_a_crowd_run_the_model_once(meshes, files, counts, count):
    crowd = [meshes, *(duplicate() for _ in range(count - 1))]
    assert all(each.keys() == set(NAMES) for each in crowd)
    for index, each in enumerate(crowd):
        armature_object = armature_of(each[CUFF])
        assert armature_object == armature_of(each[ELBOW])
        armature_object.location.y = index
    for frame in range(1, 5):
        play(frame, counts)
    runs, readings = play(12, counts)
    assert runs == ([4] if count == 4 else [1] * 3) and len(readings) == count
    for each in crowd:
        for mesh_object in each.values():
            assert_plays(mesh_object, files.model)
    bpy.data.objects.remove(crowd[1].pop(SLEEVE))
    for frame in range(1, 5):
        play(frame, counts)
    for mesh_object in crowd[1].values():
        assert "is missing" in mesh_object.fdda.status
        mesh_object.fdda.status = ""
    for each in crowd:
        for mesh_object in each.values():
            assert_plays(mesh_object, files.model)


def test_undo_save_and_load(meshes, files, tmp_path):
    bpy.ops.ed.undo_push(message="before")
    bpy.data.objects.remove(meshes[SLEEVE])
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    for name in NAMES:
        assert_plays(bpy.data.objects[name], files.model)
    path = files.bound.with_name("saved.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    bpy.context.scene.frame_set(12)
    for name in NAMES:
        assert_plays(bpy.data.objects[name], files.model)


def test_a_keyed_mode_switches_one_mesh(meshes, files, counts):
    for frame, mode in ((1, "RIG"), (10, "FDDA")):
        meshes[SLEEVE].fdda.mode = mode
        meshes[SLEEVE].keyframe_insert("fdda.mode", frame=frame)
    play(5, counts)
    assert play(6, counts)[0] == [1]
    assert sum(len(group.members) for batch in session.batches.values() for group in batch.groups) == 2
    play(12, counts)
    assert play(13, counts)[0] == [1]
    for mesh_object in meshes.values():
        assert_plays(mesh_object, files.model)


def test_a_render_with_motion_blur(meshes, files, tmp_path):
    set_camera()
    scene = bpy.context.scene
    scene.render.use_motion_blur = True
    meshes[SLEEVE].fdda.use_in_render = True
    scene.frame_set(7)
    before = {name: evaluated_positions(mesh_object) for name, mesh_object in meshes.items()}
    still(tmp_path / "still.png")
    for name, mesh_object in meshes.items():
        assert np.array_equal(assert_plays(mesh_object, files.model), before[name])


def test_overrides_of_a_linked_character(files, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(files.bound))
    collection = bpy.data.collections.new("character")
    bpy.context.scene.collection.children.link(collection)
    for name in (*NAMES, ELBOW_RIG):
        bpy.context.scene.collection.objects.unlink(bpy.data.objects[name])
        collection.objects.link(bpy.data.objects[name])
    path = files.bound.with_name("library.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    fdda_addon.register()
    bpy.ops.wm.save_as_mainfile(filepath=str(files.bound.with_name("shot.blend")))
    with bpy.data.libraries.load(str(path), link=True) as (_, linked):
        linked.collections = ["character"]
    (collection,) = linked.collections
    for _ in range(2):
        collection.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer, do_fully_editable=True)
    overrides = [o for o in bpy.data.objects if o.override_library and o.type == "MESH"]
    assert len(overrides) == 6
    for mesh_object in overrides:
        mesh_object.fdda.mode = "FDDA"
    bpy.context.scene.frame_set(3)
    armatures = list(dict.fromkeys(map(armature_of, overrides)))
    for armature_object, angle in zip(armatures, (0.4, 1.3), strict=True):
        armature_object.animation_data_clear()
        pose(armature_object.name, angle)
    for mesh_object in overrides:
        assert_plays(mesh_object, files.model)
    assert {len(group.members) for batch in session.batches.values() for group in batch.groups} == {3}


def test_bind_names_missing_and_changed_meshes(files, tmp_path):
    bpy.ops.wm.open_mainfile(filepath=str(files.rig))
    bpy.data.objects[CUFF].data.vertices[0].co.z += 0.01
    bpy.data.objects.remove(bpy.data.objects[SLEEVE])
    changed, bound = files.rig.with_name("changed.blend"), files.rig.with_name("bound_rest.blend")
    save_copy(changed)
    text = "\n".join(output_of("bind", changed, files.model, bound).out)
    assert text.count("plays model.onnx") == 1 and "'elbow' plays model.onnx" in text
    assert "Left out 'cuff': " in text and "the rest pose of the mesh differs" in text
    assert "The model also deforms the mesh 'sleeve', which the armature lacks here." in text


@pytest.mark.parametrize("is_packed", [False, True], ids=["file", "packed"])
def test_the_operator_binds_all_meshes_or_one(files, is_packed, preferences):
    preferences.pack_models = is_packed
    bpy.ops.wm.open_mainfile(filepath=str(files.rig))
    meshes = {name: bpy.data.objects[name] for name in NAMES}
    meshes[CUFF].name = "renamed"
    bpy.ops.fdda.bind(filepath=str(files.model), object=SLEEVE)
    assert [o.fdda.is_bound for o in meshes.values()] == [False, True, False]
    bpy.context.view_layer.objects.active = meshes[ELBOW]
    bpy.ops.fdda.bind(filepath=str(files.model))
    bpy.context.view_layer.update()
    assert [o.fdda.model_mesh for o in meshes.values()] == list(NAMES)
    assert len({o.fdda.packed for o in meshes.values()}) == 1 and bool(meshes[CUFF].fdda.packed) is is_packed
    assert len(session.batches) == 1
    for mesh_object in meshes.values():
        assert_plays(mesh_object, files.model)
    bpy.ops.fdda.unbind(object=SLEEVE)
    assert [o.fdda.is_bound for o in meshes.values()] == [True, False, True]


def test_meshes_are_evaluated_in_one_pass(files, tmp_path, monkeypatch):
    """Each pose is evaluated once, and each mesh has the errors of an evaluation alone."""
    json_path, evaluated = tmp_path / "errors.json", []
    evaluate = PoseEvaluator.evaluate

    def evaluate_pose(evaluator: PoseEvaluator) -> tuple:
        rotations = (tuple(b.matrix_basis.to_quaternion()) for b in bpy.data.objects[ELBOW_RIG].pose.bones)
        evaluated.append((bpy.context.scene.frame_current, *rotations))
        return evaluate(evaluator)

    monkeypatch.setattr(PoseEvaluator, "evaluate", evaluate_pose)
    options = ("--poses", 4, "--action", "elbow_wave", "--json", json_path, "--overwrite")

    def errors(*object_options: str) -> dict:
        evaluated.clear()
        assert run("evaluate", files.rig, files.model, *options, *object_options) == 0
        return json.loads(json_path.read_text())

    together = errors()["objects"]
    assert list(together) == list(NAMES) and evaluated[::3] == evaluated[1::3] == evaluated[2::3]
    for name in NAMES:
        alone = errors("--object", name)
        for key in ("mean", "max"):
            assert together[name]["fdda"][key] == pytest.approx(alone["fdda"][key], rel=1e-4)
            assert together[name]["actions"][0]["linear"][key] == pytest.approx(
                alone["actions"][0]["linear"][key], rel=1e-4
            )


def test_all_meshes_are_baked(files, tmp_path):
    out, frames = tmp_path / "baked.abc", (1, 12)
    assert run("bake", files.rig, files.model, out, "--action", "elbow_wave", "--frames", *frames) == 0
    bpy.ops.wm.open_mainfile(filepath=str(files.bound))
    expected = {name: world_positions(bpy.data.objects[name], frames) for name in NAMES}
    baked = import_baked(out)
    assert baked.keys() == set(NAMES)
    for name, mesh_object in baked.items():
        assert np.abs(world_positions(mesh_object, frames) - expected[name]).max() < 1e-5, name
