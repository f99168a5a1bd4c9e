# SPDX-License-Identifier: GPL-3.0-or-later
"""Recordings with damaged faces are refused; recordings without faces are read."""

import json

import numpy as np
import pytest

from fdda_addon.core.recording.reader import read_recording

from .damage import assert_refused, edit_index


def test_a_recording_without_faces_is_read(recording):
    index = json.loads((recording / "recording.json").read_text())
    del index["faces"], index["corners"]
    (recording / "recording.json").write_text(json.dumps(index))
    rig = read_recording(recording).rig
    assert rig.face_starts.shape == rig.face_vertices.shape == (0,)


@pytest.mark.parametrize("key", ["faces", "corners"])
@pytest.mark.parametrize("value", [None, "x", -1, 1.5, True, [1], {"a": 1}, float("inf")])
def test_an_invalid_face_count_is_refused(recording, key, value):
    edit_index(recording, **{key: value})
    assert_refused(recording, f"recording.json' is damaged: '{key}' is {value!r}; record again")


@pytest.mark.parametrize("counts", [{"faces": 5, "corners": 14}, {"faces": 1 << 62}, {"corners": 0}])
def test_a_corner_count_that_contradicts_the_face_count_is_refused(recording, counts):
    index = edit_index(recording, **counts)
    assert_refused(recording, f"damaged: {index['faces']} faces cannot have {index['corners']} corners; record again")


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("face_starts", 0, 1),
        ("face_starts", 3, 0),
        ("face_starts", 3, -(1 << 31)),
        ("face_starts", -1, 1 << 30),
        ("face_starts", 3, 9),
        ("face_vertices", 7, -1),
        ("face_vertices", 7, 40),
        ("face_vertices", -1, (1 << 31) - 1),
    ],
)
def test_invalid_faces_are_refused(recording, name, index, value):
    array = np.load(recording / f"{name}.npy")
    array[index] = value
    np.save(recording / f"{name}.npy", array)
    assert_refused(recording, f"The faces of '{recording}' are damaged; record again.")
