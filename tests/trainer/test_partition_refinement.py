# SPDX-License-Identifier: GPL-3.0-or-later
"""Partition refinement makes the model smaller, and export, checkpoint and report use the refined partitions."""

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
from trainer import partition_refinement, training
from trainer.__main__ import main
from trainer.checkpoint import read_checkpoint
from trainer.config import TrainingConfig
from trainer.data import residuals_of
from trainer.partition_refinement import partition_indices, reassign_vertices, refine_partitions
from trainer.process import Cancelled
from trainer.splitting import split_recording

from .chain import chain_angles, chain_info, pose_chain
from .conftest import QUICK
from .tube import AROUND, INFLUENCING, JOINTS, RINGS, tube, write_tube

POSES, WAVES = 200, 4
ODD_RINGS = np.arange(RINGS // JOINTS, RINGS // JOINTS + 3)
"""Rings of vertices with weights on the middle joint, whose residuals depend on the first joint."""


def write_odd(path: Path, per_metre: float = 1.0, away: float = 0.0) -> Recording:
    """Write a tube where the first joint deforms vertices beyond its weights."""
    plain, rig, angles = tube(), tube(per_metre, away), chain_angles(POSES, JOINTS, seed=3, reach=1.5)
    matrices, skinning = pose_chain(plain, angles), LinearSkinning(plain)
    ring = np.arange(plain.vertex_count) // AROUND
    follows = np.where(np.isin(ring, ODD_RINGS), 0, plain.skin_joints[:, 0])
    waves = np.random.default_rng(2).normal(size=(JOINTS, WAVES, plain.vertex_count, 3))
    residuals = np.zeros((POSES, plain.vertex_count, 3), np.float32)
    for joint in range(JOINTS):
        bend = angles[:, min(joint + 1, JOINTS - 1), 0]
        sines = np.sin(bend[:, None] * np.arange(3, 3 + WAVES))
        own = follows == joint
        residuals[:, own] = 0.004 * np.einsum("nk,kva->nva", sines, waves[joint][:, own])
    refined_partitions = reassign_vertices(make_partitions(plain), follows)
    positions = LinearSkinning(plain, refined_partitions).complex_positions(matrices, residuals)
    matrices = matrices.astype(np.float64)
    matrices[:, :, :3, 3] = per_metre * (matrices[:, :, :3, 3] + away)
    residuals = per_metre * skinning.local_residuals(pose_chain(plain, angles), positions)
    with RecordingWriter(path, rig, make_partitions(rig, INFLUENCING), chain_info(POSES)) as writer:
        writer.append(matrices.astype(np.float32), residuals.astype(np.float32))
    return read_recording(path)


def refined(recording: Recording, tolerance_mm: float = 0.2) -> tuple[Partition, ...]:
    return refine_partitions(recording, split_recording(recording, TrainingConfig()), False, tolerance_mm, 24)


def odd_vertices() -> np.ndarray:
    return (AROUND * ODD_RINGS[:, None] + np.arange(AROUND)).ravel()


@pytest.fixture(scope="module")
def odd(tmp_path_factory) -> Recording:
    return write_odd(tmp_path_factory.mktemp("odd") / "tube")


@pytest.fixture(scope="module")
def trained(odd, tmp_path_factory) -> Path:
    model = tmp_path_factory.mktemp("trained") / "tube.onnx"
    assert main([str(odd.path), str(model), *QUICK, "--tolerance-mm", "0.2"]) == 0
    return model


@pytest.mark.parametrize(("per_metre", "away"), [(1.0, 0.0), (1000.0, 0.0), (1.0, 100.0)])
def test_vertices_are_reassigned_to_the_partition_that_they_follow(tmp_path, per_metre, away):
    recording = write_odd(tmp_path / "tube", per_metre, away)
    partitions = refined(recording)
    assert np.array_equal(np.setdiff1d(partitions[0].vertices, recording.partitions[0].vertices), odd_vertices())
    assert np.array_equal(partitions[2].vertices, recording.partitions[2].vertices)
    assert [replace(p, vertices=None) for p in partitions] == [replace(p, vertices=None) for p in recording.partitions]
    assert np.array_equal(np.sort(np.concatenate([p.vertices for p in partitions])), np.arange(RINGS * AROUND))


def test_good_skin_weights_are_not_refined(tmp_path):
    recording = write_tube(tmp_path / "tube")
    for partition, recorded in zip(refined(recording), recording.partitions, strict=True):
        assert np.array_equal(partition.vertices, recorded.vertices)


def test_a_small_gain_is_not_refined(odd, monkeypatch):
    monkeypatch.setattr(partition_refinement, "MAX_SIZE_RATIO", 0.5)
    assert refined(odd) is odd.partitions


def test_a_mesh_without_faces_or_inputs_is_not_refined(odd):
    none = np.zeros(0, np.int32)
    assert refined(replace(odd, rig=replace(odd.rig, face_starts=none, face_vertices=none))) is odd.partitions
    partitions_without_inputs = tuple(replace(p, influencing=()) if p.joint == 1 else p for p in odd.partitions)
    assert np.array_equal(
        partition_indices(refined(replace(odd, partitions=partitions_without_inputs))),
        partition_indices(odd.partitions),
    )


@pytest.mark.parametrize(("limit", "maximum"), [("MAX_POSES", 8), ("MAX_ELEMENTS", 8 * 3 * RINGS * AROUND)])
def test_few_poses_refine_nothing(odd, monkeypatch, limit, maximum):
    monkeypatch.setattr(partition_refinement, limit, maximum)
    assert np.array_equal(partition_indices(refined(odd)), partition_indices(odd.partitions))


def test_a_partition_keeps_some_vertices(odd):
    few = odd_vertices()[:20]
    main_joints = np.where(np.isin(np.arange(RINGS * AROUND), few), 1, np.where(odd.rig.skin_joints[:, 0] == 2, 2, 0))
    rig = replace(odd.rig, skin_joints=main_joints[:, None].astype(np.int32))
    skinning = LinearSkinning(odd.rig)
    positions = skinning.complex_positions(odd.pose_matrices, odd.residuals)
    small = replace(
        odd,
        rig=rig,
        partitions=make_partitions(rig, INFLUENCING),
        residuals=LinearSkinning(rig).local_residuals(odd.pose_matrices, positions),
    )
    assert len(small.partitions[1].vertices) == len(few)
    assert np.array_equal(refined(small)[1].vertices, few)


def test_residuals_are_in_the_space_of_their_new_partition(odd):
    refined_partitions = refined(odd)
    poses = np.array([3, 50, 120])
    local = np.empty((len(poses), RINGS * AROUND, 3), np.float32)
    for partition in refined_partitions:
        local[:, partition.vertices] = residuals_of(odd, partition, poses)
        assert np.array_equal(residuals_of(odd, partition)[poses], local[:, partition.vertices])
    matrices = odd.pose_matrices[poses]
    expected = LinearSkinning(odd.rig, odd.partitions).complex_positions(matrices, odd.residuals[poses])
    assert (
        np.abs(LinearSkinning(odd.rig, refined_partitions).complex_positions(matrices, local) - expected).max() < 2e-6
    )


def test_the_model_has_the_reassigned_vertices(odd, trained):
    info = read_model_info(trained)
    assert [p.reassigned for p in info.partitions] == [tuple(odd_vertices().tolist()), (), ()]
    assert [len(p.vertices) for p in info.partitions_of(odd.rig)] == [p.vertices for p in info.partitions]
    for ours, theirs in zip(info.partitions_of(odd.rig), refined(odd), strict=True):
        assert np.array_equal(ours.vertices, theirs.vertices)


def test_refinement_needs_fewer_parameters_for_no_larger_error(odd, trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(partition_refinement, "MAX_ROUNDS", 0)
    plain = tmp_path / "plain" / "tube.onnx"
    plain.parent.mkdir()
    assert main([str(odd.path), str(plain), *QUICK, "--tolerance-mm", "0.2"]) == 0
    assert "Partitions refined" not in capsys.readouterr().out
    before, now = (json.loads((model.parent / "report.json").read_text()) for model in (plain, trained))
    numbers = [sum(p["vertices"] * p["basis"] for p in report["partitions"]) for report in (before, now)]
    assert numbers[1] < 0.9 * numbers[0] and now["model_bytes"] < before["model_bytes"]
    assert now["fdda"]["held_out"]["mean"] < before["fdda"]["held_out"]["mean"]
    assert all(p.reassigned == () for p in read_model_info(plain).partitions)


def test_a_warm_start_keeps_the_partitions(odd, trained, tmp_path, monkeypatch, capsys):
    checkpoint = read_checkpoint(checkpoint_path(trained))
    assert np.array_equal(checkpoint.partition_indices, partition_indices(refined(odd)))
    before = json.loads((trained.parent / "report.json").read_text())["fdda"]["held_out"]["mean"]
    model = tmp_path / "tube.onnx"
    checkpoint_path(model).write_bytes(checkpoint_path(trained).read_bytes())
    monkeypatch.setattr(training, "refine_partitions", None)
    assert main([str(odd.path), str(model), *QUICK, "--tolerance-mm", "0.2", "--epochs", "2", "--warm-start"]) == 0
    assert "Partitions refined: 36 vertices are reassigned to a neighbor partition." in capsys.readouterr().out
    assert read_model_info(model).partitions[0].reassigned == tuple(odd_vertices().tolist())
    after = json.loads((tmp_path / "report.json").read_text())["fdda"]["held_out"]["mean"]
    assert after < 1.5 * before


def changed_checkpoint(trained: Path, path: Path, **changes) -> Path:
    with np.load(checkpoint_path(trained)) as arrays:
        kept = {**arrays, **changes}
    with open(path, "wb") as file:
        np.savez(file, **kept)
    return path


@pytest.mark.parametrize(
    "change",
    [
        lambda own: own.astype(np.float64),
        lambda own: own[None],
        lambda own: own - 1,
        lambda own: np.where(own == 2, 7, own),
        lambda own: own[:-1],
        lambda own: np.zeros_like(own),
    ],
)
def test_damaged_partition_indices_are_refused(trained, tmp_path, change):
    with np.load(checkpoint_path(trained)) as arrays:
        own = arrays["partition_indices"]
    with pytest.raises(TrainingError, match="its arrays contradict each other"):
        read_checkpoint(changed_checkpoint(trained, tmp_path / "bad.npz", partition_indices=change(own)))


def test_partitions_of_another_mesh_are_refused(odd, trained):
    checkpoint = read_checkpoint(checkpoint_path(trained))
    with pytest.raises(TrainingError, match="is of other partitions; train without --warm-start"):
        checkpoint.reassign(odd.partitions[:2])


def test_a_stop_request_cancels_the_refinement(odd):
    split = split_recording(odd, TrainingConfig())
    with pytest.raises(Cancelled):
        refine_partitions(odd, split, False, 0.2, 24, lambda: True)
