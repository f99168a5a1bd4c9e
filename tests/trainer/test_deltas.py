# SPDX-License-Identifier: GPL-3.0-or-later
"""Deltas: found where a rig smooths, as it smooths, and nowhere else; the same in the graph and without it."""

from dataclasses import replace

import numpy as np
import onnx
import pytest

from fdda_addon.core.partition import make_partitions
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.report import checkpoint_path
from fdda_addon.core.skinning import LinearSkinning
from trainer.__main__ import main
from trainer.checkpoint import read_checkpoint
from trainer.config import TrainingConfig
from trainer.data import split_recording
from trainer.delta_fit import LEAST_EXPLAINED, find_deltas
from trainer.deltas import NO_DELTAS, Deltas
from trainer.inputs import inputs_with_deltas
from trainer.process import Cancelled

from .chain import rotation, write_chain
from .conftest import QUICK
from .tube import INFLUENCING, JOINTS, POSES, smoothed, write_tube


def found_in(recording: Recording) -> Deltas:
    return find_deltas(recording, split_recording(recording, TrainingConfig()), tolerance_mm=0.04)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    return write_tube(tmp_path_factory.mktemp("tubes") / "tube")


@pytest.fixture(scope="module")
def deltas(recording) -> Deltas:
    return found_in(recording)


def test_a_rig_that_smooths_has_deltas_in_every_partition(recording, deltas):
    assert set(deltas.seen_from.tolist()) == set(range(JOINTS))
    assert np.array_equal(np.unique(deltas.vertices), deltas.vertices)
    for partition in recording.partitions:
        own = deltas.vertices[deltas.seen_from == partition.joint]
        assert np.isin(own, partition.vertices).all()


def test_tangents_and_normals_are_those_of_the_smoothed_surface(recording, deltas):
    rig, matrices = recording.rig, np.array(recording.pose_matrices[:5])
    for pose, skinned in enumerate(LinearSkinning(rig).positions(matrices).astype(np.float64)):
        faces = smoothed(rig, skinned)[rig.face_vertices.reshape(-1, 4)]
        before, after = ((np.roll(faces, shift, axis=1) - faces).reshape(-1, 3) for shift in (1, -1))
        vectors = np.stack([before + after, after - before, np.cross(before, after)])
        vectors /= np.linalg.norm(vectors, axis=2, keepdims=True)
        for number, vertex in enumerate(deltas.vertices):
            expected = vectors[:, rig.face_vertices == vertex]
            found = deltas.frames(matrices[pose, None])[0, :, number, : expected.shape[1]]
            # Neither the damping of corners nor how often is smoothed, found from the poses, makes a difference.
            assert np.abs(found - expected).max() < 1e-3


def test_deltas_say_what_joints_do_not(recording, deltas):
    """On poses that were not looked at, with what is linear in the joints beside them."""
    split = split_recording(recording, TrainingConfig())
    seen = deltas.seen(recording.pose_matrices).reshape(POSES, -1, 3)
    rows = np.linalg.inv(recording.pose_matrices[:, 1, None]) @ recording.pose_matrices
    rows = np.append(rows[:, :, :3].reshape(POSES, -1), np.ones((POSES, 1)), axis=1)
    for number in np.flatnonzero(deltas.seen_from == 1):
        wanted = recording.residuals[:, deltas.vertices[number]]
        errors = []
        for inputs in (rows, np.append(rows, seen[:, number], axis=1)):
            factors = np.linalg.lstsq(inputs[split.training], wanted[split.training], rcond=1e-6)[0]
            errors.append(((inputs[split.held_out] @ factors - wanted[split.held_out]) ** 2).sum())
        assert errors[1] < (1 - LEAST_EXPLAINED) * errors[0]


@pytest.mark.parametrize("per_metre, away", [(1000.0, 0.0), (1.0, 100.0), (1000.0, 100.0)])
def test_units_and_place_change_nothing(tmp_path, recording, deltas, per_metre, away):
    other = write_tube(tmp_path / "tube", per_metre, away)
    found = found_in(other)
    assert found.vertices.tolist() == deltas.vertices.tolist()
    seen, metres = found.seen(other.pose_matrices) / per_metre, deltas.seen(recording.pose_matrices)
    # 100 m away, positions have steps of 0.008 mm.
    assert np.abs(seen - metres).max() < (0.02 if away else 1e-4) * np.abs(metres).max()


def test_a_character_that_is_scaled_and_turned_as_a_whole_has_the_same_deltas(recording, deltas):
    matrices = recording.pose_matrices[:20].astype(np.float64)
    whole = rotation(0, 0.7) @ rotation(2, -1.9) @ np.diag([2.5, 2.5, 2.5, 1])
    whole[:3, 3] = 3, -2, 1
    seen = deltas.seen(matrices)
    # Corners that have nearly lost their extent are damped, by what they had at rest.
    assert np.abs(deltas.seen(whole @ matrices) - seen).max() < 1e-3 * np.abs(seen).max()


def test_a_rig_that_does_not_smooth_has_none(tmp_path):
    assert found_in(write_tube(tmp_path / "tube", smooths=False)) is NO_DELTAS


def test_what_corners_explain_by_chance_counts_for_nothing(tmp_path):
    """Bulges that grow with the bend: most of one comes out as the turn of the surface beside it."""
    write_chain(tmp_path / "chain")
    assert found_in(read_recording(tmp_path / "chain")) is NO_DELTAS


def test_a_rig_of_which_a_part_smooths_has_none(tmp_path, recording):
    """What the other vertices do costs a frame as much, and gains nothing."""
    waves = write_tube(tmp_path / "tube", smooths=False)
    residuals = np.array(waves.residuals)
    smooth = recording.partitions[0].vertices
    residuals[:, smooth] = recording.residuals[:, smooth]
    assert found_in(replace(recording, residuals=residuals)) is NO_DELTAS


def test_the_search_stops_when_it_is_told(recording):
    split = split_recording(recording, TrainingConfig())
    with pytest.raises(Cancelled):
        find_deltas(recording, split, tolerance_mm=0.04, should_stop=lambda: True)


def test_a_dozen_poses_say_nothing_of_smoothing(tmp_path):
    assert found_in(write_tube(tmp_path / "tube", poses=12)) is NO_DELTAS


def test_vertices_without_faces_are_none_and_change_nothing(recording, deltas):
    rig, more = recording.rig, 4 * recording.rig.vertex_count
    extended = {
        name: np.concatenate([getattr(rig, name), np.repeat(getattr(rig, name)[-1:], more, axis=0)])
        for name in ("rest_positions", "skin_joints", "skin_weights")
    }
    rig = replace(rig, **extended)
    residuals = np.concatenate([recording.residuals, np.ones((POSES, more, 3), np.float32)], axis=1)
    found = found_in(replace(recording, rig=rig, residuals=residuals, partitions=make_partitions(rig, INFLUENCING)))
    assert found.vertices.tolist() == deltas.vertices.tolist()


def test_without_faces_there_are_none(recording):
    none = np.zeros(0, np.int32)
    assert found_in(replace(recording, rig=replace(recording.rig, face_starts=none, face_vertices=none))) is NO_DELTAS


def test_what_the_joints_place_needs_none(recording):
    split = split_recording(recording, TrainingConfig())
    assert find_deltas(recording, split, tolerance_mm=100.0) is NO_DELTAS


def test_a_surface_without_extent_gives_numbers(recording, deltas):
    flat = np.zeros((2, JOINTS, 4, 4), np.float32)
    flat[:, :, 3, 3] = 1
    assert (deltas.seen(flat) == 0).all()


@pytest.fixture(scope="module")
def trained(recording, tmp_path_factory):
    model = tmp_path_factory.mktemp("models") / "tube.onnx"
    assert main([str(recording.path), str(model), *QUICK]) == 0
    return model


def test_the_model_has_them(trained):
    """That the graph gives what PyTorch gives, the training has checked."""
    names = {node.name for node in onnx.load(trained).graph.node}
    assert "seen_deltas" in names
    assert len(names) <= 55 + 23 + JOINTS


@pytest.mark.parametrize("way", [{"per_metre": 1000.0, "away": 100.0}, {"sheared": True}], ids=["far away", "sheared"])
def test_the_graph_agrees_with_pytorch_in_other_rigs(tmp_path, way):
    write_tube(tmp_path / "tube", **way)
    assert main([str(tmp_path / "tube"), str(tmp_path / "tube.onnx"), *QUICK, "--epochs", "4"]) == 0
    assert "seen_deltas" in {node.name for node in onnx.load(tmp_path / "tube.onnx").graph.node}


def test_a_training_goes_on_with_the_same(recording, deltas, trained, capsys):
    last = read_checkpoint(checkpoint_path(trained)).deltas
    for name, array in vars(deltas).items():
        assert np.array_equal(getattr(last, name), array), name
    offered = inputs_with_deltas(recording.rig, recording.partitions, last).columns
    assert [len(own) % 3 for own in offered] == [0] * JOINTS
    assert main([str(recording.path), str(trained), *QUICK, "--warm-start"]) == 0
    assert f"The rig smooths: networks see the deltas of {len(deltas)} vertices." in capsys.readouterr().out


DAMAGE = {
    "corners without a second tangent": ("tangents", lambda array: array[:1]),
    "a joint that is none": ("seen_from", lambda array: array + 10_000),
    "a vertex below zero": ("vertices", lambda array: array - 10_000),
    "lengths that are no numbers": ("lengths", lambda array: array * np.nan),
    "corners without a least extent": ("least", lambda array: 0 * array),
    "tangents of other joints": ("tangents", lambda array: array[..., :4]),
    "too few": ("vertices", lambda array: array[:1]),
    "other numbers": ("lengths", lambda array: array.astype(np.float32)),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_deltas_are_refused(recording, trained, tmp_path, capsys, damage):
    name, change = DAMAGE[damage]
    with np.load(checkpoint_path(trained)) as arrays:
        changed = {**arrays, f"deltas/{name}": change(arrays[f"deltas/{name}"])}
    model = tmp_path / "tube.onnx"
    with open(checkpoint_path(model), "wb") as file:
        np.savez(file, **changed)
    model.write_bytes(trained.read_bytes())
    assert main([str(recording.path), str(model), *QUICK, "--warm-start"]) == 1
    assert "train without --warm-start" in capsys.readouterr().err
