# SPDX-License-Identifier: GPL-3.0-or-later
"""The rig can be displayed together with the playing model; the displayed copy is never saved."""

import bpy
import numpy as np
import pytest

from fdda_addon.evaluation import side_by_side
from fdda_addon.scene.active_rig import rigs_together
from fdda_addon.scene.comparison import comparison_objects, hidden_comparison_objects, is_comparison
from fdda_addon.scene.scene_rig import armature_of, find_rig, find_rigs

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose
from ..refusals import refused


@pytest.fixture
def active(bound_elbow):
    bpy.context.view_layer.objects.active = bound_elbow
    pose(angle=1.3)
    return bound_elbow


def world(mesh_object: bpy.types.Object) -> np.ndarray:
    """(V, 3): what is shown, in the world."""
    matrix = np.array(mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world)
    return evaluated_positions(mesh_object) @ matrix[:3, :3].T + matrix[:3, 3]


def rig_world(mesh_object: bpy.types.Object) -> np.ndarray:
    mode, mesh_object.fdda.mode = mesh_object.fdda.mode, "RIG"
    bpy.context.view_layer.update()
    shown = world(mesh_object)
    mesh_object.fdda.mode = mode
    bpy.context.view_layer.update()
    return shown


@pytest.mark.parametrize("scale", [1.0, 0.01])
@pytest.mark.parametrize("turned", [0.0, 0.7])
def test_beside_is_the_rig_to_the_side_in_every_pose(active, scale, turned):
    armature_of(active).rotation_euler = (turned, 0.3 * turned, turned)
    armature_of(active).scale = (scale,) * 3
    if active.parent is None:
        active.rotation_euler, active.scale = armature_of(active).rotation_euler, (scale,) * 3
    bpy.context.view_layer.update()
    width = np.ptp(world(active)[:, 0])
    assert bpy.ops.fdda.show_rig(placement="BESIDE") == {"FINISHED"}
    other = side_by_side.find(active)
    for angle in (1.3, 0.2):
        pose(angle=angle)
        apart = world(other) - rig_world(active)
        # The bounding box in local axes is slightly wider when the character is rotated.
        assert width < apart[0, 0] < 2 * width
        np.testing.assert_allclose(apart, np.tile([apart[0, 0], 0, 0], (len(apart), 1)), atol=2e-5)
    bpy.ops.fdda.show_rig(placement="BESIDE", distance=3.0)
    bpy.context.view_layer.update()
    assert len(comparison_objects()) == 1
    apart = world(side_by_side.find(active)) - rig_world(active)
    np.testing.assert_allclose(apart[:, 0], 3.0, atol=2e-5)


def test_overlay_is_the_rig_as_a_wireframe_where_it_is(active, elbow_files):
    bpy.ops.fdda.show_rig(placement="OVERLAY")
    other = side_by_side.find(active)
    pose(angle=0.8)
    np.testing.assert_allclose(world(other), rig_world(active), atol=1e-6)
    assert_plays(active, elbow_files.model)
    assert other.display_type == "WIRE" and side_by_side.display_mode(active) == "OVERLAY"
    assert other.hide_select and other.hide_render and other.data == active.data and not other.fdda.is_bound


def test_off_leaves_nothing(active):
    def counts() -> dict[str, int]:
        return {kind: len(getattr(bpy.data, kind)) for kind in ("objects", "meshes", "node_groups", "collections")}

    before = counts()
    for placement in ("BESIDE", "OVERLAY", "NONE"):
        bpy.ops.fdda.show_rig(placement=placement)
    assert before == counts()
    assert side_by_side.display_mode(active) == "NONE" and not comparison_objects()
    bpy.ops.fdda.show_rig(placement="BESIDE")
    bpy.ops.fdda.unbind()
    assert not comparison_objects()
    refused(bpy.ops.fdda.show_rig, "No model is bound")


def test_the_displayed_rig_is_no_character(active):
    bpy.ops.fdda.show_rig(placement="BESIDE")
    assert find_rig().mesh_object == active and [rig.mesh_object for rig in find_rigs()] == [active]
    bpy.context.view_layer.objects.active = armature_of(active)
    assert rigs_together(bpy.context) == []


def test_the_displayed_rig_is_not_saved_and_stays_visible(active, elbow_files, tmp_path):
    bpy.ops.fdda.pack_model()
    bpy.ops.fdda.show_rig(placement="BESIDE")
    name, links = side_by_side.find(active).name, len(bpy.context.scene.collection.objects)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert side_by_side.find(active).name == name
    pose(angle=0.5)
    assert_plays(active, elbow_files.model)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert name not in bpy.data.objects and not comparison_objects()
    assert len(bpy.context.scene.collection.objects) == links - 1
    assert bpy.data.objects[ELBOW].data.users == 1
    bpy.ops.wm.read_homefile(app_template="")
    with bpy.data.libraries.load(str(tmp_path / "a.blend")) as (there, _):
        assert sorted(there.objects) == [ELBOW, ELBOW_RIG]


def test_undo_and_redo_hide_and_show_the_displayed_rig(active, elbow_files):
    bpy.ops.ed.undo_push(message="bound")
    bpy.ops.fdda.show_rig(placement="BESIDE")
    bpy.ops.ed.undo_push(message="beside")
    pose(angle=0.4)
    bpy.ops.ed.undo_push(message="posed")
    for _ in range(3):
        bpy.ops.ed.undo()
        assert len(comparison_objects()) == 1
        bpy.context.view_layer.update()
        assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
        bpy.ops.ed.undo()
        assert not comparison_objects()
        bpy.context.view_layer.update()
        assert_plays(bpy.data.objects[ELBOW], elbow_files.model)
        bpy.ops.ed.redo()
        bpy.ops.ed.redo()
        mesh_object = bpy.data.objects[ELBOW]
        assert side_by_side.find(mesh_object) is not None
        pose(angle=0.6)
        assert_plays(mesh_object, elbow_files.model)


def test_deleting_the_character_removes_the_displayed_rig(active):
    bpy.ops.fdda.show_rig(placement="OVERLAY")
    bpy.data.objects.remove(active)
    bpy.context.view_layer.update()
    assert not comparison_objects()


def test_jobs_do_not_evaluate_the_displayed_rig(active, tmp_path):
    bpy.ops.fdda.show_rig(placement="BESIDE")
    other = side_by_side.find(active)
    with hidden_comparison_objects():
        assert other.hide_viewport
    assert not other.hide_viewport
    seen = []
    bpy.app.handlers.depsgraph_update_post.append(lambda *_: seen.append(other.hide_viewport))
    bpy.ops.fdda.evaluate(source="RANDOM", poses=3)
    assert any(seen) and not other.hide_viewport
    assert is_comparison(other)


def test_the_rig_of_an_override_is_displayed(pair):
    for mesh_object in pair:
        bpy.ops.fdda.show_rig(object=mesh_object.name, placement="BESIDE")
    bpy.context.view_layer.update()
    for mesh_object in pair:
        apart = world(side_by_side.find(mesh_object)) - rig_world(mesh_object)
        assert np.ptp(apart, axis=0).max() < 2e-5 and apart[:, 0].min() > 0.1
    assert len(comparison_objects()) == 2
