# SPDX-License-Identifier: GPL-3.0-or-later
"""Fitted skin weights are read back unchanged from recordings and models; damaged ones are refused."""

import base64
import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.errors import ModelError, OutputError, RecordingError
from fdda_addon.core.formats.model import SKIN_KEY, read_model, read_skin
from fdda_addon.core.mathematics.skin_fit import FitReport, SkinFit, skin_from_text, skin_to_text
from fdda_addon.core.recording.fit_folder import FitPosesWriter, read_fit_poses
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .damage import assert_refused, edit_index
from .limb import make_rig, partitions_of, random_poses, random_residuals, recording_info
from .tiny_model import JOINT_COUNT, VERTEX_COUNT, tiny_info, tiny_model

FIT = SkinFit(
    "smooth",
    25,
    FitReport({"rig": 4.25, "fitted": 1.5}, {"rig": 40.0, "fitted": 21.25}),
    FitReport({"rig": 4.0, "fitted": 1.25}, {"rig": 39.0, "fitted": 20.0}),
)
SKIN_JOINTS = np.array([[0, 2, 0, 0], [1, 0, 0, 0], [2, 1, 0, 0], [0, 1, 2, 0]], np.int32)
SKIN_WEIGHTS = np.array([[0.75, 0.25, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [0.5, 0.3, 0.2, 0]], np.float32)


def test_sentence_about_a_fit():
    assert FIT.sentence() == (
        "Linear skinning with fitted weights (smooth), mm: 1.50 rms and 21.2 max on 12 held-out poses, 4.25 rms and "
        "40.0 max with the rig's own weights; 1.25 rms and 20.0 max on the 13 poses of the fit, 4.00 rms and 39.0 max "
        "with the rig's own."
    )


@pytest.fixture
def fitted_recording(tmp_path):
    """Folder of a recording of the limb whose index contains `FIT`."""
    rig, count = make_rig(), 12
    info = replace(recording_info(count), fit=FIT)
    with RecordingWriter(tmp_path / "limb", rig, partitions_of(rig), info) as writer:
        writer.append(random_poses(count), random_residuals(count))
    return tmp_path / "limb"


def test_recording_index_contains_the_fit(fitted_recording):
    fit = json.loads((fitted_recording / "recording.json").read_text())["fit"]
    assert fit["rms_mm"] == {"rig": 4.25, "fitted": 1.5} and (fit["kind"], fit["poses"]) == ("smooth", 25)
    assert fit["training"]["max_mm"] == {"rig": 39.0, "fitted": 20.0}
    assert read_recording(fitted_recording).info.fit == FIT


def test_recording_without_fitted_weights_has_no_fit(recording):
    assert "fit" not in json.loads((recording / "recording.json").read_text())
    assert read_recording(recording).info.fit is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kind": "soft"}, "skin weights were fitted 'soft' to 25 poses"),
        ({"poses": True}, "skin weights were fitted 'smooth' to True poses"),
        ({"rms_mm": {"rig": 1.0}}, "it lacks 'fitted'"),
        ({"max_mm": {"rig": float("nan"), "fitted": 1.0}}, "the errors of a fit are not numbers"),
        ({"training": None}, "is damaged"),
    ],
)
def test_a_damaged_fit_is_refused(fitted_recording, changes, words):
    edit_index(fitted_recording, fit={**FIT.to_json(), **changes})
    assert_refused(fitted_recording, "recording.json' is damaged", words)


def test_weights_are_decoded_unchanged_from_text():
    joints, weights = skin_from_text(skin_to_text(SKIN_JOINTS, SKIN_WEIGHTS), VERTEX_COUNT, JOINT_COUNT)
    np.testing.assert_array_equal(joints, SKIN_JOINTS)
    np.testing.assert_array_equal(weights, SKIN_WEIGHTS)
    assert (joints.dtype, weights.dtype) == (np.int32, np.float32)


def changed_skin_text(**changes) -> str:
    """Return the text of the skin weights with changed JSON keys."""
    return json.dumps({**json.loads(skin_to_text(SKIN_JOINTS, SKIN_WEIGHTS)), **changes})


def base64_of_array(array: np.ndarray) -> str:
    """Encode the bytes of an array as the metadata of a model does."""
    return base64.b64encode(array.tobytes()).decode()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "its skin weights cannot be read"),
        ("[" * 100_000, "its skin weights cannot be read"),
        ("[3]", "its skin weights cannot be read"),
        ("{}", "its skin weights cannot be read ('influences')"),
        (changed_skin_text(joints=None), "its skin weights cannot be read"),
        (changed_skin_text(joints="!" * 88), "its skin weights cannot be read"),
        (changed_skin_text(influences=0), "its skin weights are damaged: they have 0 joints per vertex"),
        (changed_skin_text(influences=10**9), "they have 1000000000 joints per vertex"),
        (changed_skin_text(influences=5), f"they are not for {VERTEX_COUNT} vertices"),
        (changed_skin_text(weights="AAAA"), f"they are not for {VERTEX_COUNT} vertices"),
        (changed_skin_text(joints=base64_of_array(SKIN_JOINTS + 1)), "its skin weights are no weights of its joints"),
        (changed_skin_text(joints=base64_of_array(SKIN_JOINTS - 1)), "its skin weights are no weights of its joints"),
        (changed_skin_text(weights=base64_of_array(SKIN_WEIGHTS * 2)), "its skin weights are no weights of its joints"),
        (
            changed_skin_text(weights=base64_of_array(SKIN_WEIGHTS * np.float32("nan"))),
            "its skin weights are no weights of its joints",
        ),
    ],
)
def test_damaged_weights_of_a_model_are_refused(tmp_path, text, words):
    model = tiny_model()
    model.metadata_props.add(key=SKIN_KEY, value=text)
    path = tmp_path / "m.onnx"
    path.write_bytes(model.SerializeToString())
    info, data = read_model(path)
    with pytest.raises(ModelError) as error:
        read_skin(data, info, path)
    assert str(error.value).startswith(f"The model '{path}' cannot be used: its skin weights ")
    assert words in str(error.value) and str(error.value).endswith("; train it again.")


def test_skin_weights_are_read_from_a_model():
    model = tiny_model()
    assert read_skin(model.SerializeToString(), tiny_info(), "m") is None
    model.metadata_props.add(key=SKIN_KEY, value=skin_to_text(SKIN_JOINTS, SKIN_WEIGHTS))
    joints, weights = read_skin(model.SerializeToString(), tiny_info(), "m")
    assert (joints == SKIN_JOINTS).all() and (weights == SKIN_WEIGHTS).all()


def test_fit_poses_are_read_back_unchanged(tmp_path):
    rig, poses = make_rig(), random_poses(12)
    positions = np.random.default_rng(0).normal(size=(12, rig.vertex_count, 3)).astype(np.float32)
    with FitPosesWriter(tmp_path, rig, 12) as writer:
        for pose, pose_positions in zip(poses, positions, strict=True):
            writer.append(pose, pose_positions)
    read_back = read_fit_poses(tmp_path)
    np.testing.assert_array_equal(read_back.pose_matrices, poses)
    np.testing.assert_array_equal(read_back.positions, positions)
    for name in ("rest_positions", "rest_matrices", "skin_joints", "skin_weights", "parents"):
        np.testing.assert_array_equal(getattr(read_back.rig, name), getattr(rig, name))


def test_non_finite_fit_poses_are_refused(tmp_path):
    rig = make_rig()
    positions = np.full((rig.vertex_count, 3), np.nan, np.float32)
    with FitPosesWriter(tmp_path, rig, 12) as writer, pytest.raises(RecordingError, match=r"Pose 0 .* not numbers"):
        writer.append(random_poses(1)[0], positions)


@pytest.mark.skipif(sys.platform != "linux", reason="Only Linux has /dev/full, which behaves like a full disk.")
def test_full_disk_is_reported(tmp_path):
    (tmp_path / "positions.npy").symlink_to("/dev/full")
    rig = make_rig()
    with (
        pytest.raises(
            OutputError, match=r"Cannot write the poses to fit into '.*': No space left on device; make room"
        ),
        FitPosesWriter(tmp_path, rig, 12) as writer,
    ):
        for pose in random_poses(12):
            writer.append(pose, np.zeros((rig.vertex_count, 3), np.float32))
