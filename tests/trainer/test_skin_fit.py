# SPDX-License-Identifier: GPL-3.0-or-later
"""The fit of skin weights recovers the true weights, keeps its constraints, and improves poor weights."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.formats.messages import STOP_FILE_VARIABLE, Message, MessageType
from fdda_addon.core.mathematics.skin_fit import SkinFit
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.arrays import array_header
from fdda_addon.core.recording.fit_folder import FitPoses, FitPosesWriter, read_fit_poses, read_fitted_weights
from fdda_addon.core.rig import Fingerprint, Joint, Rig
from trainer.skin.__main__ import main
from trainer.skin.job import fit_folder, measure
from trainer.skin.solver import fit_skin, simplex_weights

from .. import systems
from .chain import rotation
from .conftest import REPOSITORY

JOINTS, VERTICES, POSES = 24, 300, 40


class SilentSink:
    def send(self, message_type: MessageType, **values) -> None:
        pass


def random_poses(rng: np.random.Generator, heads: np.ndarray, poses: int = POSES) -> np.ndarray:
    """Draw (N, J, 4, 4) float32 matrices. Each joint rotates and moves a little; a common translation moves all far."""
    matrices = np.empty((poses, len(heads), 4, 4))
    for pose in matrices:
        root = rng.normal(0, 5, 3)
        for matrix, head in zip(pose, heads, strict=True):
            matrix[:] = rotation(0, rng.normal(0, 0.5)) @ rotation(1, rng.normal(0, 0.5))
            matrix[:3, 3] = head + rng.normal(0, 0.1, 3) + root
    return matrices.astype(np.float32)


def random_rig(influences: int, seed: int = 0, origin_distance: float = 0.0) -> Rig:
    """Create a cloud of vertices, `origin_distance` from the origin, skinned to joints at random positions in it."""
    rng = np.random.default_rng(seed)
    heads = rng.uniform(-1, 1, (JOINTS, 3)) + origin_distance
    rest_matrices = np.stack([np.eye(4)] * JOINTS)
    rest_matrices[:, :3, 3] = heads
    skin_joints = np.stack([rng.permutation(JOINTS)[:4] for _ in range(VERTICES)]).astype(np.int32)
    weights = rng.uniform(0.1, 1, (VERTICES, 4))
    weights[:, influences:] = 0
    weights[: VERTICES // 3, 1:] = 0
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    positions = (rng.uniform(-1, 1, (VERTICES, 3)) + origin_distance).astype(np.float32)
    joints = tuple(Joint(str(index), index - 1) for index in range(JOINTS))
    return Rig(joints, positions, rest_matrices.astype(np.float32), skin_joints, weights, Fingerprint("", "", ""))


def with_one_joint(rig: Rig, joints: np.ndarray) -> Rig:
    """Return the rig with each vertex on one joint."""
    weights = np.zeros((rig.vertex_count, 4), np.float32)
    weights[:, 0] = 1
    joint_indices = np.zeros((rig.vertex_count, 4), np.int32)
    joint_indices[:, 0] = joints
    return replace(rig, skin_joints=joint_indices, skin_weights=weights)


def make_fit_poses(rig: Rig, seed: int = 1, noise: float = 0.0, poses: int = POSES) -> FitPoses:
    """Create poses of the rig for a fit that starts with all weights on the first joint."""
    rng = np.random.default_rng(seed)
    matrices = random_poses(rng, rig.rest_matrices[:, :3, 3], poses)
    positions = LinearSkinning(rig).positions(matrices)
    positions += rng.normal(0, 1, positions.shape).astype(np.float32) * np.float32(noise)
    return FitPoses(
        with_one_joint(rig, np.zeros(rig.vertex_count)),
        matrices,
        positions,
        np.zeros((poses, 1), np.float32),
        np.zeros(len(rig.joints), bool),
        np.zeros(len(rig.joints), bool),
    )


def fit_rig(poses: FitPoses, kind: str) -> Rig:
    """Return the rig with the fitted weights."""
    joints, weights = fit_skin(poses, kind)
    return replace(poses.rig, skin_joints=joints, skin_weights=weights)


def dense_weights(rig: Rig) -> np.ndarray:
    """Return the skin weights as a (V, J) array."""
    weights = np.zeros((rig.vertex_count, len(rig.joints)))
    np.add.at(weights, (np.arange(rig.vertex_count)[:, None], rig.skin_joints), rig.skin_weights)
    return weights


def write_fit_folder(folder: Path, poses: FitPoses) -> Path:
    with FitPosesWriter(folder, poses.rig, len(poses.positions)) as writer:
        for matrices, positions in zip(poses.pose_matrices, poses.positions, strict=True):
            writer.append(matrices, positions)
    return folder


@pytest.mark.parametrize(("influences", "origin_distance"), [(2, 0), (4, 0), (4, 1000)])
def test_smooth_weights_are_recovered(influences, origin_distance):
    rig = random_rig(influences, origin_distance=origin_distance)
    assert np.abs(dense_weights(fit_rig(make_fit_poses(rig), "smooth")) - dense_weights(rig)).max() < 1e-3


def test_rigid_weights_are_recovered():
    labels = np.random.default_rng(5).integers(0, JOINTS, VERTICES)
    fitted_rig = fit_rig(make_fit_poses(with_one_joint(random_rig(1), labels), noise=0.01), "hard")
    np.testing.assert_array_equal(fitted_rig.skin_joints[:, 0], labels)
    assert (fitted_rig.skin_weights == [1, 0, 0, 0]).all() and (fitted_rig.skin_joints[:, 1:] == 0).all()


@pytest.mark.parametrize("kind", ["hard", "smooth"])
def test_constraints_hold_for_random_positions(kind):
    rig = fit_rig(make_fit_poses(random_rig(4), noise=0.3), kind)
    assert (rig.skin_weights >= 0).all() and (rig.skin_weights > 0).sum(axis=1).max() <= (1 if kind == "hard" else 4)
    np.testing.assert_allclose(rig.skin_weights.sum(axis=1), 1, atol=1e-6)
    assert (np.diff(rig.skin_weights, axis=1) <= 0).all()
    used = [row[weights > 0] for row, weights in zip(rig.skin_joints, rig.skin_weights, strict=True)]
    assert all(len(set(row)) == len(row) for row in used)


def test_noise_adds_no_joints():
    """Every joint explains a little of the noise, but only the true joint explains enough to get a weight."""
    labels = np.random.default_rng(5).integers(0, JOINTS, VERTICES)
    fitted_rig = fit_rig(make_fit_poses(with_one_joint(random_rig(1), labels), noise=0.05), "smooth")
    assert (fitted_rig.skin_weights > 0).sum(axis=1).mean() < 1.02
    np.testing.assert_array_equal(fitted_rig.skin_joints[:, 0], labels)


def test_five_joints_are_approximated_by_the_best_four():
    """The fit has a smaller error than the four heaviest of the five joints that moved each vertex."""
    rig = random_rig(4)
    rig = replace(
        rig,
        skin_joints=np.pad(rig.skin_joints, ((0, 0), (0, 1)), constant_values=JOINTS - 1),
        skin_weights=np.pad(rig.skin_weights * np.float32(0.9), ((0, 0), (0, 1)), constant_values=0.1),
    )
    poses = make_fit_poses(rig)
    heaviest = replace(rig, skin_joints=rig.skin_joints[:, :4], skin_weights=rig.skin_weights[:, :4] / np.float32(0.9))
    fit_errors = measure(replace(poses, rig=heaviest), fit_rig(poses, "smooth"))
    assert fit_errors.rms_mm["fitted"] < 0.8 * fit_errors.rms_mm["rig"]


def test_simplex_weights_are_optimal():
    """The Karush-Kuhn-Tucker conditions hold: slopes are equal where weights are positive, and larger elsewhere."""
    rng = np.random.default_rng(3)
    factors = rng.normal(size=(50, 6, 8)) + rng.normal(size=(50, 1, 8))
    errors = factors @ factors.transpose(0, 2, 1)
    is_usable = rng.random((50, 6)) < 0.8
    is_usable[:, 0] = True
    weights = simplex_weights(errors, is_usable, 1e-12)
    assert (weights >= 0).all() and (weights[~is_usable] == 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    slopes = np.einsum("vjk,vk->vj", errors, weights)
    min_slopes = (weights * slopes).sum(axis=1, keepdims=True)
    assert (slopes > min_slopes - 1e-9)[is_usable].all()
    np.testing.assert_allclose(slopes[weights > 0], np.broadcast_to(min_slopes, slopes.shape)[weights > 0], atol=1e-9)
    assert ((weights > 0).sum(axis=1) > 1).any() and ((weights == 0) & is_usable).any()


@pytest.mark.parametrize("kind", ["hard", "smooth"])
def test_ties_prefer_the_rig_s_joint_then_the_nearest(kind):
    rig = with_one_joint(random_rig(1), np.full(VERTICES, 2))
    rest_matrices = rig.rest_matrices.copy()
    rest_matrices[:6, :3, 3] = [[0, 0, 9], [0, 0, 8], [0, 0, 7], [0, 0, 0], [0, 9, 0], [0, 8, 0]]
    rig = replace(rig, rest_matrices=rest_matrices)
    poses = make_fit_poses(rig)
    joint_transforms = poses.pose_matrices[:, 2] @ np.linalg.inv(rest_matrices[2])
    poses.pose_matrices[:, :6] = joint_transforms[:, None] @ rest_matrices[:6]
    rig_joints = np.where(np.arange(VERTICES) < VERTICES // 2, 4, JOINTS - 1)
    fitted_rig = fit_rig(replace(poses, rig=with_one_joint(rig, rig_joints)), kind)
    np.testing.assert_array_equal(fitted_rig.skin_joints[:, 0], np.where(rig_joints == 4, 4, 3))
    np.testing.assert_allclose(fitted_rig.skin_weights[:, 0], 1, atol=1e-4)


def test_static_vertices_follow_the_static_joint():
    poses = make_fit_poses(random_rig(4))
    rest_matrices = poses.rig.rest_matrices.copy()
    rest_matrices[7] = np.eye(4)
    poses.pose_matrices[:, 7] = np.eye(4)
    poses.positions[:, :50] = poses.rig.rest_positions[:50]
    fitted_rig = fit_rig(replace(poses, rig=replace(poses.rig, rest_matrices=rest_matrices)), "smooth")
    assert (fitted_rig.skin_joints[:50, 0] == 7).all() and (fitted_rig.skin_weights[:50, 0] > 0.999).all()


@pytest.mark.parametrize("kind", ["hard", "smooth"])
def test_the_process_reports_the_errors(kind, tmp_path, capsys):
    poses = make_fit_poses(random_rig(2), noise=0.002)
    assert main([str(write_fit_folder(tmp_path, poses)), kind]) == 0
    messages = [Message.decode(line) for line in capsys.readouterr().out.splitlines()]
    assert messages[-2].values == {"done": VERTICES, "total": VERTICES}
    fit = SkinFit.from_json(json.loads(json.dumps(messages[-1].values["fit"])))
    assert (messages[-1].type, fit.kind, fit.poses) == (MessageType.FINISHED, kind, POSES)
    for fit_errors in (fit.held_out, fit.training):
        assert fit_errors.rms_mm["fitted"] < 0.8 * fit_errors.rms_mm["rig"]
    joints, weights = read_fitted_weights(tmp_path, poses.rig)
    fitted_skinning = LinearSkinning(replace(poses.rig, skin_joints=joints, skin_weights=weights))
    # Every other pose is held out.
    for fit_errors, pose_slice in ((fit.held_out, slice(1, None, 2)), (fit.training, slice(0, None, 2))):
        distances = np.linalg.norm(
            fitted_skinning.positions(poses.pose_matrices[pose_slice]) - poses.positions[pose_slice], axis=2
        )
        np.testing.assert_allclose(fit_errors.rms_mm["fitted"], 1000 * np.sqrt((distances**2).mean()), rtol=1e-4)
        np.testing.assert_allclose(fit_errors.max_mm["fitted"], 1000 * distances.max(), rtol=1e-4)
    if kind == "smooth":
        # The noise of √3 · 2 mm remains. Held-out poses have a slightly larger error.
        assert 3.3 < fit.training.rms_mm["fitted"] < fit.held_out.rms_mm["fitted"] < 4


def test_a_stopped_fit_writes_nothing(tmp_path):
    folder, stop_file = tmp_path / "poses", tmp_path / "stop"
    folder.mkdir()
    stop_file.touch()
    before = set(write_fit_folder(folder, make_fit_poses(random_rig(2))).iterdir())
    command = [sys.executable, "-m", "trainer.skin", str(folder), "smooth"]
    environment = {**os.environ, STOP_FILE_VARIABLE: str(stop_file)}
    process = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True)
    assert process.returncode == 130 and Message.decode(process.stdout) == Message(MessageType.CANCELLED)
    assert set(folder.iterdir()) == before and not stop_file.exists()


def test_a_missing_scipy_is_named(tmp_path):
    code = (
        "import sys; sys.modules['scipy'] = None; from trainer.skin.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, str(write_fit_folder(tmp_path, make_fit_poses(random_rig(2)))), "smooth"]
    process = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert process.returncode == 1
    message = Message.decode(process.stdout)
    assert message.type is MessageType.FAILED
    assert message.values["text"].startswith("Fitting skin weights needs the Python package 'scipy', which ")
    assert "numpy, scipy and jinja2 there, install the training environment" in message.values["text"]


def damage_cases() -> Iterator:
    def truncate(folder: Path) -> None:
        content = (folder / "positions.npy").read_bytes()
        (folder / "positions.npy").write_bytes(content[:-100])

    def change_array(name: str, change_values) -> None:
        def damage_folder(folder: Path) -> None:
            np.save(folder / f"{name}.npy", change_values(np.load(folder / f"{name}.npy")), allow_pickle=False)

        return damage_folder

    def write_negative_count(folder: Path) -> None:
        (folder / "parents.npy").write_bytes(array_header((-JOINTS,), np.int32) + bytes(100))

    def write_pickle(folder: Path) -> None:
        (folder / "parents.npy").write_bytes(array_header((JOINTS,), object) + b"cbuiltins\nprint\n(Vpoor\ntR.")

    def add_nan(array: np.ndarray) -> np.ndarray:
        array[3, 5, 1] = np.nan
        return array

    yield (
        "missing",
        lambda folder: (folder / "parents.npy").unlink(),
        f"'parents.npy' cannot be read ({systems.NOT_FOUND}",
    )
    yield "truncated", truncate, "'positions.npy' is no array, or truncated"
    yield (
        "no array",
        lambda folder: (folder / "positions.npy").write_bytes(b"\x93NUMPY\x01\x00"),
        "'positions.npy' is no",
    )
    yield "negative", write_negative_count, "'parents.npy' is no array"
    yield "pickled", write_pickle, "'parents.npy' holds something else"
    yield (
        "type",
        change_array("skin_weights", lambda a: a.astype(np.float64)),
        "'skin_weights.npy' holds something else",
    )
    yield "size", change_array("positions", lambda a: a[:, 1:]), "rest_positions has the shape (300, 3)"
    yield "numbers", change_array("positions", add_nan), "positions holds values that are not numbers"
    yield "few", change_array("pose_matrices", lambda a: a[:3]), "positions has the shape (40, 300, 3)"
    yield "joints", change_array("skin_joints", lambda a: a + 99), "the skin weights name no joints"
    yield "parents", change_array("parents", lambda a: a + 1), "a joint comes before its parent"
    yield "flat", change_array("rest_matrices", lambda a: a * 0), "a rest matrix is singular"


DAMAGED_FOLDERS = {name: (damage_folder, expected_text) for name, damage_folder, expected_text in damage_cases()}


@pytest.mark.parametrize("name", DAMAGED_FOLDERS)
def test_a_damaged_folder_is_refused(name, tmp_path, capsys):
    damage_folder, expected_text = DAMAGED_FOLDERS[name]
    damage_folder(write_fit_folder(tmp_path, make_fit_poses(random_rig(2))))
    assert main([str(tmp_path), "smooth"]) == 1
    output = capsys.readouterr()
    text = Message.decode(output.out.splitlines()[-1]).values["text"]
    assert text.startswith(f"The poses in '{tmp_path}' cannot be fitted: {expected_text}") and text.endswith(
        "; record again."
    )
    assert output.err == text + "\n"


def test_too_few_poses_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="they are 4, and a fit takes 10; record again"):
        read_fit_poses(write_fit_folder(tmp_path, make_fit_poses(random_rig(2), poses=4)))


def test_fitted_weights_of_another_rig_are_refused(tmp_path):
    rig = random_rig(2)
    fit_folder(write_fit_folder(tmp_path, make_fit_poses(rig)), "hard", SilentSink())
    with pytest.raises(RecordingError, match=r"the fitted weights have the shapes \(300, 4\) and \(300, 4\)"):
        read_fitted_weights(tmp_path, replace(rig, rest_positions=rig.rest_positions[1:]))
    np.save(tmp_path / "fitted_weights.npy", np.full((VERTICES, 4), -0.25, np.float32))
    with pytest.raises(RecordingError, match="the fitted weights are no weights"):
        read_fitted_weights(tmp_path, rig)
