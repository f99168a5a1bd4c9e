# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters with various transforms, parents and units play their model, and millimeters are millimeters."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from blend_fixtures.characters.transforms import (
    CENTIMETRES,
    TRANSFORMS,
    far_from_its_origin,
    in_centimetres,
    in_kilometres,
    in_millimetres,
    scaled_character,
)
from blend_fixtures.elbow import build_elbow
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.skin_fit import SkinFit
from fdda_addon.core.progress import run_job
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.evaluation import heat_map, last_evaluation
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.runtime.binding import bind
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import armature_modifier
from fdda_addon.scene.unit import metres_per_unit

from ..conftest import (
    ELBOW,
    ELBOW_RIG,
    Trained,
    assert_plays,
    build_and_train,
    evaluated_positions,
    predicted_positions,
    run,
    train,
)


@pytest.fixture(scope="module")
def trained_elbow(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Callable[[], object]], Trained]:
    """Return a function that builds, records and trains an elbow; it needs the registered add-on."""

    @cache
    def make(build: Callable[[], object]) -> Trained:
        return build_and_train(tmp_path_factory.mktemp(build.__name__), build, "--poses", 120)

    return make


POSES = ((0.3, -0.2, 0.1), (1.2, 0.5, -0.4), (1.9, 0.1, 0.6))
"""Radians: the bend of the lower bone, two turns of the upper one."""

BEST_PART = 0.3
"""What the model's error may be of linear skinning's, after so short a training."""


@pytest.fixture(params=TRANSFORMS, ids=lambda build: build.__name__)
def character(request, trained_elbow) -> tuple[bpy.types.Object, Path, float]:
    """The mesh object with its model bound, the model, and how many units of the mesh make a meter."""
    files = trained_elbow(request.param)
    bind(files.open(), files.model)
    mesh_object = bpy.data.objects[ELBOW]
    size = CENTIMETRES if max(mesh_object.dimensions) / min(mesh_object.matrix_world.to_scale()) > 10 else 1.0
    return mesh_object, files.model, size


def show(mesh_object: bpy.types.Object, mode: str) -> np.ndarray:
    mesh_object.fdda.mode = mode
    return evaluated_positions(mesh_object)


def assert_equal(mesh_object: bpy.types.Object, model: Path, size: float) -> None:
    assert np.abs(show(mesh_object, "FDDA") - predicted_positions(mesh_object, model)).max() < 1e-5 * size
    assert not mesh_object.fdda.status


def errors(mesh_object: bpy.types.Object) -> np.ndarray:
    """Mean errors of the model and of linear skinning in this pose, units of the mesh."""
    true, playing, linear = (show(mesh_object, mode) for mode in ("RIG", "FDDA", "LINEAR"))
    return np.array([np.linalg.norm(positions - true, axis=1).mean() for positions in (playing, linear)])


def test_frames_of_an_action_and_other_poses(character):
    """The elbow's own action, and that of the empty where there is one."""
    mesh_object, model, size = character
    in_frames, in_poses = [], []
    for frame in (4, 15, 26):
        bpy.context.scene.frame_set(frame)
        assert_equal(mesh_object, model, size)
        in_frames.append(errors(mesh_object))
        linear = show(mesh_object, "LINEAR")
        mesh_object.fdda.mode = "RIG"
        mesh_object.modifiers["CorrectiveSmooth"].show_viewport = False
        largest = np.abs(evaluated_positions(mesh_object) - linear).max()
        mesh_object.modifiers["CorrectiveSmooth"].show_viewport = True
        # Blender itself computes in single precision here.
        assert largest < 1e-5 * size + 1e-6 * np.abs(mesh_object.matrix_world.translation).max()
    armature_object = bpy.data.objects[ELBOW_RIG]
    armature_object.animation_data_clear()
    for bend, turn, twist in POSES:
        armature_object.pose.bones["lower"].rotation_euler[0] = bend
        armature_object.pose.bones["upper"].rotation_euler = (turn, twist, 0.0)
        bpy.context.view_layer.update()
        assert_equal(mesh_object, model, size)
        in_poses.append(errors(mesh_object))
    for found in (in_frames, in_poses):
        model_error, linear_error = np.mean(found, axis=0)
        assert model_error < BEST_PART * linear_error


def test_a_character_survives_an_animated_scale_of_zero(bound_elbow, elbow_files, capsys):
    """At scale 0 the character is invisible. Other characters play on, and it plays again afterwards."""
    armature_object = bpy.data.objects[ELBOW_RIG]
    hider = bpy.data.objects.new("hider", None)
    bpy.context.scene.collection.objects.link(hider)
    other_rig, other = armature_object.copy(), bound_elbow.copy()
    for copy in (other_rig, other):
        bpy.context.scene.collection.objects.link(copy)
    other.parent = armature_modifier(other).object = other_rig
    armature_object.parent = hider
    for frame, scale in ((4, (1, 1, 1)), (5, (0, 0, 0)), (10, (0, 0, 0)), (11, (0.5, 0.5, 0.5)), (20, (0, 1, 1))):
        hider.scale = scale
        hider.keyframe_insert("scale", frame=frame)
    for frame in (3, 7, 11, 20, 4):
        bpy.context.scene.frame_set(frame)
        assert_plays(other, elbow_files.model)
        assert (bound_elbow.fdda.mode, bound_elbow.fdda.status) == ("FDDA", "")
        if frame not in (7, 20):
            assert_plays(bound_elbow, elbow_files.model)
    assert "Traceback" not in "".join(capsys.readouterr())


def test_a_scale_of_zero_is_not_recorded(rig, capsys, tmp_path):
    rig.armature_object.keyframe_insert("scale", frame=1)
    rig.armature_object.scale = (1, 0, 1)
    rig.armature_object.keyframe_insert("scale", frame=5)
    action = rig.armature_object.animation_data.action.name
    bpy.context.scene.frame_set(1)
    save_copy(tmp_path / "flat.blend")
    assert run("record", tmp_path / "flat.blend", tmp_path / "flat", "--poses", 0, "--action", action) == 1
    assert (
        "has a scale of zero in some pose; look for the key, constraint or driver that sets it."
        in capsys.readouterr().err
    )


METRES_PER_UNIT: dict[Callable[[], object], float] = {
    in_centimetres: 0.01,
    scaled_character: 0.01,
    in_millimetres: 0.001,
    in_kilometres: 1000.0,
    far_from_its_origin: 1.0,
}
"""The elbows that are compared with that of `build_elbow`, which is in meters."""

others = pytest.mark.parametrize("build", METRES_PER_UNIT, ids=lambda build: build.__name__)

STEP = 0.01
"""Millimeters; what rounding makes 100 meters from the origin."""

AGREE = 0.2
"""Relative difference of figures: rounding differs with the unit, and a training makes more of it."""


@pytest.fixture(scope="module")
def evaluations(trained_elbow, tmp_path_factory: pytest.TempPathFactory) -> dict[Callable[[], object], dict]:
    """What `evaluate` reports of each elbow."""
    path, made = tmp_path_factory.mktemp("units") / "errors.json", {}
    fdda_addon.register()
    try:
        for build in (build_elbow, *METRES_PER_UNIT):
            files = trained_elbow(build)
            assert run("evaluate", files.rig, files.model, "--json", path, "--poses", 100, "--overwrite") == 0
            made[build] = json.loads(path.read_text())
    finally:
        fdda_addon.unregister()
    return made


def assert_agree(own: dict, meters: dict) -> None:
    """Statistics of two evaluations or reports agree."""
    for way in ("fdda", "linear"):
        for name, value in meters[way].items():
            assert own[way][name] == pytest.approx(value, rel=AGREE, abs=STEP)


@pytest.mark.one_blender_version
@others
def test_evaluations_agree(evaluations, build):
    own, meters = evaluations[build], evaluations[build_elbow]
    assert 0.5 < meters["linear"]["mean"] < 10, "the elbow is half a meter long"
    assert_agree(own, meters)
    for partition, expected in zip(own["partitions"], meters["partitions"], strict=True):
        assert_agree(partition, expected)
    # Of the same poses: nothing but rounding is between them.
    step = STEP if build is far_from_its_origin else 0
    assert own["linear"]["mean"] == pytest.approx(meters["linear"]["mean"], rel=1e-3, abs=step)


@pytest.mark.one_blender_version
@others
def test_files_say_their_unit_and_hold_units(trained_elbow, build):
    files, meter_files = trained_elbow(build), trained_elbow(build_elbow)
    own, meters = (read_recording(each.recording) for each in (files, meter_files))
    unit = METRES_PER_UNIT[build]
    assert own.rig.metres_per_unit == read_model_info(files.model).metres_per_unit
    assert own.rig.metres_per_unit == pytest.approx(unit, rel=1e-6)
    assert "metres_per_unit" not in (meter_files.recording / "recording.json").read_text()
    assert b"metres_per_unit" not in meter_files.model.read_bytes()
    if build is not far_from_its_origin:
        np.testing.assert_allclose(unit * own.rig.rest_positions, meters.rig.rest_positions, rtol=1e-5, atol=1e-7)
    own_moves, moves = (each.positions - each.rig.rest_positions for each in (own, meters))
    np.testing.assert_allclose(unit * own_moves, moves, atol=1e-4)


@pytest.mark.one_blender_version
def test_the_gain_of_fitted_weights_is_in_millimetres(trained_elbow, tmp_path):
    fits = []
    for build in (build_elbow, in_centimetres):
        model = tmp_path / f"{build.__name__}.onnx"
        train(trained_elbow(build).recording, model, "--passes", 1, "--base-skinning", "hard")
        fits.append(SkinFit.from_json(read_model_info(model).training["fit"]))
    for way, rms in fits[0].held_out.rms_mm.items():
        assert fits[1].held_out.rms_mm[way] == pytest.approx(rms, rel=AGREE)
        assert fits[1].held_out.max_mm[way] == pytest.approx(fits[0].held_out.max_mm[way], rel=AGREE)


@pytest.mark.one_blender_version
@others
def test_the_heat_map_shows_millimetres(trained_elbow, build):
    files = trained_elbow(build)
    rig = files.open()
    evaluation = run_job(evaluate(rig, files.model, EvaluationSettings(poses=4, surface=False)))
    last = last_evaluation.store(rig.mesh_object, evaluation, files.model.name)
    assert last.worst_poses(1)[0][1] == pytest.approx(last.total["fdda"].max, rel=1e-5)
    assert 0.05 < last.total["fdda"].max < 50
    heat_map.paint_errors(rig.mesh_object)
    bpy.context.window_manager.fdda_view.statistic = "max"
    assert 0 < heat_map.suggested_range_mm(rig.mesh_object) <= last.total["fdda"].max * 1.1


@pytest.mark.parametrize(
    ("system", "unit_scale", "scale", "meters"),
    [
        ("METRIC", 1.0, (1.0, 1.0, 1.0), 1.0),
        ("METRIC", 0.01, (1.0, 1.0, 1.0), 0.01),
        ("IMPERIAL", 0.0254, (1.0, 1.0, 1.0), 0.0254),
        ("NONE", 0.01, (1.0, 1.0, 1.0), 1.0),
        ("METRIC", 1.0, (0.01, 0.01, 0.01), 0.01),
        ("METRIC", 1.0, (-0.01, 0.01, 0.01), 0.01),
        ("METRIC", 0.01, (100.0, 100.0, 100.0), 1.0),
        ("METRIC", 1.0, (2.0, 4.0, 8.0), 4.0),
    ],
)
def test_the_unit_is_that_of_scene_and_object(system, unit_scale, scale, meters):
    build_elbow()
    settings, mesh_object = bpy.context.scene.unit_settings, bpy.data.objects[ELBOW]
    settings.system, settings.scale_length = system, unit_scale
    # Of its parent's too, and however it is turned.
    mesh_object.parent.scale, mesh_object.parent.rotation_euler = scale, (1.0, 0.5, -2.0)
    bpy.context.view_layer.update()
    assert metres_per_unit(mesh_object) == meters


@pytest.mark.one_blender_version
def test_a_copy_that_is_scaled_up_has_the_figures_of_its_model(evaluations, trained_elbow):
    files = trained_elbow(build_elbow)
    rig = files.open()
    rig.armature_object.scale = (3.0, 3.0, 3.0)
    bpy.context.view_layer.update()
    assert metres_per_unit(rig.mesh_object) == 3.0
    evaluation = run_job(evaluate(rig, files.model, EvaluationSettings(poses=100, surface=False)))
    assert evaluation.fdda.mean == pytest.approx(evaluations[build_elbow]["fdda"]["mean"], rel=1e-3)
