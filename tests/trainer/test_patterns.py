# SPDX-License-Identifier: GPL-3.0-or-later
"""Patterns of large partitions: fewer numbers that play the same, wherever the rig is and whatever lengths are in."""

from dataclasses import replace

import numpy as np
import onnx
import pytest

from fdda_addon.core.partition import Partition, make_partitions
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.rig import Rig
from fdda_addon.core.skinning import LinearSkinning, skin_matrices
from trainer.__main__ import main
from trainer.basis import make_basis
from trainer.deformation import Deformation
from trainer.graph import build_graph
from trainer.joint_fit import JointFit, Surroundings, surroundings_of_rig
from trainer.patterns import TOLERANCE_PART, Patterns, find_patterns, may_have_patterns

from .chain import chain_angles, chain_info, chain_rig, pose_chain
from .conftest import QUICK
from .test_graph import agrees, keep_deformation, played

JOINTS, VERTICES, POSES = 3, 6_000, 120
INFLUENCING = {0: (1,), 1: (1, 2), 2: (2,)}
TOLERANCE = 4e-5
TRAINING = np.arange(POSES)
ONES = np.ones(POSES)


def sliding(rig: Rig, angles: np.ndarray) -> np.ndarray:
    """(N, V, 3) float32 local residuals, bulges that slide with the bends beside them: no few shapes have them all."""
    place = rig.rest_positions[:, 2] * JOINTS
    residuals = np.zeros((len(angles), rig.vertex_count, 3))
    for joint in range(1, JOINTS):
        bend, twist = angles[:, joint, :1], angles[:, joint, 1:]
        bulge = np.exp(-(((place - joint - 0.5 * bend) / 0.3) ** 2)) * 0.02
        residuals[:, :, 0] += bulge * bend**2
        residuals[:, :, 1] += bulge * np.sin(twist) * np.cos(7 * place + twist)
    return residuals.astype(np.float32)


class Prepared:
    """A partition of the tube, fitted, with its basis.

    Args:
        away: how far the tube stands from the origin, metres.
        per_metre: mesh units.
    """

    def __init__(self, away: float = 0.0, per_metre: float = 1.0, still: bool = False):
        rig, angles = chain_rig(JOINTS, VERTICES), chain_angles(POSES, JOINTS, 0)
        residuals = sliding(rig, angles) * (not still)
        there = np.eye(4)
        there[:3, 3] = away
        self.rig, poses = moved(rig, there, per_metre), there @ pose_chain(rig, angles)
        poses[..., :3, 3] *= per_metre
        self.partition: Partition = make_partitions(self.rig, INFLUENCING)[1]
        self.skin = skin_matrices(poses, self.rig.rest_matrices)
        self.surroundings: Surroundings = surroundings_of_rig(self.rig, self.partition, self.skin)
        own = residuals[:, self.partition.vertices] * np.float32(per_metre)
        self.tolerance = TOLERANCE * per_metre
        self.fit, left = self.surroundings.fit(own, TRAINING)
        left = left.reshape(POSES, -1)
        self.basis = make_basis(left, self.tolerance, np.random.default_rng(0))
        self.coefficients = self.basis.coefficients(left)

    def found(self, weights: np.ndarray = ONES) -> Patterns | None:
        arguments = self.fit, self.basis, self.coefficients, self.surroundings, TRAINING, weights, self.tolerance
        return find_patterns(*arguments)

    def offsets(self, of: "Prepared | Patterns") -> np.ndarray:
        """(N, Vp, 3) offsets from linear skinning as the main joint sees them, mesh units."""
        turned = np.linalg.inv(self.skin[:, self.partition.joint, :3, :3].astype(np.float64))
        fitted = of.fit.offsets(self.skin) @ turned.transpose(0, 2, 1)
        return fitted + of.basis.residuals(of.coefficients).reshape(fitted.shape)


def moved(rig: Rig, there: np.ndarray, per_metre: float) -> Rig:
    rest = there @ rig.rest_matrices
    rest[:, :3, 3] *= per_metre
    positions = (rig.rest_positions + there[:3, 3]) * per_metre
    return replace(
        rig,
        rest_positions=positions.astype(np.float32),
        rest_matrices=rest.astype(np.float32),
        metres_per_unit=1 / per_metre,
    )


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return Prepared()


def rms(apart: np.ndarray) -> float:
    return float(np.sqrt((apart**2).sum(axis=2).mean()))


@pytest.mark.parametrize("away, per_metre", [(0, 1), (100, 1), (0, 1000), (100, 1000)])
def test_patterns_play_the_same_in_fewer_numbers(away, per_metre):
    prepared = Prepared(away, per_metre)
    found = prepared.found()
    height = len(prepared.fit.factors) + 3 * len(prepared.basis.shapes)
    # As many wherever it is.
    assert len(found.numbers) == len(Prepared().found().numbers) < height / 2
    apart = rms(prepared.offsets(found) - prepared.offsets(prepared)) / per_metre
    # What float32 rounds 100 m away is more than patterns leave.
    assert 0 < apart < TOLERANCE_PART * TOLERANCE + away * 2e-7
    assert found.left / per_metre <= TOLERANCE_PART * TOLERANCE
    if not away:
        assert apart == pytest.approx(found.left / per_metre, rel=0.02)


def test_everything_is_made_of_them(prepared):
    found = prepared.found()
    count, vertices = len(found.basis.shapes), len(prepared.partition.vertices)
    np.testing.assert_allclose(found.numbers @ found.numbers.T, np.eye(len(found.numbers)), atol=1e-5)
    np.testing.assert_allclose(found.basis.shapes @ found.basis.shapes.T, np.eye(count), atol=1e-5)
    for numbers in (
        found.fit.factors,
        found.basis.mean.reshape(vertices, 3).T,
        *found.basis.shapes.reshape(count, vertices, 3).transpose(0, 2, 1),
    ):
        np.testing.assert_allclose(
            numbers @ found.numbers.T @ found.numbers, numbers, atol=1e-5 * np.abs(numbers).max()
        )
    # Moving all joints together still moves nothing.
    np.testing.assert_allclose(found.fit.factors.reshape(-1, 4, vertices)[:, 3].sum(axis=0), 0, atol=1e-6)


def test_what_is_left_is_said(prepared):
    found = prepared.found()
    assert found.basis.truncation == pytest.approx(np.hypot(prepared.basis.truncation, found.left))
    assert len(found.basis.left) == len(found.basis.shapes) + 1


def test_poses_that_count_less_have_fewer(prepared):
    weights = np.where(TRAINING < 2, 1.0, 1e-9)
    assert len(prepared.found(weights).numbers) < len(prepared.found().numbers)


def test_what_never_moves_has_none():
    still = Prepared(still=True)
    # A fit of more joints than there is anything to say of.
    factors = np.zeros((12, len(still.partition.vertices)), np.float32)
    still.fit = JointFit(np.arange(3)[[1, 0, 2]], factors)
    found = still.found()
    assert found.numbers.shape == (0, len(still.partition.vertices)) and len(found.basis.shapes) == 0
    assert not still.offsets(found).any() and found.coefficients.shape == (POSES, 0)


def test_small_partitions_have_none(prepared):
    few = slice(0, 100)
    fit = replace(prepared.fit, factors=prepared.fit.factors[:, few])
    basis = replace(prepared.basis, mean=prepared.basis.mean[:300], shapes=prepared.basis.shapes[:, :300])
    assert may_have_patterns(prepared.fit, prepared.basis)
    assert not may_have_patterns(fit, basis)
    # Nothing is known of the joints.
    assert not may_have_patterns(JointFit(np.zeros(0, np.int64), prepared.fit.factors[:0]), prepared.basis)


def test_numbers_that_say_different_things_stay(prepared):
    rng = np.random.default_rng(0)
    other = Prepared()
    other.fit = replace(other.fit, factors=rng.normal(0, 0.1, other.fit.factors.shape).astype(np.float32))
    count = len(other.basis.shapes)
    shapes = np.linalg.qr(rng.normal(0, 1, (3 * len(other.partition.vertices), count)))[0]
    other.basis = replace(other.basis, shapes=shapes.T.astype(np.float32))
    other.coefficients = rng.normal(0, 1, other.coefficients.shape).astype(np.float32)
    assert other.found() is None


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Deformation:
    rig, angles = chain_rig(JOINTS, VERTICES), chain_angles(POSES, JOINTS, 0)
    path = tmp_path_factory.mktemp("patterns")
    with RecordingWriter(path / "recording", rig, make_partitions(rig, INFLUENCING), chain_info(POSES)) as writer:
        writer.append(pose_chain(rig, angles), sliding(rig, angles))
    with pytest.MonkeyPatch.context() as monkeypatch:
        made = keep_deformation(monkeypatch)
        assert main([str(path / "recording"), str(path / "model.onnx"), *QUICK]) == 0
    return made[0]


def test_the_graph_plays_them(trained):
    assert all(own.patterns is not None for own in trained.prepared)
    graph = build_graph(trained).graph
    sizes = {constant.name: onnx.numpy_helper.to_array(constant).shape for constant in graph.initializer}
    through = [number for number in range(JOINTS) if f"weights_of_patterns_{number}" in sizes]
    assert through == list(range(JOINTS))
    for number in through:
        rows, columns = sizes[f"weights_of_patterns_{number}"]
        assert sizes[f"matrix_{number}"][0] == columns < rows
    assert (agrees(trained, pose_chain(trained.rig, chain_angles(20, JOINTS, 5) * [1, 0])) > 0).all()


def test_the_graph_plays_them_far_away_and_beyond_the_range(trained):
    poses = pose_chain(trained.rig, chain_angles(20, JOINTS, 5, reach=1.2))
    there = np.eye(4)
    there[:3, 3] = 60, -70, 40
    confidence = agrees(trained, (there @ poses).astype(np.float32), tolerance=1e-4)
    assert (confidence < 1).any()
    folded = pose_chain(trained.rig, np.full((1, JOINTS, 2), 3.0))
    positions, confidence = played(trained, folded)
    middle = trained.partitions[1].vertices
    assert confidence[0, 1] == 0
    linear = LinearSkinning(trained.rig).positions(folded)
    np.testing.assert_allclose(positions[:, middle], linear[:, middle], atol=1e-6)
