# SPDX-License-Identifier: GPL-3.0-or-later
"""Deltas: found where a rig smooths, as it smooths, and nowhere else; the same in the graph and without it."""

import json
from dataclasses import replace

import numpy as np
import onnx
import pytest

from fdda_addon.core.partition import make_partitions
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.report import weights_path
from fdda_addon.core.rig import Fingerprint, Joint, Rig
from fdda_addon.core.skinning import LinearLayer
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data import split_recording
from trainer.delta_fit import LEAST_EXPLAINED, find_deltas
from trainer.deltas import NO_DELTAS, Deltas
from trainer.inputs import inputs_of_recording
from trainer.weights import read_weights

from .chain import chain_angles, chain_info, pose_chain, rotation, write_chain
from .conftest import QUICK

JOINTS, RINGS, AROUND, POSES = 3, 24, 12, 160
ITERATIONS, FACTOR = 6, 0.5


def tube(per_metre: float = 1.0, away: float = 0.0) -> Rig:
    """A tube of one metre along z with bulges, of rings of quads, each ring on one joint."""
    height, angle = np.meshgrid(np.linspace(0, 1, RINGS), np.arange(AROUND) * 2 * np.pi / AROUND, indexing="ij")
    radius = 0.08 + 0.015 * np.sin(9 * height) * np.cos(3 * angle)
    positions = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2).reshape(-1, 3)
    joints = np.minimum((height.ravel() * JOINTS).astype(np.int32), JOINTS - 1)[:, None]
    rest = np.stack([np.eye(4)] * JOINTS)
    rest[:, 2, 3] = np.arange(JOINTS) / JOINTS
    rest = rest @ rotation(0, 0.3)
    rest[:, :3, 3] = per_metre * (rest[:, :3, 3] + away)
    ring, place = np.divmod(np.arange((RINGS - 1) * AROUND), AROUND)
    beside = (place + 1) % AROUND
    faces = AROUND * ring[:, None] + np.stack([place, beside, beside + AROUND, place + AROUND], axis=1)
    positions = (per_metre * (positions + away)).astype(np.float32)
    return Rig(
        tuple(Joint(f"bone_{number}", number - 1) for number in range(JOINTS)),
        positions,
        rest.astype(np.float32),
        joints,
        np.ones(joints.shape, np.float32),
        Fingerprint("tube", Fingerprint.digest(positions), "one"),
        np.arange(0, faces.size, 4, dtype=np.int32),
        faces.astype(np.int32).ravel(),
        metres_per_unit=1 / per_metre,
    )


def smoothed(rig: Rig, positions: np.ndarray) -> np.ndarray:
    """Positions (V, 3) smoothed as Blender's Corrective Smooth does it, simply: towards the mean of those beside."""
    faces = rig.face_vertices.reshape(-1, 4)
    edges = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    beside = np.zeros((len(positions), len(positions)))
    beside[edges[:, 0], edges[:, 1]] = beside[edges[:, 1], edges[:, 0]] = 1
    beside /= beside.sum(axis=1, keepdims=True)
    for _ in range(ITERATIONS):
        positions = positions + FACTOR * (beside @ positions - positions)
    return positions


def corner_frames(rig: Rig, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, 3, 3) frames of the corners, in columns, and (C,) their weights, as Corrective Smooth has them."""
    faces = positions[rig.face_vertices.reshape(-1, 4)]
    before, after = (np.roll(faces, shift, axis=1) - faces for shift in (1, -1))
    before, after = (edge / np.linalg.norm(edge, axis=2, keepdims=True) for edge in (before, after))
    normal, tangent = np.cross(before, after), before + after
    normal, tangent = (vector / np.linalg.norm(vector, axis=2, keepdims=True) for vector in (normal, tangent))
    frames = np.stack([normal, tangent, np.cross(normal, tangent)], axis=3)
    weights = np.pi - np.arccos(np.clip((before * after).sum(axis=2), -1, 1))
    return frames.reshape(-1, 3, 3), weights.ravel()


def delta_mush(rig: Rig, skinned: np.ndarray) -> np.ndarray:
    """(N, V, 3) skinned positions to those that delta mush makes of them."""
    rest = rig.rest_positions.astype(np.float64)
    frames, _ = corner_frames(rig, smoothed(rig, rest))
    deltas = np.einsum("cab,ca->cb", frames, (rest - smoothed(rig, rest))[rig.face_vertices])
    found = []
    for positions in skinned.astype(np.float64):
        positions = smoothed(rig, positions)
        frames, weights = corner_frames(rig, positions)
        moved, total = np.zeros_like(positions), np.zeros(len(positions))
        np.add.at(moved, rig.face_vertices, weights[:, None] * np.einsum("cab,cb->ca", frames, deltas))
        np.add.at(total, rig.face_vertices, weights)
        found.append(positions + moved / total[:, None])
    return np.array(found)


INFLUENCING = {joint: tuple(i for i in (joint, joint + 1) if 0 < i < JOINTS) for joint in range(JOINTS)}


def write_tube(
    path, per_metre: float = 1.0, away: float = 0.0, smooths: bool = True, sheared: bool = False, poses: int = POSES
) -> Recording:
    """A recording of the tube with delta mush, or with bulges that follow the joints in another way."""
    plain, rig, angles = tube(), tube(per_metre, away), chain_angles(poses, JOINTS, seed=1, reach=1.5)
    matrices, layer = pose_chain(plain, angles), LinearLayer(plain)
    if sheared:
        matrices[:, -1, :3, 0] += 0.4 * np.sin(angles[:, -1, :1]) * matrices[:, -1, :3, 1]
    if smooths:
        residuals = layer.local_residuals(matrices, delta_mush(plain, layer.positions(matrices)))
    else:
        waves = np.random.default_rng(2).normal(size=(2, plain.vertex_count, 3))
        residuals = 0.01 * np.einsum("nj,jva->nva", np.sin(7 * angles[:, 1]), waves)
    matrices = matrices.astype(np.float64)
    matrices[:, :, :3, 3] = per_metre * (matrices[:, :, :3, 3] + away)
    with RecordingWriter(path, rig, make_partitions(rig, INFLUENCING), chain_info(poses)) as writer:
        writer.append(matrices.astype(np.float32), (per_metre * residuals).astype(np.float32))
    return read_recording(path)


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


def test_normals_are_those_of_the_smoothed_surface(recording, deltas):
    rig, matrices = recording.rig, np.array(recording.pose_matrices[:5])
    for pose, skinned in enumerate(LinearLayer(rig).positions(matrices).astype(np.float64)):
        frames, _ = corner_frames(rig, smoothed(rig, skinned))
        for number, vertex in enumerate(deltas.vertices):
            expected = frames[rig.face_vertices == vertex, :, 0]
            normals = deltas.normals(matrices[pose, None])[0, number, : len(expected)]
            # Neither the damping of corners nor how often is smoothed, found from the poses, makes a difference.
            assert np.abs(normals - expected).max() < 1e-3


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


def test_what_normals_explain_by_chance_counts_for_nothing(tmp_path):
    """Bulges that grow with the bend: most of one comes out as the turn of the surface beside it."""
    write_chain(tmp_path / "chain")
    assert found_in(read_recording(tmp_path / "chain")) is NO_DELTAS


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
    assert len(names) <= 56 + 28 + JOINTS


@pytest.mark.parametrize("way", [{"per_metre": 1000.0, "away": 100.0}, {"sheared": True}], ids=["far away", "sheared"])
def test_the_graph_agrees_with_pytorch_in_other_rigs(tmp_path, way):
    write_tube(tmp_path / "tube", **way)
    assert main([str(tmp_path / "tube"), str(tmp_path / "tube.onnx"), *QUICK, "--epochs", "4"]) == 0
    assert "seen_deltas" in {node.name for node in onnx.load(tmp_path / "tube.onnx").graph.node}


def test_weights_of_before_have_none(trained, tmp_path):
    with np.load(weights_path(trained)) as arrays:
        kept = {name: array for name, array in arrays.items() if not name.startswith("deltas/")}
    about = json.loads(kept["about"].tobytes())
    assert about["version"] == 3
    kept["about"] = np.frombuffer(json.dumps({**about, "version": 2}).encode(), np.uint8)
    with open(tmp_path / "old.npz", "wb") as file:
        np.savez(file, **kept)
    assert read_weights(tmp_path / "old.npz").deltas is NO_DELTAS


def test_a_training_goes_on_with_the_same(recording, deltas, trained, capsys):
    last = read_weights(weights_path(trained)).deltas
    for name, array in vars(deltas).items():
        assert np.array_equal(getattr(last, name), array), name
    offered = inputs_of_recording(recording, last).columns
    assert [len(own) % 3 for own in offered] == [0] * JOINTS
    assert main([str(recording.path), str(trained), *QUICK, "--warm-start"]) == 0
    assert f"The rig smooths: networks see the deltas of {len(deltas)} vertices." in capsys.readouterr().out


DAMAGE = {
    "an edge that is none": ("corners", lambda array: array + 10_000),
    "a joint that is none": ("seen_from", lambda array: array + 10_000),
    "a vertex below zero": ("vertices", lambda array: array - 10_000),
    "lengths that are no numbers": ("lengths", lambda array: array * np.nan),
    "corners without a least area": ("least", lambda array: 0 * array),
    "edges of other joints": ("edges", lambda array: array[:, :4]),
    "too few": ("vertices", lambda array: array[:1]),
    "other numbers": ("lengths", lambda array: array.astype(np.float32)),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_deltas_are_refused(recording, trained, tmp_path, capsys, damage):
    name, change = DAMAGE[damage]
    with np.load(weights_path(trained)) as arrays:
        changed = {**arrays, f"deltas/{name}": change(arrays[f"deltas/{name}"])}
    model = tmp_path / "tube.onnx"
    with open(weights_path(model), "wb") as file:
        np.savez(file, **changed)
    model.write_bytes(trained.read_bytes())
    assert main([str(recording.path), str(model), *QUICK, "--warm-start"]) == 1
    assert "train without --warm-start" in capsys.readouterr().err
