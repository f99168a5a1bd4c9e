# SPDX-License-Identifier: GPL-3.0-or-later
"""Recordings that would harm the process that reads, resumes or extends them are refused in one short sentence."""

import json
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.folder import check_recordable
from fdda_addon.core.recording.reader import check_resumable, read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .. import systems
from .damage import assert_refused, edit_index, npy_bytes
from .good_recording import good_recording
from .limb import make_rig, random_poses, random_positions, recording_info

RECORDING_FILES = ("recording.json", "positions.npy", "pose_matrices.npy", "rest_positions.npy", "skin_weights.npy")
NOT_REGULAR_FILE_ERROR = "it is not a regular file"


@pytest.fixture(autouse=True)
def _time_limit():
    """Fail a test that blocks for 20 seconds. Windows has no alarm signal, and no test blocks there."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def fail_test(*_):
        raise TimeoutError("The test blocks.")

    previous_handler = signal.signal(signal.SIGALRM, fail_test)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous_handler)


def resume_recording(path, complete=12):
    """Return a writer that resumes the recording of the limb."""
    rig = make_rig()
    return RecordingWriter(path, rig, recording_info(complete), resume=True)


@systems.named_pipes
@pytest.mark.parametrize("name", RECORDING_FILES)
def test_a_named_pipe_is_refused(recording, name):
    (recording / name).unlink()
    os.mkfifo(recording / name)
    assert_refused(recording, name, NOT_REGULAR_FILE_ERROR)
    with pytest.raises(RecordingError):
        resume_recording(recording)


@systems.symbolic_links
@pytest.mark.parametrize("name", RECORDING_FILES)
@pytest.mark.parametrize("target", ["/dev/zero", "another recording"])
def test_a_link_to_another_folder_is_refused(recording, tmp_path, name, target):
    """Links to valid files are refused too, because a resumed recording would write through them."""
    if target == "another recording":
        target = shutil.copytree(recording, tmp_path / "other") / name
    (recording / name).unlink()
    (recording / name).symlink_to(target)
    assert_refused(recording, name, "it is a link to another place")
    with pytest.raises(RecordingError):
        check_recordable(recording, resume=True)


@systems.symbolic_links
@pytest.mark.parametrize("name", ["positions.npy", "rest_positions.npy", "recording.json"])
def test_resuming_does_not_write_through_links(recording, tmp_path, name):
    """All arrays are written again if no pose is complete."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    edit_index(recording, complete=0)
    if name != "recording.json":
        (recording / name).unlink()
        (recording / name).symlink_to(victim)
        with resume_recording(recording) as writer:
            writer.append(random_poses(12), random_positions(12))
        assert read_recording(recording).positions.shape[0] == 12
    else:
        shutil.copy(recording / name, victim)
        text = victim.read_text()
        (recording / name).unlink()
        (recording / name).symlink_to(victim)
        with pytest.raises(RecordingError):
            resume_recording(recording)
        assert victim.read_text() == text
        return
    assert victim.read_text() == "precious"


def flatten_axis(matrix):
    """Set the Y axis of a matrix to zero."""
    matrix[:3, 1] = 0


def clear_last_row(matrix):
    """Set the last row to zero, so that the matrix is not a transform."""
    matrix[3] = 0


@pytest.mark.parametrize("damage", [flatten_axis, clear_last_row])
def test_degenerate_joint_matrices_are_refused(recording, damage):
    array = np.load(recording / "pose_matrices.npy")
    damage(array[7, 2])
    np.save(recording / "pose_matrices.npy", array)
    assert_refused(recording, "holds joints that have shrunk to nothing (pose_matrices, pose 7); record again.")
    with pytest.raises(RecordingError, match="shrunk to nothing"):
        check_resumable(recording)
    rest_matrices = np.load(recording / "rest_matrices.npy")
    damage(rest_matrices[2])
    np.save(recording / "rest_matrices.npy", rest_matrices)
    assert_refused(recording, "The rest pose or skin weights of")


@pytest.mark.parametrize("name", ["positions", "pose_matrices", "rest_positions", "rest_matrices"])
def test_huge_numbers_are_refused(recording, name):
    array = np.load(recording / f"{name}.npy")
    array.reshape(-1)[3] = 1e30
    np.save(recording / f"{name}.npy", array)
    assert_refused(recording, "beyond all bounds" if name in ("positions", "pose_matrices") else "rest pose")


def test_poses_that_training_refuses_are_not_recorded(tmp_path):
    """Otherwise, training would refuse the recording only after hours of work."""
    recording = good_recording(4)
    matrices = recording.pose_matrices.copy()
    matrices[2, 1, :3, 0] = 0
    writer = RecordingWriter(tmp_path / "r", recording.rig, replace(recording.info, complete=0))
    with writer, pytest.raises(RecordingError, match="has a scale of zero in pose 2; look for"):
        writer.append(matrices, recording.residuals, recording.controls)


POSE_SOURCE = {"kind": "random", "poses": 12, "name": "", "frames": [0, 0]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"limits": [{"bone": "upper", "kind": "rotation", "axis": 0, "low": 2, "high": 1}]}, "motion of 'upper' is 2"),
        ({"limits": [{"bone": "upper", "kind": "twist", "axis": 0, "low": 0, "high": 1}]}, "motion.kind is 'twist'"),
        ({"seed": -1}, "sampling.seed is -1"),
        ({"spread": float("inf")}, "sampling.spread is inf"),
        ({"sources": [{**POSE_SOURCE, "kind": "stolen"}]}, "sampling.sources[0].kind is 'stolen'"),
        ({"overshoot": {"factor": 99, "poses": 3, "limits": []}}, "its overshoot.factor is 99"),
    ],
)
def test_an_invalid_sampling_is_refused(recording, changes, words):
    """Without this check, these errors would appear only after training, when the model is written."""
    index = json.loads((recording / "recording.json").read_text())
    edit_index(recording, sampling={**index["sampling"], **changes})
    assert_refused(recording, "recording.json' is damaged: ", words)


def test_messages_are_short_and_escape_control_characters(recording):
    edit_index(recording, version="\x1b[2J\n" + "x" * 10**6)
    with pytest.raises(RecordingError) as error:
        read_recording(recording)
    text = str(error.value)
    assert len(text) < 1200 and "\x1b" not in text and "\n" not in text
    assert "\\x1b[2J" in text and text.endswith("this add-on reads version 2; record again.")


@systems.sparse_files
def test_a_huge_sparse_recording_is_refused_without_reading_it(recording):
    """A sparse file of 100 GB takes no space on the disk: here skin weights, which would not fit into memory."""
    vertices = 1 << 31
    mesh = json.loads((recording / "recording.json").read_text())["meshes"][0]
    edit_index(recording, meshes=[{**mesh, "vertices": vertices}])
    for name, shape, kind in (
        ("rest_positions", (vertices, 3), "<f4"),
        ("skin_joints", (vertices, 4), "<i4"),
        ("skin_weights", (vertices, 4), "<f4"),
        ("positions", (12, vertices, 3), "<f4"),
    ):
        header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n"
        path = recording / f"{name}.npy"
        path.write_bytes(npy_bytes(header))
        os.truncate(path, path.stat().st_size + 4 * int(np.prod(shape, dtype=object)))
    assert_refused(recording, "The rest pose or skin weights of")
