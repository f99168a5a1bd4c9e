# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged and hostile recordings are refused with one short sentence, and never give wrong data."""

import json
import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.reader import check_resumable, read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .. import systems
from .damage import assert_refused, edit_index, npy_bytes
from .good_recording import good_recording
from .limb import make_rig, random_poses, random_positions, recording_info

FIST_CONTROL = {"owner": "mesh_object", "path": '["fist"]', "low": 0, "high": 1}


def test_a_folder_without_a_recording_is_refused(tmp_path):
    assert_refused(tmp_path, f"'{tmp_path}' is not a recording: it has no recording.json; make one with record.")
    assert_refused(tmp_path / "none", "is not a recording")


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    assert_refused(tmp_path / "file", "is not a recording" if systems.WINDOWS else "cannot be read")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "cannot be read"),
        ("{", "cannot be read"),
        ("\xff", "cannot be read"),
        ("[" * 100_000, "cannot be read"),
        ("[]", "is not the index of a recording"),
        ("null", "is not the index of a recording"),
        ('{"format": "other", "version": 1}', "is not the index of a recording"),
    ],
)
def test_an_invalid_index_is_refused(recording, text, words):
    (recording / "recording.json").write_text(text, encoding="latin-1")
    assert_refused(recording, words)


@pytest.mark.parametrize("version", [1, 0, "2", None])
def test_another_version_is_refused(recording, version):
    edit_index(recording, version=version)
    assert_refused(recording, f"is a recording of version {version!r} and this add-on reads version 2; record again")


BONES = {"dependencies": [], "fixed": [], "controlled": [], "sources": {}, "settings": {}}

ALONE = {"bases": 1, "inputs": [], "keys": [], "undetectable": []}

HASHES = dict.fromkeys(("topology", "rest_positions", "skin_weights"), "a")

MESH_JSON = {"name": "tube", "vertices": 8, "fingerprint": HASHES}

SCALE = np.diag([2.0, 2, 2, 1]).ravel().tolist()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"poses": None}, "poses is None"),
        ({"blender": 5}, "blender is 5"),
        ({"metres_per_unit": 0}, "metres_per_unit is 0"),
        ({"complete": 13}, "its counts contradict each other"),
        ({"meshes": []}, "it has no meshes"),
        ({"meshes": [MESH_JSON, MESH_JSON]}, "two of one name"),
        ({"meshes": [{**MESH_JSON, "vertices": 0}]}, "meshes[0].vertices is 0"),
        ({"meshes": [{**MESH_JSON, "transform": [1.0] * 16}]}, "the transform of the mesh 'tube' is"),
        ({"meshes": [{**MESH_JSON, "transform": SCALE}]}, "first mesh has a transform"),
        ({"joints": []}, "no joints"),
        ({"joints": [{"name": "a", "parent": 0}]}, "the parent of joint 'a' is 0"),
        ({"joints": [{"name": "a", "parent": -1}, {"name": "a", "parent": 0}]}, "two of one name"),
        ({"alone": ALONE | {"inputs": [["joint", 4]]}}, "a moved joint[0] is 4"),
        ({"alone": ALONE | {"inputs": [["bone", 0]]}}, "a moved input is 'bone'"),
        ({"alone": {key: ALONE[key] for key in ("bases", "keys", "undetectable")}}, "alone lacks 'inputs'"),
        ({"alone": ALONE | {"keys": [1]}}, "alone.keys[0] is 1"),
        ({"alone": ALONE}, "poses in which one input moves alone, not [1]"),
        ({"controls": [FIST_CONTROL, FIST_CONTROL]}, "two of its controls have one name"),
        ({"controls": [{**FIST_CONTROL, "owner": "../scene"}]}, "a control belongs to '../scene'"),
        ({"controls": [{**FIST_CONTROL, "path": ""}]}, "is called ''"),
        ({"controls": [{**FIST_CONTROL, "low": 2}]}, "has the range 2.0 to 1.0"),
        ({"faces": 5, "corners": 14}, "5 faces cannot have 14 corners"),
    ],
)
def test_inconsistent_values_are_refused(recording, changes, words):
    edit_index(recording, **changes)
    assert_refused(recording, "recording.json' is damaged: ", words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "is not a recording: it has no bones.json"),
        ("{", "bones.json' cannot be read"),
        ("[]", "bones.json' is damaged"),
        ("{}", "bones.json' is damaged: it lacks 'dependencies'"),
        (json.dumps(BONES | {"dependencies": [4]}), "bones.json' is damaged: dependencies[0] is 4"),
    ],
)
def test_invalid_bones_are_refused(recording, text, words):
    (recording / "bones.json").write_text(text) if text else (recording / "bones.json").unlink()
    assert_refused(recording, words)


@pytest.mark.parametrize(
    "counts",
    [
        *({"poses": 10**15}, {"meshes": [{**MESH_JSON, "vertices": 1 << 61}]}, {"faces": 1 << 58, "corners": 1 << 61}),
    ],
)
def test_counts_larger_than_the_arrays_are_refused(recording, counts):
    edit_index(recording, **counts, **({"complete": counts["poses"]} if "poses" in counts else {}))
    assert_refused(recording, "cannot be used: it holds")


@pytest.mark.parametrize("name", ["positions", "rest_positions"])
def test_a_truncated_array_is_refused(recording, name):
    path = recording / f"{name}.npy"
    path.write_bytes(path.read_bytes()[:-1])
    assert_refused(recording, f"{name}.npy' cannot be used: it is truncated: {path.stat().st_size} of", "record again")


@pytest.mark.parametrize("name", ["skin_weights", "face_starts", "face_vertices"])
def test_a_missing_array_is_refused(recording, name):
    (recording / f"{name}.npy").unlink()
    assert_refused(recording, f"{name}.npy' cannot be used", systems.NOT_FOUND)


@pytest.mark.parametrize(("name", "value"), [("positions", np.nan), ("pose_matrices", -np.inf)])
def test_non_finite_values_are_refused(recording, name, value):
    array = np.load(recording / f"{name}.npy")
    array[11, 3, 1] = value
    np.save(recording / f"{name}.npy", array)
    assert_refused(recording, "holds values that are not numbers", f"({name}, pose 11)", "record again")


@pytest.mark.parametrize(
    ("name", "value"),
    [("skin_weights", np.nan), ("skin_weights", 3.0), ("skin_joints", -1), ("skin_joints", 4)],
)
def test_invalid_weights_are_refused(recording, name, value):
    array = np.load(recording / f"{name}.npy")
    array[5, 0] = value
    np.save(recording / f"{name}.npy", array)
    assert_refused(recording, "The rest pose or skin weights of", "are damaged; record again")


@pytest.mark.parametrize("dtype", [np.float64, ">f4"])
def test_another_dtype_is_refused(recording, dtype):
    array = np.load(recording / "positions.npy")
    np.save(recording / "positions.npy", array.astype(dtype))
    assert_refused(recording, f"positions.npy' cannot be used: it holds {array.shape} {np.dtype(dtype)}, not")


def test_another_shape_or_memory_order_is_refused(recording):
    array = np.load(recording / "positions.npy")
    np.save(recording / "positions.npy", array[:, :, :2])
    assert_refused(recording, f"it holds {(12, 40, 2)} float32, not {array.shape} float32")
    np.save(recording / "positions.npy", np.asfortranarray(array))
    assert_refused(recording, "positions.npy' cannot be used")


INVALID_HEADERS = {
    "empty": "",
    "unclosed": "{'descr': '<f4', 'fortran_order': False, 'shape': (12, 40, 3",
    "nested": "(" * 9000,
    "code": "__import__('os').abort()",
    "no array": b"PK\x03\x04zip",
    "another version": npy_bytes("{}", version=b"\x02\x00"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["positions", "face_vertices"])
@pytest.mark.parametrize("header", INVALID_HEADERS.values(), ids=INVALID_HEADERS.keys())
def test_invalid_array_headers_are_refused(recording, name, header):
    data = header if isinstance(header, bytes) else npy_bytes(header, b"\0" * 5760)
    (recording / f"{name}.npy").write_bytes(data)
    with pytest.raises(RecordingError, match=re.escape(f"{name}.npy' cannot be used: ")):
        read_recording(recording)


@pytest.mark.parametrize(("name", "index", "value"), [("face_starts", 3, 9), ("face_vertices", 7, 40)])
def test_invalid_faces_are_refused(recording, name, index, value):
    array = np.load(recording / f"{name}.npy")
    array[index] = value
    np.save(recording / f"{name}.npy", array)
    assert_refused(recording, f"The faces of '{recording}' are damaged; record again.")


def resume_recording(path, complete=12):
    """Return a writer that resumes the recording of the limb."""
    rig = make_rig()
    return RecordingWriter(path, rig, recording_info(complete), resume=True)


@systems.named_pipes
@pytest.mark.parametrize("name", ["recording.json", "positions.npy"])
def test_a_named_pipe_is_refused(recording, name):
    (recording / name).unlink()
    os.mkfifo(recording / name)
    assert_refused(recording, name, "it is not a regular file")
    with pytest.raises(RecordingError):
        resume_recording(recording)


@systems.symbolic_links
@pytest.mark.parametrize("name", ["recording.json", "positions.npy", "rest_positions.npy"])
def test_a_link_to_another_folder_is_refused(recording, tmp_path, name):
    """A resumed recording would write through links to valid files. All arrays are written if no pose is complete."""
    edit_index(recording, complete=0)
    victim = shutil.move(recording / name, tmp_path / "victim")
    content = victim.read_bytes()
    (recording / name).symlink_to(victim)
    if name == "recording.json":
        for read in (read_recording, resume_recording):
            with pytest.raises(RecordingError, match="it is a link to another place"):
                read(recording)
    else:
        with resume_recording(recording) as writer:
            writer.append(random_poses(12), random_positions(12))
        assert len(read_recording(recording).positions) == 12
    assert victim.read_bytes() == content


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
        ({"sources": [{**POSE_SOURCE, "frames": []}]}, "the frames of a source are not two"),
        ({"overshoot": {"factor": 2, "poses": 10**6, "limits": []}}, "1000000 of its 10 random poses lie"),
        ({"limits": [{"bone": "", "kind": "rotation", "axis": 0, "low": 0, "high": 1}]}, "motion of '' is"),
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
