# SPDX-License-Identifier: GPL-3.0-or-later
"""Recordings made to harm whoever reads, resumes or extends them: one short sentence, before any work."""

import json
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.errors import FDDAError, RecordingError
from fdda_addon.core.recording.extension import RecordingExtension
from fdda_addon.core.recording.folder_check import check_recordable
from fdda_addon.core.recording.reader import check_resumable, read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .. import systems
from .damage import array_file, edit, refused
from .good_recording import good_recording
from .limb import make_rig, partitions_of, random_poses, random_residuals, recording_info

FILES = ("recording.json", "residuals.npy", "pose_matrices.npy", "rest_positions.npy", "skin_weights.npy")
NO_FILE = "it is not a regular file"


@pytest.fixture(autouse=True)
def _patience():
    """What blocks is a failure, not a test that never ends. Windows has no alarm, and nothing here that blocks."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def give_up(*_):
        raise TimeoutError("it blocks")

    previous = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


def resume(path, complete=12):
    rig = make_rig()
    return RecordingWriter(path, rig, partitions_of(rig), recording_info(complete), resume=True)


@systems.named_pipes
@pytest.mark.parametrize("name", FILES)
def test_a_pipe(recording, name):
    (recording / name).unlink()
    os.mkfifo(recording / name)
    refused(recording, name, NO_FILE)
    with pytest.raises(RecordingError):
        resume(recording)


@systems.symbolic_links
@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("target", ["/dev/zero", "/dev/stdin", "/etc/passwd", "another recording"])
def test_a_link_out_of_the_folder(recording, tmp_path, name, target):
    """Even to a good file: what is written into a recording that goes on would land there."""
    if target == "another recording":
        target = shutil.copytree(recording, tmp_path / "other") / name
    (recording / name).unlink()
    (recording / name).symlink_to(target)
    refused(recording, name, "it is a link to another place")
    with pytest.raises(RecordingError):
        check_recordable(recording, resume=True)


@systems.symbolic_links
@pytest.mark.parametrize("name", ["residuals.npy", "rest_positions.npy", "recording.json"])
def test_a_resumed_recording_writes_through_no_link(recording, tmp_path, name):
    """Where no pose is complete all arrays are written anew."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    edit(recording, complete=0)
    if name != "recording.json":
        (recording / name).unlink()
        (recording / name).symlink_to(victim)
        with resume(recording) as writer:
            writer.append(random_poses(12), random_residuals(12))
        assert read_recording(recording).residuals.shape[0] == 12
    else:
        shutil.copy(recording / name, victim)
        text = victim.read_text()
        (recording / name).unlink()
        (recording / name).symlink_to(victim)
        with pytest.raises(RecordingError):
            resume(recording)
        assert victim.read_text() == text
        return
    assert victim.read_text() == "precious"


@systems.symbolic_links
def test_an_extension_writes_through_no_link(recording, tmp_path):
    read = read_recording(recording)
    victim = shutil.move(recording / "residuals.npy", tmp_path / "victim.npy")
    before = (tmp_path / "victim.npy").read_bytes()
    (recording / "residuals.npy").symlink_to(victim)
    with pytest.raises(FDDAError, match="it is a link to another place"):
        RecordingExtension(read, "m.onnx")
    assert (tmp_path / "victim.npy").read_bytes() == before


def flat(matrix):
    matrix[:3, 1] = 0


def sheared(matrix):
    matrix[:3, 1] = matrix[:3, 0]


def no_transform(matrix):
    matrix[3] = 0


@pytest.mark.parametrize("damage", [flat, sheared, no_transform])
def test_joints_that_have_shrunk_to_nothing(recording, damage):
    array = np.load(recording / "pose_matrices.npy")
    damage(array[7, 2])
    np.save(recording / "pose_matrices.npy", array)
    refused(recording, "holds joints that have shrunk to nothing (pose_matrices, pose 7); record again.")
    with pytest.raises(RecordingError, match="shrunk to nothing"):
        check_resumable(recording)
    rest = np.load(recording / "rest_matrices.npy")
    damage(rest[2])
    np.save(recording / "rest_matrices.npy", rest)
    refused(recording, "The rest pose or skin weights of")


@pytest.mark.parametrize("name", ["residuals", "pose_matrices", "rest_positions", "rest_matrices"])
def test_numbers_that_overflow(recording, name):
    array = np.load(recording / f"{name}.npy")
    array.reshape(-1)[3] = 1e30
    np.save(recording / f"{name}.npy", array)
    refused(recording, "beyond all bounds" if name in ("residuals", "pose_matrices") else "rest pose")


def test_what_no_training_takes_is_not_recorded(tmp_path):
    """Or hours of recording would be refused afterwards."""
    recording = good_recording(4)
    matrices = recording.pose_matrices.copy()
    matrices[2, 1, :3, 0] = 0
    writer = RecordingWriter(tmp_path / "r", recording.rig, recording.partitions, replace(recording.info, complete=0))
    with writer, pytest.raises(RecordingError, match="Pose 2 of the rig evaluates to joints that have shrunk to noth"):
        writer.append(matrices, recording.residuals, recording.controls)


LIMIT = {"bone": "upper", "kind": "rotation", "axis": 0, "low": -1.0, "high": 1.0}
SOURCE = {"kind": "random", "poses": 12, "name": "", "frames": [0, 0]}
MARGIN = {"factor": 2.0, "poses": 3, "limits": [LIMIT]}
HASHES = {"topology": "a", "rest_positions": "b", "skin_weights": "c"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *[(("limits", [{**LIMIT, key: value}]), "its range of motion") for key, value in (
            ("low", float("-inf")), ("high", float("nan")), ("high", "1"), ("low", 2), ("axis", 3), ("axis", True),
            ("kind", "twist"), ("bone", 7), ("bone", ""), ("bone", "b" * 5000), ("low", None),
        )],
        (("limits", {}), "not a list"),
        (("limits", [{"bone": "upper"}]), "is damaged"),
        (("limits", [[]]), "is damaged"),
        (("seed", -1), "its seed is -1"),
        (("seed", True), "its seed is True"),
        (("spread", 0), "its spread is 0"),
        (("spread", float("inf")), "its spread is inf"),
        *[(("sources", [{**SOURCE, key: value}]), words) for key, value, words in (
            ("kind", "stolen", "of the kind 'stolen'"), ("kind", [], "of the kind []"), ("poses", -1, "-1 poses"),
            ("name", 5, "5 is not a name"), ("frames", [1], "has the frames (1,)"),
            ("frames", [0, "x"], "has the frames (0, 'x')"), ("name", "n" * 5000, "a name has 5000 characters"),
        )],
        *[(("margin", {**MARGIN, key: value}), words) for key, value, words in (
            ("factor", 1, "its margin is 1 times"), ("factor", 99, "its margin is 99 times"),
            ("factor", True, "True times"),
            ("factor", float("nan"), "nan times"), ("factor", "2", "'2' times"),
            ("poses", -1, "its margin has -1 poses"),
            ("poses", 1.5, "has 1.5 poses"), ("poses", 10**6, "1000000 of its"), ("limits", {}, "are not a list"),
            ("limits", [{**LIMIT, "axis": 7}], "its range of motion"),
        )],
        *[(("margin", value), "is damaged") for value in ([], None, 2, {}, {"factor": 2.0})],
        (("units", {"length": float("nan")}), "it holds NaN, which is no number"),
    ],
)  # fmt: skip
def test_a_sampling_that_is_none(recording, change, words):
    """Each was found only when the model was written, after the training."""
    key, value = change
    index = json.loads((recording / "recording.json").read_text())
    if key == "units":
        edit(recording, units=value)
    else:
        edit(recording, sampling={**index["sampling"], key: value})
    refused(recording, "recording.json' is damaged: ", words)


@pytest.mark.parametrize("name", [7, None, [], {}, True, "n" * 5000])
def test_a_joint_without_a_name(recording, name):
    index = json.loads((recording / "recording.json").read_text())
    index["joints"][1]["name"] = name
    edit(recording, joints=index["joints"])
    refused(recording, "recording.json' is damaged: ", "name")


@pytest.mark.parametrize(
    "fingerprint",
    [{}, [], {**HASHES, "topology": 7}, {**HASHES, "skin_weights": None}, {**HASHES, "topology": "a" * 10**6}],
)
def test_a_fingerprint_that_is_none(recording, fingerprint):
    index = json.loads((recording / "recording.json").read_text())
    edit(recording, rig={**index["rig"], "fingerprint": fingerprint})
    refused(recording, "recording.json' is damaged: ")


def test_sentences_are_of_a_readable_length_and_steer_no_terminal(recording):
    edit(recording, version="\x1b[2J\n" + "x" * 10**6)
    with pytest.raises(RecordingError) as error:
        read_recording(recording)
    text = str(error.value)
    assert len(text) < 1200 and "\x1b" not in text and "\n" not in text
    assert "\\x1b[2J" in text and text.endswith("this add-on reads version 1; record again.")


@systems.sparse_files
def test_a_recording_that_is_huge_and_hollow_takes_no_memory(recording):
    """Sparse files cost nothing to make: 100 GB of skin weights that are none."""
    vertices = 1 << 31
    edit(recording, vertices=vertices)
    for name, shape, kind in (
        ("rest_positions", (vertices, 3), "<f4"),
        ("skin_joints", (vertices, 4), "<i4"),
        ("skin_weights", (vertices, 4), "<f4"),
        ("residuals", (12, vertices, 3), "<f4"),
    ):
        header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n"
        path = recording / f"{name}.npy"
        path.write_bytes(array_file(header))
        os.truncate(path, path.stat().st_size + 4 * int(np.prod(shape, dtype=object)))
    refused(recording, "The rest pose or skin weights of")


def test_a_good_recording_passes(recording):
    check_resumable(recording)
    check_recordable(recording, resume=True)
    with pytest.raises(RecordingError, match="holds a recording already"):
        check_recordable(recording, resume=False)
