# SPDX-License-Identifier: GPL-3.0-or-later
"""Every evaluation shows the model's output: subframes, exports, motion blur, view layers, scenes, other add-ons."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.runtime.depsgraph_changes import seen_mode
from fdda_addon.runtime.session import session

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose, predicted_positions
from ..playback import add_shape_key, handler, rig_pixels, set_camera, shown_in, still

FRAMES = (4, 11, 20)


def export_alembic(path: Path, mode: str) -> None:
    bpy.ops.wm.alembic_export(
        filepath=str(path), start=min(FRAMES), end=max(FRAMES), evaluation_mode=mode, as_background_job=False
    )


def export_usd(path: Path, mode: str) -> None:
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = min(FRAMES), max(FRAMES)
    bpy.ops.wm.usd_export(
        filepath=str(path), export_animation=True, evaluation_mode=mode, export_armatures=False, export_shapekeys=False
    )


def positions_in_file(path: Path) -> dict[int, np.ndarray]:
    """Import an exported file, and return the positions (V, 3) of its mesh by frame."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.suffix == ".abc":
        bpy.ops.wm.alembic_import(filepath=str(path), as_background_job=False)
    else:
        bpy.ops.wm.usd_import(filepath=str(path))
    mesh_object = max((o for o in bpy.data.objects if o.type == "MESH"), key=lambda o: len(o.data.vertices))
    positions = {}
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        positions[frame] = evaluated_positions(mesh_object)
    return positions


@pytest.mark.parametrize("suffix", [".abc", ".usdc"])
@pytest.mark.parametrize("mode", ["VIEWPORT", "RENDER"])
@pytest.mark.parametrize("use_in_render", [False, True])
def test_exports_contain_the_model_or_the_rig(bound_elbow, elbow_files, tmp_path, suffix, mode, use_in_render):
    """Exports for renders contain the rig with its shape keys, unless Use in Render is set."""
    add_shape_key(bound_elbow).fdda.use_in_render = use_in_render
    shows_model = use_in_render or mode == "VIEWPORT"
    expected, other = {}, {}
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        model_positions = assert_plays(bound_elbow, elbow_files.model)
        bound_elbow.fdda.mode = "RIG"
        rig_shape = evaluated_positions(bound_elbow)
        bound_elbow.fdda.mode = "FDDA"
        both = (model_positions, rig_shape) if shows_model else (rig_shape, model_positions)
        expected[frame], other[frame] = both
    path = tmp_path / f"elbow{suffix}"
    {".abc": export_alembic, ".usdc": export_usd}[suffix](path, mode)
    for frame, positions in positions_in_file(path).items():
        assert np.abs(positions - expected[frame]).max() < 1e-5
        assert np.abs(positions - other[frame]).max() > 1e-3


def test_motion_blur_equals_that_of_an_alembic_cache(bound_elbow, elbow_files, tmp_path):
    """Cycles evaluates subframes. The expected image shows the same mesh from an Alembic file."""
    scene = bpy.context.scene
    bound_elbow.fdda.use_in_render = True
    set_camera()
    scene.render.engine, scene.cycles.samples, scene.cycles.seed = "CYCLES", 8, 0
    scene.cycles.use_denoising = False
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
    scene.render.motion_blur_position = "START"
    light = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    light.rotation_euler[0] = 0.9
    scene.collection.objects.link(light)
    scene.frame_set(11)
    model_image = still(tmp_path / "model.png")
    assert not np.array_equal(model_image, rig_pixels(bound_elbow, tmp_path))
    bpy.ops.wm.alembic_export(
        filepath=str(tmp_path / "e.abc"), start=10, end=13, gsamples=2, xsamples=2, as_background_job=False
    )
    bound_elbow.hide_render = True
    bpy.ops.wm.alembic_import(filepath=str(tmp_path / "e.abc"), set_frame_range=False, as_background_job=False)
    scene.frame_set(11)
    cache_image = still(tmp_path / "cache.png")
    assert np.abs(model_image - cache_image).mean() < 2e-3
    scene.render.use_motion_blur = False
    sharp_image = still(tmp_path / "sharp.png")
    assert np.abs(sharp_image - model_image).mean() > 4 * np.abs(model_image - cache_image).mean()


def test_two_scenes_show_the_model_at_different_frames(bound_elbow, elbow_files):
    """The character is linked to a second scene with another current frame."""
    first, second = bpy.context.scene, bpy.data.scenes.new("second")
    for name in (ELBOW, ELBOW_RIG):
        second.collection.objects.link(bpy.data.objects[name])
    first.frame_set(5)
    expected = {first: assert_plays(bound_elbow, elbow_files.model)}
    second.frame_set(20)
    assert np.abs(assert_plays(bound_elbow, elbow_files.model) - expected[first]).max() < 1e-5
    graph = second.view_layers[0].depsgraph
    assert np.abs(shown_in(graph, bound_elbow) - expected[first]).max() > 1e-2
    first.frame_set(20)
    assert np.abs(shown_in(graph, bound_elbow) - assert_plays(bound_elbow, elbow_files.model)).max() < 1e-5


def test_a_handler_of_another_add_on_evaluates_the_model(bound_elbow, elbow_files):
    handler_positions = []

    def evaluate(*_):
        handler_positions.append(evaluated_positions(bound_elbow))

    with handler("frame_change_post", evaluate):
        for frame in FRAMES:
            bpy.context.scene.frame_set(frame)
            assert np.abs(handler_positions[-1] - assert_plays(bound_elbow, elbow_files.model)).max() < 1e-5
    assert len(handler_positions) == len(FRAMES)


def test_python_drivers_of_other_objects_do_not_block_playback(bound_elbow, elbow_files, monkeypatch):
    """The expressions of these drivers take the global interpreter lock on threads that evaluate."""
    monkeypatch.setattr(bpy.context.preferences.filepaths, "use_scripts_auto_execute", True)
    for index in range(20):
        empty = bpy.data.objects.new(f"empty {index}", None)
        bpy.context.scene.collection.objects.link(empty)
        curve = empty.driver_add("location", 0)
        curve.driver.expression = f"len([i for i in range({index} + int(frame))])"
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        assert_plays(bound_elbow, elbow_files.model)
        assert bpy.data.objects["empty 3"].matrix_world.translation.x == 3 + frame


def test_a_bone_driven_by_another_object_is_played(bound_elbow, elbow_files):
    """The location of an animated empty drives the rotation of the bone."""
    armature_object = bpy.data.objects[ELBOW_RIG]
    armature_object.animation_data_clear()
    empty = bpy.data.objects.new("slider", None)
    bpy.context.scene.collection.objects.link(empty)
    for frame, value in ((1, 0.0), (30, 1.5)):
        empty.location.x = value
        empty.keyframe_insert("location", index=0, frame=frame)
    curve = armature_object.pose.bones["lower"].driver_add("rotation_euler", 0)
    curve.driver.type = "SUM"
    variable = curve.driver.variables.new()
    variable.type = "TRANSFORMS"
    variable.targets[0].id = empty
    shown = [assert_plays(bound_elbow, elbow_files.model) for frame in FRAMES if not bpy.context.scene.frame_set(frame)]
    assert np.abs(shown[0] - shown[2]).max() > 1e-2


def test_an_unchanged_character_is_not_evaluated(bound_elbow, monkeypatch):
    from fdda_addon.runtime.player_batch import PlayerBatch

    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    bpy.context.view_layer.update()
    calls, play = [], PlayerBatch.play
    monkeypatch.setattr(PlayerBatch, "play", lambda self, buffer: calls.append(buffer) or play(self, buffer))
    bpy.context.scene.frame_set(7)
    assert calls == []
    pose(angle=0.7)
    assert len(calls) == 1


def test_a_render_of_the_rig_does_not_run_the_model(bound_elbow, tmp_path, monkeypatch):
    from fdda_addon.runtime.network import Execution

    set_camera()
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    bpy.context.view_layer.update()
    calls, run = [], Execution.run
    monkeypatch.setattr(Execution, "run", lambda self: calls.append(self) or run(self))
    still(tmp_path / "still.png")
    assert calls == []


def test_a_character_follows_another_armature(bound_elbow, elbow_files):
    other_armature = bpy.data.objects[ELBOW_RIG].copy()
    other_armature.animation_data_clear()
    bpy.context.scene.collection.objects.link(other_armature)
    other_armature.pose.bones["lower"].rotation_euler[0] = 1.4
    bound_elbow.modifiers["Armature"].object = bound_elbow.parent = other_armature
    bpy.context.view_layer.update()
    first = assert_plays(bound_elbow, elbow_files.model)
    pose(other_armature.name, angle=0.2)
    assert np.abs(assert_plays(bound_elbow, elbow_files.model) - first).max() > 1e-2
    assert np.abs(evaluated_positions(bound_elbow) - predicted_positions(bound_elbow, elbow_files.model)).max() < 1e-5


def test_depsgraphs_are_identified_by_mode_scene_and_view_layer(bound_elbow, tmp_path):
    """A new dependency graph may get the address of a deleted one."""
    add_shape_key(bound_elbow)
    set_camera()
    seen_graphs = []

    def record_graph(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
        seen_graphs.append((depsgraph.mode, seen_mode(bound_elbow.evaluated_get(depsgraph)) == "VIEWPORT"))

    with handler("frame_change_post", record_graph):
        for frame in range(3):
            still(tmp_path / "still.png")
            bpy.context.scene.frame_set(frame)
    assert set(seen_graphs) == {("RENDER", False), ("VIEWPORT", True)}
    (player,) = (character.player for character in session.characters.values())
    uid, name = bpy.context.scene.session_uid, bpy.context.view_layer.name
    assert player.depsgraph_keys == {("RENDER", uid, name), ("VIEWPORT", uid, name)}
