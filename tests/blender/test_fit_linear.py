# SPDX-License-Identifier: GPL-3.0-or-later
"""Models with fitted skin weights: training, playback, the sidebar, and errors."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters.base import cage, skin, tube
from blend_fixtures.elbow import build_elbow, lower_weights
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.skin_fit import SkinFit
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.rig import Rig
from fdda_addon.evaluation import heat_map
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.recording.run import MISSING_WEIGHTS
from fdda_addon.rig.reading import PoseReader, read_rig
from fdda_addon.runtime.binding import bind
from fdda_addon.runtime.network import Network
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from .conftest import ELBOW, assert_plays, evaluated_positions, pose, run, train
from .scene_state import drain
from .stand_ins import import_from


def build_rigid_elbow() -> None:
    """Build an elbow with one bone per vertex, smoothed by Corrective Smooth (delta mush)."""
    mesh_object, _ = build_elbow()
    lower = lower_weights(np.array([vertex.co for vertex in mesh_object.data.vertices])) >= 0.5
    for name, is_member in (("upper", ~lower), ("lower", lower)):
        mesh_object.vertex_groups[name].remove(range(len(is_member)))
        mesh_object.vertex_groups[name].add(np.flatnonzero(is_member).tolist(), 1.0, "REPLACE")


def build_cloth() -> SceneRig:
    """Build a mesh without weights that a Surface Deform modifier attaches to a skinned body."""
    mesh_object, armature_object = tube()
    mesh_object.modifiers.clear()
    mesh_object.vertex_groups.clear()
    body = cage("body", 1.1)
    skin(body, armature_object)
    modifier = mesh_object.modifiers.new("SurfaceDeform", "SURFACE_DEFORM")
    modifier.target = body
    bpy.context.view_layer.update()
    with bpy.context.temp_override(object=mesh_object, active_object=mesh_object):
        bpy.ops.object.surfacedeform_bind(modifier=modifier.name)
    return SceneRig(mesh_object, armature_object)


@dataclasses.dataclass(frozen=True)
class FittedCharacter:
    """Paths of a character with fitted linear skinning."""

    rig: Path
    recording: Path
    model: Path

    def open(self) -> SceneRig:
        bpy.ops.wm.open_mainfile(filepath=str(self.rig))
        return find_rig(ELBOW)


@pytest.fixture(scope="module")
def make_fitted_character(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable], FittedCharacter]:
    """Return a function that records a character and trains a model with fitted weights, once for each kind."""
    characters: dict[str, FittedCharacter] = {}

    def make(kind: str, build: Callable[[], object]) -> FittedCharacter:
        if kind not in characters:
            folder = tmp_path_factory.mktemp("fitted")
            files = [folder / name for name in ("rig.blend", "recording", "model.onnx")]
            bpy.ops.wm.read_factory_settings(use_empty=True)
            build()
            save_copy(files[0])
            assert run("record", *files[:2], "--object", ELBOW, "--poses", 120) == 0
            train(*files[1:], "--passes", 25, "--base-skinning", kind)
            characters[kind] = FittedCharacter(*files)
        return characters[kind]

    return make


KINDS_AND_BUILDERS = [("hard", build_cloth), ("smooth", build_rigid_elbow)]


def pose_matrices(rig: SceneRig, recorded: Rig) -> np.ndarray:
    """Return the evaluated pose matrices (J, 4, 4) of the joints of a recording."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    reader = PoseReader(rig, recorded.joint_names, recorded.rest_matrices)
    return reader.read(*(o.evaluated_get(depsgraph) for o in (rig.mesh_object, rig.armature_object)))


@pytest.mark.parametrize(("kind", "build"), KINDS_AND_BUILDERS)
def test_fitted_weights_reduce_errors_and_are_in_the_model(kind, build, make_fitted_character):
    files = make_fitted_character(kind, build)
    recording, info = read_recording(files.recording), read_model_info(files.model)
    fit = SkinFit.from_json(info.training["fit"])
    assert fit.sentence() == info.skin_sentence and (fit.kind, fit.poses) == (kind, 120)
    for gain in (fit.held_out, fit.training):
        assert gain.rms_mm["fitted"] < 0.8 * gain.rms_mm["rig"]

    rig = files.open()
    rig_data = read_rig(rig)
    # The fingerprint describes the rig, and does not include fitted weights.
    assert recording.rig.meshes[0].fingerprint == rig_data.meshes[0].fingerprint == info.meshes[0].fingerprint
    assert [rig_data.joint_names[p.joint] for p in info.partitions] == ["upper", "lower"]
    linear_rig = Network(files.model).linear_rig(rig_data)
    assert (linear_rig.skin_weights > 0).sum(axis=1).max() == (1 if kind == "hard" else 2)
    assert (rig_data.skin_weights > 0).sum(axis=1).max() == 1

    evaluation = drain(evaluate(rig, files.model, EvaluationSettings(30)))
    assert evaluation.fdda.rms < 0.5 * evaluation.linear.rms
    # The evaluation uses other poses than the fit.
    assert evaluation.linear.rms == pytest.approx(fit.held_out.rms_mm["fitted"], rel=0.3)
    assert [p.joint for p in evaluation.partitions] == [p.joint for p in info.partitions]
    assert [len(p.vertices) for p in evaluation.partitions] == [p.vertices for p in info.partitions]


@pytest.mark.parametrize(("kind", "build"), KINDS_AND_BUILDERS)
def test_playback_uses_the_fitted_weights(kind, build, make_fitted_character):
    files = make_fitted_character(kind, build)
    rig = files.open()
    pose(angle=1.2)
    rig_shape = evaluated_positions(rig.mesh_object)
    bind(rig, files.model)
    model_positions = assert_plays(rig.mesh_object, files.model)
    heat_map.paint_partitions(rig)
    assert len(np.unique(heat_map.colors_of(rig.mesh_object), axis=0)) == 2
    rig.mesh_object.fdda.mode = "LINEAR"
    linear_positions = evaluated_positions(rig.mesh_object)
    linear_rig = Network(files.model).linear_rig(read_recording(files.recording).rig)
    matrices = pose_matrices(rig, linear_rig)
    np.testing.assert_allclose(linear_positions, LinearSkinning(linear_rig).positions(matrices[None])[0], atol=1e-5)
    errors = [np.linalg.norm(positions - rig_shape, axis=1).mean() for positions in (model_positions, linear_positions)]
    assert errors[0] < errors[1] < 0.01


def test_a_mesh_without_weights_is_recorded_and_needs_fitted_ones(refusal, tmp_path, capfd):
    rig = build_cloth()
    save_copy(tmp_path / "cloth.blend")
    rig.mesh_object.modifiers.new("Armature", "ARMATURE").object = rig.armature_object
    save_copy(tmp_path / "without_weights.blend")
    for name in ("cloth", "without_weights"):
        assert run("record", tmp_path / f"{name}.blend", tmp_path / name, "--object", ELBOW, "--poses", 12) == 0
        assert MISSING_WEIGHTS.format(ELBOW) in capfd.readouterr().out
        text = refusal("train", tmp_path / name, tmp_path / "m.onnx")
        assert text.startswith("The vertices of 'elbow' follow no bone by skin weights") and "--base-skinning" in text
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "cloth.blend"))
    settings = bpy.data.objects[ELBOW].fdda.settings
    settings.recording = str(tmp_path / "other")
    with pytest.raises(RuntimeError, match="have no weights on deforming bones of 'elbow_rig', so there is no linear"):
        bpy.ops.fdda.build_model(object=ELBOW)
    assert not (tmp_path / "other").exists()


def test_the_times_of_a_mesh_without_armature_modifier_lack_linear_skinning(make_fitted_character, capfd, tmp_path):
    files = make_fitted_character(*KINDS_AND_BUILDERS[0])
    times = tmp_path / "times.json"
    assert run("benchmark", files.rig, files.model, "--object", ELBOW, "--json", times, "--frames", 2) == 0
    assert "linear" not in json.loads(times.read_text())
    printed = capfd.readouterr().out
    assert "Armature modifier alone" not in printed and "FDDA" in printed


def test_a_python_without_scipy_is_named(refusal, elbow_files, tmp_path, monkeypatch):
    packages = tmp_path / "packages"
    packages.mkdir()
    (packages / "sitecustomize.py").write_text("import sys\nsys.modules['scipy'] = None\n")
    import_from(packages, monkeypatch)
    text = refusal("train", elbow_files.recording, tmp_path / "m.onnx", "--base-skinning", "smooth")
    assert "'scipy'" in text
