# SPDX-License-Identifier: GPL-3.0-or-later
"""Partition refinement makes the model smaller; model, checkpoint and report have the refined partitions."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.model import read_model_info
from fdda_addon.core.partition import Partition, make_partitions
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.report import checkpoint_path
from fdda_addon.core.skinning import LinearSkinning
from trainer import train
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data.residuals import residuals_of
from trainer.data.split import split_recording
from trainer.fits import partition_refinement
from trainer.fits.partition_refinement import partition_indices, reassign_vertices, refine_partitions
from trainer.networks.checkpoint import read_checkpoint
from trainer.process import Cancelled

from .chain import chain_angles, chain_info, pose_chain
from .conftest import QUICK_OPTIONS
from .tube import INFLUENCING, JOINTS, RING_COUNT, VERTICES_PER_RING, tube, write_tube

POSES, WAVES = 200, 4
ODD_RINGS = np.arange(RING_COUNT // JOINTS, RING_COUNT // JOINTS + 3)
"""Rings of vertices with weights on the middle joint, whose residuals depend on the first joint."""


def write_odd_recording(path: Path, units_per_metre: float = 1.0, origin_distance: float = 0.0) -> Recording:
    """Write a recording of a tube in which the first joint also deforms vertices without a weight on it."""
    plain_rig, rig, angles = (
        tube(),
        tube(units_per_metre, origin_distance),
        chain_angles(POSES, JOINTS, seed=3, range_scale=1.5),
    )
    matrices, skinning = pose_chain(plain_rig, angles), LinearSkinning(plain_rig)
    ring = np.arange(plain_rig.vertex_count) // VERTICES_PER_RING
    driving_joints = np.where(np.isin(ring, ODD_RINGS), 0, plain_rig.skin_joints[:, 0])
    waves = np.random.default_rng(2).normal(size=(JOINTS, WAVES, plain_rig.vertex_count, 3))
    residuals = np.zeros((POSES, plain_rig.vertex_count, 3), np.float32)
    for joint in range(JOINTS):
        angles_about_x = angles[:, min(joint + 1, JOINTS - 1), 0]
        sines = np.sin(angles_about_x[:, None] * np.arange(3, 3 + WAVES))
        is_driven = driving_joints == joint
        residuals[:, is_driven] = 0.004 * np.einsum("nk,kva->nva", sines, waves[joint][:, is_driven])
    refined_partitions = reassign_vertices(make_partitions(plain_rig), driving_joints)
    positions = LinearSkinning(plain_rig, refined_partitions).complex_positions(matrices, residuals)
    matrices = matrices.astype(np.float64)
    matrices[:, :, :3, 3] = units_per_metre * (matrices[:, :, :3, 3] + origin_distance)
    residuals = units_per_metre * skinning.local_residuals(pose_chain(plain_rig, angles), positions)
    with RecordingWriter(path, rig, make_partitions(rig, INFLUENCING), chain_info(POSES)) as writer:
        writer.append(matrices.astype(np.float32), residuals.astype(np.float32))
    return read_recording(path)


def refine(recording: Recording, tolerance_mm: float = 0.2) -> tuple[Partition, ...]:
    return refine_partitions(recording, split_recording(recording, TrainingConfig()), False, tolerance_mm, 24)


def odd_vertices() -> np.ndarray:
    return (VERTICES_PER_RING * ODD_RINGS[:, None] + np.arange(VERTICES_PER_RING)).ravel()


@pytest.fixture(scope="module")
def odd_recording(tmp_path_factory) -> Recording:
    return write_odd_recording(tmp_path_factory.mktemp("odd") / "tube")


@pytest.fixture(scope="module")
def model_path(odd_recording, tmp_path_factory) -> Path:
    model = tmp_path_factory.mktemp("trained") / "tube.onnx"
    assert main([str(odd_recording.path), str(model), *QUICK_OPTIONS, "--tolerance-mm", "0.2"]) == 0
    return model


@pytest.mark.parametrize(("units_per_metre", "origin_distance"), [(1.0, 0.0), (1000.0, 0.0), (1.0, 100.0)])
def test_vertices_are_reassigned_to_the_partition_that_they_follow(tmp_path, units_per_metre, origin_distance):
    recording = write_odd_recording(tmp_path / "tube", units_per_metre, origin_distance)
    partitions = refine(recording)
    assert np.array_equal(np.setdiff1d(partitions[0].vertices, recording.partitions[0].vertices), odd_vertices())
    assert np.array_equal(partitions[2].vertices, recording.partitions[2].vertices)
    assert [replace(p, vertices=None) for p in partitions] == [replace(p, vertices=None) for p in recording.partitions]
    assert np.array_equal(
        np.sort(np.concatenate([p.vertices for p in partitions])), np.arange(RING_COUNT * VERTICES_PER_RING)
    )


def test_partitions_of_suitable_skin_weights_are_not_refined(tmp_path):
    recording = write_tube(tmp_path / "tube")
    for partition, recorded in zip(refine(recording), recording.partitions, strict=True):
        assert np.array_equal(partition.vertices, recorded.vertices)


def test_a_small_gain_is_not_refined(odd_recording, monkeypatch):
    monkeypatch.setattr(partition_refinement, "MAX_SIZE_RATIO", 0.5)
    assert refine(odd_recording) is odd_recording.partitions


def test_a_mesh_without_faces_or_inputs_is_not_refined(odd_recording):
    no_indices = np.zeros(0, np.int32)
    assert (
        refine(replace(odd_recording, rig=replace(odd_recording.rig, face_starts=no_indices, face_vertices=no_indices)))
        is odd_recording.partitions
    )
    partitions_without_inputs = tuple(
        replace(p, influencing=()) if p.joint == 1 else p for p in odd_recording.partitions
    )
    assert np.array_equal(
        partition_indices(refine(replace(odd_recording, partitions=partitions_without_inputs))),
        partition_indices(odd_recording.partitions),
    )


@pytest.mark.parametrize(
    ("limit", "maximum"), [("MAX_POSES", 8), ("MAX_ELEMENTS", 8 * 3 * RING_COUNT * VERTICES_PER_RING)]
)
def test_few_poses_refine_nothing(odd_recording, monkeypatch, limit, maximum):
    monkeypatch.setattr(partition_refinement, limit, maximum)
    assert np.array_equal(partition_indices(refine(odd_recording)), partition_indices(odd_recording.partitions))


def test_a_partition_keeps_some_vertices(odd_recording):
    few_vertices = odd_vertices()[:20]
    main_joints = np.where(
        np.isin(np.arange(RING_COUNT * VERTICES_PER_RING), few_vertices),
        1,
        np.where(odd_recording.rig.skin_joints[:, 0] == 2, 2, 0),
    )
    rig = replace(odd_recording.rig, skin_joints=main_joints[:, None].astype(np.int32))
    skinning = LinearSkinning(odd_recording.rig)
    positions = skinning.complex_positions(odd_recording.pose_matrices, odd_recording.residuals)
    small_recording = replace(
        odd_recording,
        rig=rig,
        partitions=make_partitions(rig, INFLUENCING),
        residuals=LinearSkinning(rig).local_residuals(odd_recording.pose_matrices, positions),
    )
    assert len(small_recording.partitions[1].vertices) == len(few_vertices)
    assert np.array_equal(refine(small_recording)[1].vertices, few_vertices)


def test_residuals_are_in_the_space_of_their_new_partition(odd_recording):
    refined_partitions = refine(odd_recording)
    poses = np.array([3, 50, 120])
    local = np.empty((len(poses), RING_COUNT * VERTICES_PER_RING, 3), np.float32)
    for partition in refined_partitions:
        local[:, partition.vertices] = residuals_of(odd_recording, partition, poses)
        assert np.array_equal(residuals_of(odd_recording, partition)[poses], local[:, partition.vertices])
    matrices = odd_recording.pose_matrices[poses]
    expected = LinearSkinning(odd_recording.rig, odd_recording.partitions).complex_positions(
        matrices, odd_recording.residuals[poses]
    )
    assert (
        np.abs(
            LinearSkinning(odd_recording.rig, refined_partitions).complex_positions(matrices, local) - expected
        ).max()
        < 2e-6
    )


def test_the_model_has_the_reassigned_vertices(odd_recording, model_path):
    info = read_model_info(model_path)
    assert [p.reassigned for p in info.partitions] == [tuple(odd_vertices().tolist()), (), ()]
    assert [len(p.vertices) for p in info.partitions_of(odd_recording.rig)] == [p.vertices for p in info.partitions]
    for partition, expected in zip(info.partitions_of(odd_recording.rig), refine(odd_recording), strict=True):
        assert np.array_equal(partition.vertices, expected.vertices)


def test_refinement_needs_fewer_parameters_for_no_larger_error(
    odd_recording, model_path, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(partition_refinement, "MAX_ROUNDS", 0)
    unrefined_path = tmp_path / "plain" / "tube.onnx"
    unrefined_path.parent.mkdir()
    assert main([str(odd_recording.path), str(unrefined_path), *QUICK_OPTIONS, "--tolerance-mm", "0.2"]) == 0
    assert "Partitions refined" not in capsys.readouterr().out
    unrefined_report, refined_report = (
        json.loads((model.parent / "report.json").read_text()) for model in (unrefined_path, model_path)
    )
    component_parameters = [
        sum(p["vertices"] * p["basis"] for p in report["partitions"]) for report in (unrefined_report, refined_report)
    ]
    assert (
        component_parameters[1] < 0.9 * component_parameters[0]
        and refined_report["model_bytes"] < unrefined_report["model_bytes"]
    )
    assert refined_report["fdda"]["held_out"]["mean"] < unrefined_report["fdda"]["held_out"]["mean"]
    assert all(p.reassigned == () for p in read_model_info(unrefined_path).partitions)


def test_a_warm_start_keeps_the_partitions(odd_recording, model_path, tmp_path, monkeypatch, capsys):
    checkpoint = read_checkpoint(checkpoint_path(model_path))
    assert np.array_equal(checkpoint.partition_indices, partition_indices(refine(odd_recording)))
    error_before = json.loads((model_path.parent / "report.json").read_text())["fdda"]["held_out"]["mean"]
    model = tmp_path / "tube.onnx"
    checkpoint_path(model).write_bytes(checkpoint_path(model_path).read_bytes())
    monkeypatch.setattr(train, "refine_partitions", None)
    assert (
        main(
            [
                str(odd_recording.path),
                str(model),
                *QUICK_OPTIONS,
                "--tolerance-mm",
                "0.2",
                "--epochs",
                "2",
                "--warm-start",
            ]
        )
        == 0
    )
    assert "Partitions refined: 36 vertices are reassigned to a neighbor partition." in capsys.readouterr().out
    assert read_model_info(model).partitions[0].reassigned == tuple(odd_vertices().tolist())
    error_after = json.loads((tmp_path / "report.json").read_text())["fdda"]["held_out"]["mean"]
    assert error_after < 1.5 * error_before


def write_changed_checkpoint(model_path: Path, path: Path, **changes) -> Path:
    with np.load(checkpoint_path(model_path)) as arrays:
        changed_arrays = {**arrays, **changes}
    with open(path, "wb") as file:
        np.savez(file, **changed_arrays)
    return path


@pytest.mark.parametrize(
    "change",
    [
        lambda indices: indices.astype(np.float64),
        lambda indices: indices[None],
        lambda indices: indices - 1,
        lambda indices: np.where(indices == 2, 7, indices),
        lambda indices: indices[:-1],
        lambda indices: np.zeros_like(indices),
    ],
)
def test_damaged_partition_indices_are_refused(model_path, tmp_path, change):
    with np.load(checkpoint_path(model_path)) as arrays:
        indices = arrays["partition_indices"]
    with pytest.raises(TrainingError, match="its arrays contradict each other"):
        read_checkpoint(write_changed_checkpoint(model_path, tmp_path / "bad.npz", partition_indices=change(indices)))


def test_partitions_of_another_mesh_are_refused(odd_recording, model_path):
    checkpoint = read_checkpoint(checkpoint_path(model_path))
    with pytest.raises(TrainingError, match="is of other partitions; train without --warm-start"):
        checkpoint.reassign(odd_recording.partitions[:2])


def test_a_stop_request_cancels_the_refinement(odd_recording):
    split = split_recording(odd_recording, TrainingConfig())
    with pytest.raises(Cancelled):
        refine_partitions(odd_recording, split, False, 0.2, 24, lambda: True)
