# SPDX-License-Identifier: GPL-3.0-or-later
"""A mask is a vertex group whose weights blend the model with linear skinning at each vertex."""

import bpy
import numpy as np
import pytest

from fdda_addon.evaluation import last_evaluation, pictures
from fdda_addon.evaluation.run import evaluate_action
from fdda_addon.panels.playback import mask_problem
from fdda_addon.rig.reading import read_model_rig
from fdda_addon.runtime.binding import model_disabled
from fdda_addon.runtime.network import Network
from fdda_addon.runtime.player import Player
from fdda_addon.runtime.session import session
from fdda_addon.scene import mask as masks
from fdda_addon.scene.scene_rig import SceneRig, armature_of

from ..baked_files import read_baked
from ..conftest import ELBOW, assert_plays, evaluated_positions, pose
from ..playback import animate, crowd_of
from ..scene_state import drain

GROUP = "learned"


def paint(mesh_object: bpy.types.Object, weights: np.ndarray, name: str = GROUP) -> None:
    """Set the weights of a vertex group. Vertices with weight 0 are removed from the group."""
    group = mesh_object.vertex_groups.get(name) or mesh_object.vertex_groups.new(name=name)
    for index, weight in enumerate(weights.tolist()):
        if weight:
            group.add([index], weight, "REPLACE")
        else:
            group.remove([index])
    bpy.context.view_layer.update()


def ramp(mesh_object: bpy.types.Object) -> np.ndarray:
    """Return weights from 0 to 1, shape (V,). The first and last quarter of the vertices have exactly 0 and 1."""
    return np.clip(np.linspace(-0.5, 1.5, len(mesh_object.data.vertices)), 0, 1).astype(np.float32)


def both(mesh_object: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions with linear skinning and with the unmasked model in the current pose."""
    name, mode, mesh_object.fdda.mask = mesh_object.fdda.mask, mesh_object.fdda.mode, ""
    shown = []
    for mesh_object.fdda.mode in ("LINEAR", "FDDA"):
        bpy.context.view_layer.update()
        shown.append(evaluated_positions(mesh_object))
    mesh_object.fdda.mask, mesh_object.fdda.mode = name, mode
    bpy.context.view_layer.update()
    return tuple(shown)


@pytest.fixture
def masked(bound_elbow):
    pose(angle=1.4)
    paint(bound_elbow, ramp(bound_elbow))
    bound_elbow.fdda.mask = GROUP
    bpy.context.view_layer.objects.active = bound_elbow
    bpy.context.view_layer.update()
    return bound_elbow


def test_the_weight_blends_the_model_with_linear_skinning(masked):
    weights = ramp(masked)[:, None]
    for angle in (1.4, 0.6, -0.2):
        pose(angle=angle)
        linear, model = both(masked)
        assert np.abs(evaluated_positions(masked) - (linear + weights * (model - linear))).max() < 1e-6
        # Vertices with weight 1 have the exact positions of the model.
        assert (evaluated_positions(masked)[weights[:, 0] == 1] == model[weights[:, 0] == 1]).all()
    pose(angle=1.4)
    linear, model = both(masked)
    assert np.abs(model - linear).max() > 1e-3, "the pose tells the two apart"


def test_the_blend_follows_inversion_strength_and_painted_weights(masked):
    linear, model = both(masked)
    weights = ramp(masked)[:, None]

    def assert_blended(expected_weights: np.ndarray) -> None:
        bpy.context.view_layer.update()
        expected = linear + expected_weights * (model - linear)
        assert np.abs(evaluated_positions(masked) - expected).max() < 1e-6

    masked.fdda.invert_mask = True
    assert_blended(1 - weights)
    masked.fdda.invert_mask, masked.fdda.strength = False, 0.5
    assert_blended(0.5 * weights)
    masked.fdda.strength = 1.0
    paint(masked, 1 - ramp(masked))
    assert_blended(1 - weights)
    assert not masked.fdda.status


@pytest.mark.parametrize("what", ["removed", "renamed", "never there", "empty"])
def test_without_its_vertex_group_a_mask_has_no_effect(masked, elbow_files, what):
    if what == "removed":
        masked.vertex_groups.remove(masked.vertex_groups[GROUP])
    elif what == "renamed":
        masked.vertex_groups[GROUP].name = "other"
        masked.update_tag()
    else:
        masked.fdda.mask = "none" if what == "never there" else ""
    bpy.context.view_layer.update()
    bpy.context.view_layer.update()
    assert_plays(masked, elbow_files.model)
    name = masked.fdda.mask
    said = f"'elbow' has no vertex group '{name}', so the mask has no effect; choose another."
    assert mask_problem(masked) == (said if name else "")


def test_the_group_of_a_mask_does_not_change_the_fingerprint_of_the_rig(masked, elbow_files):
    info = Network(elbow_files.model).info
    rig = read_model_rig(SceneRig(masked, armature_of(masked)), info)
    assert rig.meshes[0].fingerprint == info.meshes[0].fingerprint
    bpy.ops.fdda.unbind()
    assert masked.fdda.mask == GROUP
    assert bpy.ops.fdda.bind() == {"FINISHED"}
    linear, model = both(masked)
    assert np.abs(evaluated_positions(masked) - (linear + ramp(masked)[:, None] * (model - linear))).max() < 1e-6


def test_a_mask_is_saved_with_the_file_and_restored_by_undo(masked, tmp_path):
    bpy.context.scene.frame_set(12)
    before = evaluated_positions(masked)
    bpy.ops.ed.undo_push(message="masked")
    masked.fdda.mask = ""
    bpy.ops.ed.undo_push(message="unmasked")
    bpy.ops.ed.undo()
    masked = bpy.data.objects[ELBOW]
    assert masked.fdda.mask == GROUP and (evaluated_positions(masked) == before).all()
    bpy.ops.fdda.pack_model()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.context.scene.frame_set(12)
    assert np.abs(evaluated_positions(bpy.data.objects[ELBOW]) - before).max() < 1e-6


def test_without_a_mask_frames_neither_read_nor_blend_weights(bound_elbow, monkeypatch):
    asked = []
    monkeypatch.setattr(masks, "read_mask", lambda *_: asked.append("read"))
    monkeypatch.setattr("fdda_addon.runtime.player.read_mask", lambda *_: asked.append("read"))
    monkeypatch.setattr(Player, "_create_blend", lambda *_: asked.append("blended"))
    for angle in (0.3, 0.9):
        pose(angle=angle)
    bpy.context.scene.frame_set(7)
    assert not asked


def test_posing_does_not_read_the_weights_again(masked, monkeypatch):
    read = []
    monkeypatch.setattr("fdda_addon.runtime.player.read_mask", lambda *_: read.append(1))
    for angle in (0.3, 0.9):
        pose(angle=angle)
    for frame in (3, 4):
        bpy.context.scene.frame_set(frame)
    assert not read


def test_a_baked_cache_contains_the_masked_deformation(masked, tmp_path):
    assert bpy.ops.fdda.bake(filepath=str(tmp_path / "a.abc")) == {"FINISHED"}
    frames, shown = (1, 12, 20), []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        shown.append(evaluated_positions(masked).copy())
    masked.fdda.mask = ""
    bpy.context.view_layer.update()
    assert np.abs(shown[-1] - evaluated_positions(masked)).max() > 1e-4
    assert np.abs(read_baked(tmp_path / "a.abc", frames) - shown).max() < 1e-5


def test_an_evaluation_measures_the_masked_deformation(masked):
    bpy.ops.fdda.evaluate()
    errors = last_evaluation.get(masked).errors
    weights = ramp(masked)
    assert (errors["fdda"][:, weights == 0] == errors["linear"][:, weights == 0]).all()
    for frame in (5, 20):
        bpy.context.scene.frame_set(frame)
        shown = evaluated_positions(masked)
        masked.fdda.mode = "RIG"
        bpy.context.view_layer.update()
        apart = np.linalg.norm(shown - evaluated_positions(masked), axis=1)
        masked.fdda.mode = "FDDA"
        bpy.context.view_layer.update()
        pose_index = last_evaluation.get(masked).pose_at(frame)
        assert np.abs(errors["fdda"][pose_index] - apart).max() < 1e-5


def test_picture_shows_the_masked_model(masked, elbow_files, tmp_path, monkeypatch):
    drawn_rows = []
    monkeypatch.setattr(pictures, "draw", lambda mesh, rows, *_, **options: drawn_rows.extend(rows))
    scene_rig = SceneRig(masked, armature_of(masked))
    with model_disabled(masked):
        evaluation = drain(evaluate_action(scene_rig, elbow_files.model, "elbow_wave"))
    posed = pictures.make_pictured_pose(evaluation.held_out, 11)
    pictures.draw_comparison(scene_rig, elbow_files.model, [posed], tmp_path / "heat_map.png", is_heat_map=True)
    ((_, _, model_cell),) = drawn_rows
    errors = np.linalg.norm(model_cell.positions - posed.positions, axis=1)
    np.testing.assert_allclose(errors, evaluation.held_out.fdda[11], atol=1e-6)
    assert (
        np.abs(model_cell.positions - Network(elbow_files.model).positions(posed.pose_matrices[None])[0]).max() > 1e-4
    )


def test_characters_of_a_crowd_have_separate_masks(bound_elbow):
    crowd = crowd_of(bound_elbow, 6)
    animate(crowd)
    paint(crowd[0], ramp(bound_elbow))
    crowd[1].fdda.mask = crowd[2].fdda.mask = GROUP
    crowd[2].fdda.invert_mask = True
    crowd[3].fdda.mask, crowd[3].fdda.strength = GROUP, 0.5
    scene = bpy.context.scene
    for frame in (1, 2, 3, 4):
        scene.frame_set(frame)
    assert session.batches, "they play together"
    shown = [evaluated_positions(mesh_object) for mesh_object in crowd]
    ramps = ramp(bound_elbow)[:, None]
    for mesh_object, positions, weights in zip(crowd, shown, (1, ramps, 1 - ramps, 0.5 * ramps, 1, 1), strict=True):
        mesh_object.fdda.strength = 1
        linear, model = both(mesh_object)
        assert np.abs(positions - (linear + weights * (model - linear))).max() < 1e-6
