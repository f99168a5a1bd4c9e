# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the section Compare with Rig: figures and colors are those of the evaluation itself."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from fdda_addon.core.mathematics.metrics import error_statistics, viewport_colors
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.evaluation import heat_map, last_evaluation
from fdda_addon.evaluation.run import evaluate, evaluate_action
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.rig.reading import read_rig
from fdda_addon.runtime.binding import model_disabled
from fdda_addon.runtime.model_files import allow_path
from fdda_addon.scene.scene_rig import find_rig

from ..conftest import ELBOW_RIG, pose
from ..refusals import refused
from ..scene_state import assert_same_state, drain, scene_state


@pytest.fixture
def view():
    view = bpy.context.window_manager.fdda_view
    for name in ("deformation", "statistic", "range_mm", "pose"):
        view.property_unset(name)
    return view


@pytest.fixture
def evaluated_action(active):
    bpy.ops.fdda.evaluate()
    yield last_evaluation.get(active)
    heat_map.clear_all()


def test_the_active_action_is_evaluated(active, elbow_files):
    before = scene_state(find_rig())
    assert bpy.ops.fdda.evaluate() == {"FINISHED"}
    assert_same_state(before, scene_state(find_rig()))
    with model_disabled(active):
        expected = drain(evaluate_action(find_rig(), elbow_files.model, "elbow_wave"))
    last = last_evaluation.get(active)
    np.testing.assert_allclose(last.errors["fdda"], expected.held_out.fdda, atol=1e-6)
    assert last.total["linear"].max == pytest.approx(error_statistics(expected.held_out.linear).max, rel=1e-3)
    assert (last.name, last.model, last.poses) == ("elbow_wave", "elbow", len(expected.held_out.fdda))
    assert sorted(p.joint for p in last.partitions) == ["lower", "upper"]
    assert sum(p.vertices for p in last.partitions) == last.vertices
    assert last.partitions[0].fdda.max == pytest.approx(last.total["fdda"].max)


def test_random_poses_are_evaluated(active, elbow_files):
    assert bpy.ops.fdda.evaluate(source="RANDOM", poses=7, seed=4) == {"FINISHED"}
    with model_disabled(active):
        expected = drain(evaluate(find_rig(), elbow_files.model, EvaluationSettings(7, 4)))
    last = last_evaluation.get(active)
    np.testing.assert_allclose(last.errors["fdda"], expected.held_out.fdda, atol=1e-6)
    assert not last.name and last.seed == 4


def test_an_evaluation_without_action_or_results_is_refused(active):
    last_evaluation.remove(active)
    refused(lambda: bpy.ops.fdda.evaluate(action="jump"), "no action 'jump'")
    bpy.data.objects[ELBOW_RIG].animation_data.action = None
    refused(
        bpy.ops.fdda.evaluate,
        "'elbow_rig' has no active action; choose one under Compare On, or compare on random poses.",
    )
    for name in ("fit_color_range", "jump_to_worst"):
        refused(getattr(bpy.ops.fdda, name), "Nothing has been compared in this session; press Evaluate first")
    refused(lambda: bpy.ops.fdda.color_mesh(colors="ERRORS"), "'elbow' has not been compared in this session")
    assert last_evaluation.get(active) is None and active.fdda.mode == "FDDA"


def test_the_action_picker_makes_an_action_active(active, view):
    armature_object = bpy.data.objects[ELBOW_RIG]
    assert view.action == "elbow_wave"
    armature_object.animation_data_clear()
    assert view.action == ""
    view.action = "no such action"
    assert armature_object.animation_data is None
    view.action = "elbow_wave"
    assert armature_object.animation_data.action.name == "elbow_wave"
    assert bpy.ops.fdda.evaluate(source="ACTION") == {"FINISHED"}


def test_colors_are_those_of_the_report(active, evaluated_action, view):
    bpy.ops.fdda.color_mesh()
    assert heat_map.paint_kind(active) == "ERRORS"
    errors = evaluated_action.errors
    assert view.range_mm == pytest.approx(np.percentile(errors["fdda"].mean(axis=0), 99.5) * 1000, rel=0.06)
    view.range_mm = 10.0
    bpy.ops.fdda.color_mesh()
    np.testing.assert_array_equal(heat_map.colors_of(active), viewport_colors(errors["fdda"].mean(axis=0), 0.01))
    view.deformation, view.statistic, view.range_mm = "linear", "max", 2.0
    np.testing.assert_array_equal(heat_map.colors_of(active), viewport_colors(errors["linear"].max(axis=0), 0.002))
    assert bpy.ops.fdda.fit_color_range() == {"FINISHED"}
    expected = np.percentile(errors["linear"].max(axis=0), 99.5) * 1000
    assert view.range_mm == pytest.approx(expected, rel=0.06)
    bpy.ops.fdda.color_mesh(colors="NONE")
    assert heat_map.colors_of(active) is None and heat_map.paint_kind(active) == ""


def test_colors_follow_the_timeline(active, evaluated_action, view):
    bpy.ops.fdda.color_mesh()
    view.statistic = "pose"
    for frame in (evaluated_action.first_frame, 12):
        bpy.context.scene.frame_set(frame)
        errors = evaluated_action.errors["fdda"][frame - evaluated_action.first_frame]
        expected = viewport_colors(errors, view.range_mm / 1000)
        np.testing.assert_array_equal(heat_map.colors_of(active), expected)
    bpy.context.scene.frame_set(evaluated_action.first_frame + evaluated_action.poses)
    assert heat_map.colors_of(active) is None
    refused(bpy.ops.fdda.fit_color_range, "choose another frame, or show the mean")


def test_overlay_follows_edited_and_replaced_faces(active, monkeypatch):
    monkeypatch.setattr(heat_map, "gpu", SimpleNamespace(types=SimpleNamespace(GPUIndexBuf=lambda type, seq: seq)))
    drawn = heat_map._MeshColors()

    def drawn_triangles() -> np.ndarray | None:
        return drawn.triangles_of(active, active.evaluated_get(bpy.context.evaluated_depsgraph_get()))

    original = drawn_triangles()
    assert drawn_triangles() is original
    bpy.ops.object.mode_set(mode="EDIT")
    assert drawn_triangles() is None
    bpy.ops.object.mode_set(mode="OBJECT")
    assert drawn_triangles() is not original
    edited = drawn_triangles()
    active.data = active.data.copy()
    assert drawn_triangles() is not edited


def test_each_partition_has_one_color(active):
    bpy.ops.fdda.color_mesh(colors="PARTITIONS")
    colors, partitions = heat_map.colors_of(active), make_partitions(read_rig(find_rig()))
    assert [len(np.unique(colors[p.vertices], axis=0)) for p in partitions] == [1, 1]
    assert not np.array_equal(*(colors[p.vertices[0]] for p in partitions))
    heat_map.clear_all()


def test_colors_do_not_change_the_file(active, evaluated_action):
    def datablocks():
        attributes = [attribute.name for attribute in active.data.attributes]
        return attributes, len(bpy.data.objects), len(bpy.data.materials), [m.name for m in active.modifiers]

    before = datablocks()
    for colors in ("ERRORS", "PARTITIONS"):
        bpy.ops.fdda.color_mesh(colors=colors)
        assert datablocks() == before


@pytest.mark.parametrize("stretch", [1, 3])
def test_worst_frames_are_jumped_to(active, evaluated_action, view, stretch):
    scene = bpy.context.scene
    scene.render.frame_map_new = 100 * stretch
    largest = evaluated_action.errors["fdda"].max(axis=1)
    worst = stretch * (evaluated_action.first_frame + int(largest.argmax()))
    bpy.ops.fdda.jump_to_worst()
    assert scene.frame_current == worst
    bpy.ops.fdda.color_mesh()
    view.statistic = "pose"
    expected = viewport_colors(evaluated_action.errors["fdda"][largest.argmax()], view.range_mm / 1000)
    np.testing.assert_array_equal(heat_map.colors_of(active), expected)
    bpy.ops.fdda.jump_to_worst(rank=2)
    assert abs(scene.frame_current - worst) >= last_evaluation.MIN_FRAMES_APART


def test_jumping_to_the_worst_random_pose_sets_the_pose(active, view):
    bpy.ops.fdda.evaluate(source="RANDOM", poses=9)
    last = last_evaluation.get(active)
    worst = int(last.errors["fdda"].max(axis=1).argmax())
    pose(angle=0.0)
    bpy.data.objects[ELBOW_RIG].animation_data.action = None
    assert bpy.ops.fdda.jump_to_worst() == {"FINISHED"}
    with model_disabled(active):
        compared = drain(evaluate(find_rig(), active_model(active), EvaluationSettings(9)))
    bone = bpy.data.objects[ELBOW_RIG].pose.bones["lower"]
    index = [joint.name for joint in read_rig(find_rig()).joints].index("lower")
    np.testing.assert_allclose(np.array(bone.matrix), compared.held_out.pose_matrices[worst][index], atol=1e-5)
    view.statistic = "pose"
    assert view.pose == worst
    np.testing.assert_array_equal(heat_map.errors_of(active), last.errors["fdda"][worst])


def active_model(mesh_object):
    from fdda_addon.runtime.model_files import model_path

    return model_path(mesh_object)


def test_the_view_goes_to_the_worst_vertex(active, evaluated_action):
    bpy.ops.fdda.jump_to_worst(rank=1, zoom=True)
    index, _ = evaluated_action.worst_poses(1)[0]
    vertex = int(evaluated_action.errors["fdda"][index].argmax())
    evaluated = active.evaluated_get(bpy.context.evaluated_depsgraph_get())
    expected = evaluated.matrix_world @ evaluated.data.vertices[vertex].co
    views = [a.spaces.active.region_3d for s in bpy.data.screens for a in s.areas if a.type == "VIEW_3D"]
    for view in views:
        assert (view.view_location - expected).length < 1e-5


def test_an_evaluation_and_its_colors_survive_opening_the_file_again(active, elbow_files, tmp_path):
    path = tmp_path / "shot.blend"
    allow_path(elbow_files.model)  # It stays in another folder, and earlier tests may have ended the choice.
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.fdda.evaluate(source="RANDOM", poses=3)
    last, name = last_evaluation.get(active), active.name
    bpy.ops.fdda.color_mesh(colors="ERRORS")
    bpy.ops.wm.save_mainfile()
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path))
        reopened = bpy.data.objects[name]
        assert last_evaluation.get(reopened) is last and heat_map.paint_kind(reopened) == heat_map.ERRORS
        # Another file has an object of this name too.
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.wm.open_mainfile(filepath=str(elbow_files.bound))
        assert last_evaluation.get(bpy.data.objects[name]) is not last
    finally:
        heat_map.clear_all()


@pytest.mark.parametrize("colors", ["ERRORS", "PARTITIONS"])
def test_colors_are_hidden_in_edit_mode_and_by_another_topology(active, colors):
    bpy.ops.fdda.evaluate(source="RANDOM", poses=1)
    assert not heat_map.is_hidden(active), "there are no colors"
    bpy.ops.fdda.color_mesh(colors=colors)
    try:
        assert heat_map.paint_kind(active) == colors and not heat_map.is_hidden(active)
        bpy.ops.object.mode_set(mode="EDIT")
        assert heat_map.is_hidden(active)
        bpy.ops.object.mode_set(mode="OBJECT")
        assert not heat_map.is_hidden(active)
        modifier = active.modifiers.new("Subdivision", "SUBSURF")
        assert heat_map.is_hidden(active)
        active.modifiers.remove(modifier)
        assert not heat_map.is_hidden(active)
    finally:
        heat_map.clear_all()


def test_only_the_latest_evaluations_are_stored(active, monkeypatch):
    monkeypatch.setattr(last_evaluation, "MAX_STORED_EVALUATIONS", 1)
    last_evaluation._evaluations[-1] = None
    bpy.ops.fdda.evaluate(source="RANDOM", poses=1)
    assert list(last_evaluation._evaluations) == [active.session_uid]
