# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface frames are selected only for rigs that smooth, with their smoothing; the graph computes the same values."""

import shutil
from dataclasses import replace

import numpy as np
import onnx
import pytest

from fdda_addon.core.formats.report import checkpoint_path
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import SkinnedRecording, skin_recording
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data.split import split_recording
from trainer.inputs import surface_frame_fit
from trainer.inputs.network_inputs import make_inputs
from trainer.inputs.smoothed_surface import NO_SURFACE_FRAMES, SurfaceFrames
from trainer.inputs.surface_frame_fit import MIN_EXPLAINED_VARIANCE, select_surface_frames
from trainer.inputs.surface_frames import SurfaceFrameFeatures
from trainer.networks.checkpoint import read_checkpoint

from ..recordings import read_skinned
from .chain import constant_names, rotation, write_chain
from .conftest import QUICK_OPTIONS
from .tube import INFLUENCING, JOINTS, POSES, smoothed, write_tube


def select_frames(recording: SkinnedRecording) -> SurfaceFrames:
    return select_surface_frames(recording, split_recording(recording, TrainingConfig()), detail_mm=0.04)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> SkinnedRecording:
    return write_tube(tmp_path_factory.mktemp("tubes") / "tube")


@pytest.fixture(scope="module")
def surface_frames(recording) -> SurfaceFrameFeatures:
    return SurfaceFrameFeatures(**vars(select_frames(skin_recording(read_recording(recording.path)))))


def test_a_rig_that_smooths_has_surface_frames_in_every_partition(recording, surface_frames):
    assert set(surface_frames.main_joints.tolist()) == set(range(JOINTS))
    assert np.array_equal(np.unique(surface_frames.vertices), surface_frames.vertices)
    for partition in recording.partitions:
        vertices = surface_frames.vertices[surface_frames.main_joints == partition.joint]
        assert np.isin(vertices, partition.vertices).all()


def test_tangents_and_normals_are_those_of_the_smoothed_surface(recording, surface_frames):
    rig, matrices = recording.rig, np.array(recording.pose_matrices[:5])
    for pose, skinned in enumerate(LinearSkinning(rig).positions(matrices).astype(np.float64)):
        faces = smoothed(rig, skinned)[rig.face_vertices.reshape(-1, 4)]
        predecessor_edges, successor_edges = (
            (np.roll(faces, shift, axis=1) - faces).reshape(-1, 3) for shift in (1, -1)
        )
        vectors = np.stack(
            [
                predecessor_edges + successor_edges,
                successor_edges - predecessor_edges,
                np.cross(predecessor_edges, successor_edges),
            ]
        )
        vectors /= np.linalg.norm(vectors, axis=2, keepdims=True)
        for frame, vertex in enumerate(surface_frames.vertices):
            expected = vectors[:, rig.face_vertices == vertex]
            vectors_of_frame = surface_frames.compute_corner_vectors(matrices[pose, None])[
                0, :, frame, : expected.shape[1]
            ]
            # Epsilons and the fitted number of iterations change the vectors by less than this.
            assert np.abs(vectors_of_frame - expected).max() < 1e-3


def test_surface_frames_explain_residuals_that_joints_do_not_explain(recording, surface_frames):
    """The errors are measured on held-out poses, with linear functions of the joints as further regressors."""
    split = split_recording(recording, TrainingConfig())
    features = surface_frames.evaluate(recording.pose_matrices).reshape(POSES, -1, 3)
    joint_regressors = np.linalg.inv(recording.pose_matrices[:, 1, None]) @ recording.pose_matrices
    joint_regressors = np.append(joint_regressors[:, :, :3].reshape(POSES, -1), np.ones((POSES, 1)), axis=1)
    for frame in np.flatnonzero(surface_frames.main_joints == 1):
        targets = recording.residuals[:, surface_frames.vertices[frame]]
        errors = []
        for inputs in (joint_regressors, np.append(joint_regressors, features[:, frame], axis=1)):
            factors = np.linalg.lstsq(inputs[split.training], targets[split.training], rcond=1e-6)[0]
            errors.append(((inputs[split.held_out] @ factors - targets[split.held_out]) ** 2).sum())
        assert errors[1] < (1 - MIN_EXPLAINED_VARIANCE) * errors[0]


@pytest.mark.parametrize("units_per_metre, origin_distance", [(1000.0, 0.0), (1.0, 100.0), (1000.0, 100.0)])
def test_selection_does_not_depend_on_unit_and_position(
    tmp_path, recording, surface_frames, units_per_metre, origin_distance
):
    moved_recording = write_tube(tmp_path / "tube", units_per_metre, origin_distance)
    selected = select_frames(moved_recording)
    assert selected.vertices.tolist() == surface_frames.vertices.tolist()
    features, reference_features = (
        SurfaceFrameFeatures(**vars(selected)).evaluate(moved_recording.pose_matrices) / units_per_metre,
        surface_frames.evaluate(recording.pose_matrices),
    )
    # At 100 m from the origin, positions have steps of 0.008 mm.
    assert (
        np.abs(features - reference_features).max()
        < (0.02 if origin_distance else 1e-4) * np.abs(reference_features).max()
    )


def test_scale_and_rotation_of_the_character_do_not_change_surface_frames(recording, surface_frames):
    matrices = recording.pose_matrices[:20].astype(np.float64)
    character_transform = rotation(0, 0.7) @ rotation(2, -1.9) @ np.diag([2.5, 2.5, 2.5, 1])
    character_transform[:3, 3] = 3, -2, 1
    features = surface_frames.evaluate(matrices)
    # The result differs slightly, because epsilons damp nearly degenerate corners relative to their size at rest.
    assert (
        np.abs(surface_frames.evaluate(character_transform @ matrices) - features).max() < 1e-3 * np.abs(features).max()
    )


def test_no_surface_frames_are_selected_where_they_explain_little(tmp_path, recording):
    waves = write_tube(tmp_path / "waves", smooths=False)
    write_chain(tmp_path / "chain")
    residuals, smooth, no_faces = np.array(waves.residuals), recording.partitions[0].vertices, np.zeros(0, np.int32)
    residuals[:, smooth] = recording.residuals[:, smooth]
    for reason, other in {
        "the rig does not smooth": waves,
        "bulges that grow with the bend correlate with the rotation of the adjacent surface": read_skinned(
            tmp_path / "chain"
        ),
        "for one partition, they would take as much time as for all": replace(recording, residuals=residuals),
        "a dozen poses are too few": write_tube(tmp_path / "few", pose_count=12),
        "there are no faces": replace(
            recording, rig=replace(recording.rig, face_starts=no_faces, face_vertices=no_faces)
        ),
    }.items():
        assert select_frames(other) is NO_SURFACE_FRAMES, reason
    split = split_recording(recording, TrainingConfig())
    assert select_surface_frames(recording, split, detail_mm=100.0) is NO_SURFACE_FRAMES, "within the tolerance"


def test_a_vertex_whose_fit_is_nan_selects_nothing(recording, monkeypatch):
    fit_lengths = surface_frame_fit._fit_lengths

    def fit_with_nan(*arguments) -> tuple[np.ndarray, np.ndarray]:
        lengths, explained = fit_lengths(*arguments)
        explained[0] = np.nan
        return lengths, explained

    monkeypatch.setattr(surface_frame_fit, "_fit_lengths", fit_with_nan)
    assert select_frames(recording) is NO_SURFACE_FRAMES


def test_vertices_without_faces_are_ignored(recording, surface_frames):
    rig, added_count = recording.rig, 4 * recording.rig.vertex_count
    extended_arrays = {
        name: np.concatenate([getattr(rig, name), np.repeat(getattr(rig, name)[-1:], added_count, axis=0)])
        for name in ("rest_positions", "skin_joints", "skin_weights")
    }
    rig = replace(rig, **extended_arrays)
    residuals = np.concatenate([recording.residuals, np.ones((POSES, added_count, 3), np.float32)], axis=1)
    selected = select_frames(
        replace(recording, rig=rig, residuals=residuals, partitions=make_partitions(rig, INFLUENCING))
    )
    assert selected.vertices.tolist() == surface_frames.vertices.tolist()


def test_a_degenerate_surface_gives_finite_values(recording, surface_frames):
    zero_matrices = np.zeros((2, JOINTS, 4, 4), np.float32)
    zero_matrices[:, :, 3, 3] = 1
    assert (surface_frames.evaluate(zero_matrices) == 0).all()


@pytest.fixture(scope="module")
def model_path(recording, tmp_path_factory):
    model = tmp_path_factory.mktemp("models") / "tube.onnx"
    assert main([str(recording.path), str(model), *QUICK_OPTIONS]) == 0
    return model


def test_the_model_has_surface_frames(model_path):
    """The training checks that the graph agrees with PyTorch."""
    graph = onnx.load(model_path).graph
    names = {node.name for node in graph.node} - constant_names(graph)
    assert "surface_frame_features" in names
    assert len(names) <= 69 + 23 + JOINTS


@pytest.mark.parametrize(
    "tube_options",
    [{"units_per_metre": 1000.0, "origin_distance": 100.0}, {"sheared": True}],
    ids=["far away", "sheared"],
)
def test_the_graph_agrees_with_pytorch_in_other_rigs(tmp_path, tube_options):
    write_tube(tmp_path / "tube", **tube_options)
    assert main([str(tmp_path / "tube"), str(tmp_path / "tube.onnx"), *QUICK_OPTIONS, "--passes", "4"]) == 0
    assert "surface_frame_features" in {node.name for node in onnx.load(tmp_path / "tube.onnx").graph.node}


def test_a_warm_start_keeps_the_surface_frames(recording, surface_frames, model_path, tmp_path, capsys):
    for file in (model_path, checkpoint_path(model_path)):
        shutil.copy(file, tmp_path)
    states = read_checkpoint(checkpoint_path(model_path)).input_states
    for name, array in vars(surface_frames).items():
        assert np.array_equal(states["surface_frames"][name], array), name
    offered_columns = make_inputs(recording.rig, recording.partitions, states).columns
    assert [len(columns) % 3 for columns in offered_columns] == [0] * JOINTS
    assert main([str(recording.path), str(tmp_path / model_path.name), *QUICK_OPTIONS, "--warm-start"]) == 0
    assert (
        f"The rig smooths: networks take surface frames of {len(surface_frames)} vertices as inputs."
        in capsys.readouterr().out
    )


DAMAGED_ARRAYS = {
    "corners without a second tangent": ("tangents", lambda array: array[:1]),
    "a joint that does not exist": ("main_joints", lambda array: array + 10_000),
    "a negative vertex index": ("vertices", lambda array: array - 10_000),
    "lengths that are not numbers": ("lengths", lambda array: array * np.nan),
    "epsilons of zero": ("epsilons", lambda array: 0 * array),
    "tangents of other joints": ("tangents", lambda array: array[..., :4]),
    "too few vertices": ("vertices", lambda array: array[:1]),
    "float32 in place of float64": ("lengths", lambda array: array.astype(np.float32)),
}


@pytest.mark.parametrize("damage_name", DAMAGED_ARRAYS)
def test_damaged_surface_frames_are_refused(recording, model_path, tmp_path, capsys, damage_name):
    name, change = DAMAGED_ARRAYS[damage_name]
    with np.load(checkpoint_path(model_path)) as arrays:
        changed_arrays = {**arrays, f"inputs/surface_frames/{name}": change(arrays[f"inputs/surface_frames/{name}"])}
    model = tmp_path / "tube.onnx"
    with open(checkpoint_path(model), "wb") as file:
        np.savez(file, **changed_arrays)
    model.write_bytes(model_path.read_bytes())
    assert main([str(recording.path), str(model), *QUICK_OPTIONS, "--warm-start"]) == 1
    assert "train without --warm-start" in capsys.readouterr().err
