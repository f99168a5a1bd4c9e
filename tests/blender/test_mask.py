# SPDX-License-Identifier: GPL-3.0-or-later
"""A mask: a vertex group that says where the model counts, painted, inverted, animated poses, baked, evaluated."""

import bpy
import numpy as np
import pytest

from fdda_addon.evaluation import last_evaluation, pictures
from fdda_addon.evaluation.run import evaluate_action
from fdda_addon.panels.playback import mask_problem
from fdda_addon.rig.reading import read_model_rig
from fdda_addon.runtime import registry
from fdda_addon.runtime.binding import model_disabled
from fdda_addon.runtime.network import Network
from fdda_addon.runtime.player import Player
from fdda_addon.scene import mask as masks
from fdda_addon.scene.scene_rig import SceneRig, armature_of

from .baked_files import read_pc2
from .conftest import ELBOW, assert_plays, evaluated, pose
from .scene_state import drain
from .test_player_batch import animate, crowd_of

GROUP = "learned"


def paint(mesh_object: bpy.types.Object, weights: np.ndarray, name: str = GROUP) -> None:
    """Give a vertex group weights; vertices with none are not in it."""
    group = mesh_object.vertex_groups.get(name) or mesh_object.vertex_groups.new(name=name)
    for index, weight in enumerate(weights.tolist()):
        if weight:
            group.add([index], weight, "REPLACE")
        else:
            group.remove([index])
    bpy.context.view_layer.update()


def ramp(mesh_object: bpy.types.Object) -> np.ndarray:
    """(V,) weights of all kinds: none, all, and between."""
    return np.clip(np.linspace(-0.5, 1.5, len(mesh_object.data.vertices)), 0, 1).astype(np.float32)


def both(mesh_object: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """What linear skinning and the model alone show of the pose."""
    name, mode, mesh_object.fdda.mask = mesh_object.fdda.mask, mesh_object.fdda.mode, ""
    shown = []
    for mesh_object.fdda.mode in ("LINEAR", "FDDA"):
        bpy.context.view_layer.update()
        shown.append(evaluated(mesh_object))
    mesh_object.fdda.mask, mesh_object.fdda.mode = name, mode
    bpy.context.view_layer.update()
    return tuple(shown)


@pytest.fixture
def masked(bound):
    pose(angle=1.4)
    paint(bound, ramp(bound))
    bound.fdda.mask = GROUP
    bpy.context.view_layer.objects.active = bound
    bpy.context.view_layer.update()
    return bound


def test_the_weight_blends_the_model_with_linear_skinning(masked):
    weights = ramp(masked)[:, None]
    for angle in (1.4, 0.6, -0.2):
        pose(angle=angle)
        linear, model = both(masked)
        assert np.abs(evaluated(masked) - (linear + weights * (model - linear))).max() < 1e-6
        # No rounding where nothing is to be blended.
        assert (evaluated(masked)[weights[:, 0] == 1] == model[weights[:, 0] == 1]).all()
    pose(angle=1.4)
    linear, model = both(masked)
    assert np.abs(model - linear).max() > 1e-3, "the pose tells the two apart"


def test_an_inverted_mask_leaves_the_group_out(masked):
    linear, model = both(masked)
    masked.fdda.invert_mask = True
    bpy.context.view_layer.update()
    weights = 1 - ramp(masked)[:, None]
    assert np.abs(evaluated(masked) - (linear + weights * (model - linear))).max() < 1e-6


def test_strength_is_times_the_weight(masked):
    linear, model = both(masked)
    masked.fdda.strength = 0.5
    bpy.context.view_layer.update()
    expected = linear + 0.5 * ramp(masked)[:, None] * (model - linear)
    assert np.abs(evaluated(masked) - expected).max() < 1e-6


def test_weights_that_are_painted_while_it_plays_show(masked):
    linear, model = both(masked)
    weights = 1 - ramp(masked)
    paint(masked, weights)
    assert np.abs(evaluated(masked) - (linear + weights[:, None] * (model - linear))).max() < 1e-6
    assert not masked.fdda.status


@pytest.mark.parametrize("what", ["removed", "renamed", "never there", "empty"])
def test_without_the_group_the_model_counts_everywhere(masked, elbow, what):
    if what == "removed":
        masked.vertex_groups.remove(masked.vertex_groups[GROUP])
    elif what == "renamed":
        masked.vertex_groups[GROUP].name = "other"
        masked.update_tag()
    else:
        masked.fdda.mask = "none" if what == "never there" else ""
    bpy.context.view_layer.update()
    bpy.context.view_layer.update()
    assert_plays(masked, elbow.model)
    name = masked.fdda.mask
    said = f"'elbow' has no vertex group '{name}', so the mask has no effect; choose another."
    assert mask_problem(masked) == (said if name else "")


def test_a_group_that_is_not_a_bones_changes_nothing_of_the_rig(masked, elbow):
    info = Network(elbow.model).info
    rig = read_model_rig(SceneRig(masked, armature_of(masked)), info)
    assert rig.fingerprint == info.fingerprint
    bpy.ops.fdda.unbind()
    assert masked.fdda.mask == GROUP
    assert bpy.ops.fdda.bind() == {"FINISHED"}
    linear, model = both(masked)
    assert np.abs(evaluated(masked) - (linear + ramp(masked)[:, None] * (model - linear))).max() < 1e-6


def test_it_is_saved_and_undone_with_the_file(masked, tmp_path):
    bpy.context.scene.frame_set(12)
    before = evaluated(masked)
    bpy.ops.ed.undo_push(message="masked")
    masked.fdda.mask = ""
    bpy.ops.ed.undo_push(message="unmasked")
    bpy.ops.ed.undo()
    masked = bpy.data.objects[ELBOW]
    assert masked.fdda.mask == GROUP and (evaluated(masked) == before).all()
    bpy.ops.fdda.pack_model()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.context.scene.frame_set(12)
    assert np.abs(evaluated(bpy.data.objects[ELBOW]) - before).max() < 1e-6


def test_in_a_frame_a_mask_costs_nothing_where_there_is_none(bound, monkeypatch):
    """Neither read nor blended, however the character is posed."""
    asked = []
    monkeypatch.setattr(masks, "read_mask", lambda *_: asked.append("read"))
    monkeypatch.setattr("fdda_addon.runtime.player.read_mask", lambda *_: asked.append("read"))
    monkeypatch.setattr(Player, "_create_blend", lambda *_: asked.append("blended"))
    for angle in (0.3, 0.9):
        pose(angle=angle)
    bpy.context.scene.frame_set(7)
    assert not asked


def test_weights_are_not_read_again_while_it_is_posed(masked, monkeypatch):
    read = []
    monkeypatch.setattr("fdda_addon.runtime.player.read_mask", lambda *_: read.append(1))
    for angle in (0.3, 0.9):
        pose(angle=angle)
    for frame in (3, 4):
        bpy.context.scene.frame_set(frame)
    assert not read


def test_what_is_baked_is_what_is_shown(masked, tmp_path):
    assert bpy.ops.fdda.bake(filepath=str(tmp_path / "a.pc2")) == {"FINISHED"}
    baked = read_pc2(tmp_path / "a.pc2")[2]
    for frame in (1, 12, 20):
        bpy.context.scene.frame_set(frame)
        assert np.abs(baked[frame - bpy.context.scene.frame_start] - evaluated(masked)).max() < 1e-5
    masked.fdda.mask = ""
    bpy.context.view_layer.update()
    assert np.abs(baked[20 - bpy.context.scene.frame_start] - evaluated(masked)).max() > 1e-4


def test_what_is_evaluated_is_what_is_shown(masked):
    bpy.ops.fdda.evaluate()
    errors = last_evaluation.get(masked).errors
    weights = ramp(masked)
    assert (errors["fdda"][:, weights == 0] == errors["linear"][:, weights == 0]).all()
    for frame in (5, 20):
        bpy.context.scene.frame_set(frame)
        shown = evaluated(masked)
        masked.fdda.mode = "RIG"
        bpy.context.view_layer.update()
        apart = np.linalg.norm(shown - evaluated(masked), axis=1)
        masked.fdda.mode = "FDDA"
        bpy.context.view_layer.update()
        pose_index = last_evaluation.get(masked).pose_at(frame)
        assert np.abs(errors["fdda"][pose_index] - apart).max() < 1e-5


def test_picture_shows_the_masked_model(masked, elbow, tmp_path, monkeypatch):
    drawn_rows = []
    monkeypatch.setattr(pictures, "draw", lambda mesh, rows, *_, **options: drawn_rows.extend(rows))
    scene_rig = SceneRig(masked, armature_of(masked))
    with model_disabled(masked):
        evaluation = drain(evaluate_action(scene_rig, elbow.model, "elbow_wave"))
    posed = pictures.make_pictured_pose(evaluation.held_out, 11)
    pictures.draw_comparison(scene_rig, elbow.model, [posed], tmp_path / "heat_map.png", heat=True)
    ((_, _, model_cell),) = drawn_rows
    errors = np.linalg.norm(model_cell.positions - posed.positions, axis=1)
    np.testing.assert_allclose(errors, evaluation.held_out.fdda[11], atol=1e-6)
    assert np.abs(model_cell.positions - Network(elbow.model).positions(posed.pose_matrices[None])[0]).max() > 1e-4


def test_members_of_a_crowd_have_masks_of_their_own(bound):
    crowd = crowd_of(bound, 6)
    animate(crowd)
    paint(crowd[0], ramp(bound))
    crowd[1].fdda.mask = crowd[2].fdda.mask = GROUP
    crowd[2].fdda.invert_mask = True
    crowd[3].fdda.mask, crowd[3].fdda.strength = GROUP, 0.5
    scene = bpy.context.scene
    for frame in (1, 2, 3, 4):
        scene.frame_set(frame)
    assert registry.batches.by_driver, "they play together"
    shown = [evaluated(mesh_object) for mesh_object in crowd]
    ramps = ramp(bound)[:, None]
    for mesh_object, positions, weights in zip(crowd, shown, (1, ramps, 1 - ramps, 0.5 * ramps, 1, 1), strict=True):
        mesh_object.fdda.strength = 1
        linear, model = both(mesh_object)
        assert np.abs(positions - (linear + weights * (model - linear))).max() < 1e-6
