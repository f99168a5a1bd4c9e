# SPDX-License-Identifier: GPL-3.0-or-later
"""Millimeters are millimeters: whatever unit the elbow is built in, and wherever it lies, it gives the same figures."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from blend_fixtures.characters.transforms import (
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
from fdda_addon.scene.scene_rig import find_rig
from fdda_addon.scene.unit import metres_per_unit

from ..conftest import ELBOW, run, train

pytestmark = pytest.mark.one_blender_version

IN_METRES, IN_CENTIMETRES, FROM_FBX = "meters", "centimeters", "FBX"
IN_MILLIMETRES, IN_KILOMETRES, FAR_AWAY = "millimeters", "kilometers", "100 meters from its origin"
BUILDERS: dict[str, Callable[[], object]] = {
    IN_METRES: build_elbow,
    IN_CENTIMETRES: in_centimetres,
    FROM_FBX: scaled_character,
    IN_MILLIMETRES: in_millimetres,
    IN_KILOMETRES: in_kilometres,
    FAR_AWAY: far_from_its_origin,
}
OTHERS = (IN_CENTIMETRES, FROM_FBX, IN_MILLIMETRES, IN_KILOMETRES, FAR_AWAY)
METRES_PER_UNIT = {IN_CENTIMETRES: 0.01, FROM_FBX: 0.01, IN_MILLIMETRES: 0.001, IN_KILOMETRES: 1000.0, FAR_AWAY: 1.0}
STEP = 0.01
"""Millimeters; what rounding makes 100 meters from the origin."""
AGREE = 0.2
"""Relative difference of figures: rounding differs with the unit, and a training makes more of it."""


@dataclass(frozen=True)
class Character:
    """One of the elbows: its files, and what `evaluate` reports of it."""

    rig: Path
    recording: Path
    model: Path
    evaluation: dict


@pytest.fixture(scope="module")
def characters(trained_elbow, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Character]:
    folder, made = tmp_path_factory.mktemp("units"), {}
    fdda_addon.register()
    try:
        for name, build in BUILDERS.items():
            files, evaluation = trained_elbow(build), folder / f"{name}.json"
            assert run("evaluate", files.rig, files.model, "--json", evaluation, "--poses", 100) == 0
            made[name] = Character(*files, json.loads(evaluation.read_text()))
    finally:
        fdda_addon.unregister()
    return made


def assert_agree(own: dict, meters: dict) -> None:
    """Statistics of two evaluations or reports agree."""
    for way in ("fdda", "linear"):
        for name, value in meters[way].items():
            assert own[way][name] == pytest.approx(value, rel=AGREE, abs=STEP)


def test_linear_skinning_of_the_elbow_is_off_by_millimetres(characters):
    """The elbow is half a meter long."""
    assert 0.5 < characters[IN_METRES].evaluation["linear"]["mean"] < 10


@pytest.mark.parametrize("name", OTHERS)
def test_evaluations_agree(characters, name):
    own, meters = characters[name].evaluation, characters[IN_METRES].evaluation
    assert_agree(own, meters)
    for partition, expected in zip(own["partitions"], meters["partitions"], strict=True):
        assert_agree(partition, expected)
    # Of the same poses: nothing but rounding is between them.
    step = STEP if name == FAR_AWAY else 0
    assert own["linear"]["mean"] == pytest.approx(meters["linear"]["mean"], rel=1e-3, abs=step)


@pytest.mark.parametrize("name", OTHERS)
def test_files_say_their_unit_and_hold_units(characters, name):
    own, meters = (read_recording(characters[n].recording) for n in (name, IN_METRES))
    unit = METRES_PER_UNIT[name]
    assert own.rig.metres_per_unit == read_model_info(characters[name].model).metres_per_unit
    assert own.rig.metres_per_unit == pytest.approx(unit, rel=1e-6)
    if name != FAR_AWAY:
        np.testing.assert_allclose(unit * own.rig.rest_positions, meters.rig.rest_positions, rtol=1e-5, atol=1e-7)
    own_moves, moves = (each.positions - each.rig.rest_positions for each in (own, meters))
    np.testing.assert_allclose(unit * own_moves, moves, atol=1e-4)


def test_files_of_a_character_in_metres_say_nothing(characters):
    character = characters[IN_METRES]
    assert "metres_per_unit" not in (character.recording / "recording.json").read_text()
    assert b"metres_per_unit" not in character.model.read_bytes()


def test_the_gain_of_fitted_weights_is_in_millimetres(characters, tmp_path):
    models = [tmp_path / f"{name}.onnx" for name in (IN_METRES, IN_CENTIMETRES)]
    for name, model in zip((IN_METRES, IN_CENTIMETRES), models, strict=True):
        train(characters[name].recording, model, "--passes", 1, "--base-skinning", "hard")
    fits = [SkinFit.from_json(read_model_info(model).training["fit"]) for model in models]
    for way, rms in fits[0].held_out.rms_mm.items():
        assert fits[1].held_out.rms_mm[way] == pytest.approx(rms, rel=AGREE)
        assert fits[1].held_out.max_mm[way] == pytest.approx(fits[0].held_out.max_mm[way], rel=AGREE)


@pytest.mark.parametrize("name", BUILDERS)
def test_the_heat_map_shows_millimetres(characters, name):
    character = characters[name]
    bpy.ops.wm.open_mainfile(filepath=str(character.rig))
    rig = find_rig()
    evaluation = run_job(evaluate(rig, character.model, EvaluationSettings(poses=4, surface=False)))
    last = last_evaluation.store(rig.mesh_object, evaluation, character.model.name)
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


def test_a_copy_that_is_scaled_up_has_the_figures_of_its_model(characters):
    character = characters[IN_METRES]
    bpy.ops.wm.open_mainfile(filepath=str(character.rig))
    rig = find_rig()
    rig.armature_object.scale = (3.0, 3.0, 3.0)
    bpy.context.view_layer.update()
    assert metres_per_unit(rig.mesh_object) == 3.0
    evaluation = run_job(evaluate(rig, character.model, EvaluationSettings(poses=100, surface=False)))
    assert evaluation.fdda.mean == pytest.approx(character.evaluation["fdda"]["mean"], rel=1e-3)
