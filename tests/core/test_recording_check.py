# SPDX-License-Identifier: GPL-3.0-or-later
"""Each warning is found in a recording that was spoilt for it, and in no other."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.checks import residual_scan
from fdda_addon.core.checks.recording import WARNING_NAMES, check_recording, compute_bone_lengths, merges_sentence
from fdda_addon.core.checks.warning import RecordingWarning, format_length, format_list, format_with_noun
from fdda_addon.core.partition import make_partitions
from fdda_addon.core.recording.index import Source
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import STATIC_JOINT

from .good_recording import (
    BONE,
    JOINTS,
    LIMIT,
    good_recording,
    only,
    turns,
    warned,
    with_rig,
)

CHECKS = Path(__file__).resolve().parents[2] / "docs" / "formats.md"


def enlarged(recording: Recording, factor: float) -> Recording:
    """The same character, so many times as large."""
    rest, poses = recording.rig.rest_matrices.copy(), recording.pose_matrices.copy()
    for matrices in (rest, poses):
        matrices[..., :3, 3] *= factor
    scaled = with_rig(recording, rest_matrices=rest, rest_positions=recording.rig.rest_positions * factor)
    return replace(scaled, pose_matrices=poses, residuals=recording.residuals * factor)


def with_sources(recording: Recording, *sources: Source) -> Recording:
    sampling = replace(recording.info.sampling, sources=sources)
    return replace(recording, info=replace(recording.info, sampling=sampling))


@pytest.mark.parametrize("seed", range(5))
def test_a_good_recording_has_no_warnings(seed):
    assert check_recording(good_recording(seed=seed)) == []
    assert check_recording(good_recording(poses=12, seed=seed)) == []


def test_a_mesh_in_another_unit(good):
    rig = good.rig
    text = only(with_rig(good, rest_positions=rig.rest_positions * 20), "units")
    assert text.startswith(
        "The 4 joints that skin the mesh lie 750 mm apart and their vertices 15.3 m, 20.5 times as far"
    )
    small = good.pose_matrices.copy()
    small[:, :, :3, 3] *= 0.01
    rest = rig.rest_matrices.copy()
    rest[:, :3, 3] *= 0.01
    assert "102 times as far" in only(with_rig(replace(good, pose_matrices=small), rest_matrices=rest), "units")


@pytest.mark.parametrize(("factor", "size"), [(200.0, "198 m"), (0.002, "2 mm")])
def test_a_character_in_another_unit(good, factor, size):
    text = only(enlarged(good, factor), "units")
    assert text.startswith(f"The mesh is {size} large, so errors and tolerances in mm mean little: set the unit scale")


@pytest.mark.parametrize("factor", [100.0, 200.0, 0.002])
def test_a_character_of_its_true_size_in_another_unit(good, factor):
    """Nothing is said of one built in centimetres where the scene or the object says that it is."""
    assert check_recording(with_rig(enlarged(good, factor), metres_per_unit=1 / factor)) == []


def test_a_character_of_another_size_in_its_unit(good):
    text = only(with_rig(enlarged(good, 20_000.0), metres_per_unit=0.01), "units")
    assert text.startswith("The mesh is 198 m large, ")


@pytest.mark.parametrize(("axis", "angle"), [(0, 90), (0, -90), (1, 90), (1, -90), (0, 180)])
def test_a_mesh_on_other_axes(good, axis, angle):
    turn = turns(np.radians(np.array(angle)), axis)[:3, :3]
    text = only(with_rig(good, rest_positions=(good.rig.rest_positions @ turn.T).astype(np.float32)), "axes")
    # About which of two axes the tube is turned upside down cannot be told.
    shown = f"{angle} degrees about {'[XY]' if angle == 180 else 'XYZ'[axis]}"
    assert re.search(f"of the 4 joints that skin the mesh lie outside its bounds.* fit after a turn of {shown}:", text)


def test_a_mesh_elsewhere(good):
    moved = good.rig.rest_positions + np.array([0, -0.8, 0], np.float32)
    text = only(with_rig(good, rest_positions=moved), "axes")
    assert text.startswith(
        "4 of the 4 joints that skin the mesh lie outside its bounds, and joints lie 753 mm from the nearest vertex "
        "that follows them (median), most of it along -Y: "
    )


def test_joints_that_skin_nothing_may_lie_anywhere(good):
    rest = good.rig.rest_matrices.copy()
    rest[0, :3, 3] = 0, 0, -0.4
    # The root skins nothing but carries the others.
    skin_joints = np.maximum(good.rig.skin_joints, 1)
    changed = with_rig(good, rest_matrices=rest, skin_joints=skin_joints)
    assert "axes" not in warned(replace(changed, partitions=make_partitions(changed.rig)))


def test_residuals_larger_than_bones(good):
    residuals = good.residuals.copy()
    vertices = good.partitions[2].vertices
    residuals[:, vertices] += 0.4
    text = only(replace(good, residuals=residuals), "large-residuals")
    assert text.startswith(
        "Residuals are larger than bones and vertices of 1 of 4 partitions, most of 'lower', 696 mm rms where bone and "
        "vertices are 254 mm long: "
    )
    assert text.endswith("or record with --fit-linear smooth.")


def test_one_vertex_far_away_in_one_pose(good):
    good.residuals[17, 33] = 3, 4, 0
    text = warned(good)["large-residuals"]
    assert text.startswith("The residual of vertex 33 is 5 m in pose 17, and the character is 990 mm large: ")


def test_poses_that_repeat(good):
    for array in (good.pose_matrices, good.controls, good.residuals):
        array[150:190] = array[150]
    text = only(with_sources(good, Source("random", 120), Source("action", 80, "idle", (1, 1))), "duplicate-poses")
    assert text.startswith(
        "39 of 200 poses repeat an earlier one, such as pose 151 pose 150, 39 of them of the action 'idle': "
    )
    good.controls[150:190, 0] = np.linspace(0, 1, 40)
    assert "duplicate-poses" not in warned(good)


def test_a_few_poses_may_repeat(good):
    for array in (good.pose_matrices, good.controls, good.residuals):
        array[190:] = array[:10]
    assert warned(good) == {}


def test_equal_poses_with_other_residuals(good):
    for array in (good.pose_matrices, good.controls, good.residuals):
        array[190:193] = array[10:13]
    good.residuals[191, 5:9, 2] += 0.012
    text = only(good, "hidden-inputs")
    assert text.startswith(
        "Poses 11 and 191 have the same joints and controls and yet vertices lie up to 12 mm apart: "
    )


def test_vertices_that_never_move(good):
    angles = np.random.default_rng(0).uniform(-LIMIT, LIMIT, (200, len(JOINTS)))
    angles[:, 0] = 0
    locked = good_recording(angles=angles)
    locked.residuals[:, locked.rig.rest_positions[:, 2] < 0.3 * BONE] = 0
    count = int((locked.rig.rest_positions[:, 2] < 0.3 * BONE).sum())
    text = only(locked, "still-vertices")
    assert text.startswith(f"{count} of 240 vertices never move, of the partition 'root': if they should, weight them")
    locked.residuals[100, :, 0] += 0.001
    assert warned(locked) == {}


def test_small_partitions(good):
    skin_joints, skin_weights = good.rig.skin_joints.copy(), good.rig.skin_weights.copy()
    tip = good.rig.rest_positions[:, 2].argsort()[-5:]
    own = skin_joints[:, 1] == 3
    skin_joints[own], skin_weights[own] = 2, (0.5, 0.5)
    skin_joints[tip], skin_weights[tip] = 3, (0.5, 0.5)
    small = with_rig(good, skin_joints=skin_joints, skin_weights=skin_weights)
    partitions = make_partitions(small.rig, {3: (3,)}, dict.fromkeys(range(4), (0,)))
    text = only(replace(small, partitions=partitions), "small-partitions")
    assert text.startswith("The partition 'hand' has fewer than 8 vertices (the smallest 5), and a network each: ")
    partitions = make_partitions(small.rig, None, dict.fromkeys(range(4), (0,)), merged={3: 2})
    assert warned(replace(small, partitions=partitions)) == {}


def test_merges_in_words():
    joints = [{"name": name} for name in ("root", "a", "b", STATIC_JOINT, *map(str, range(20)))]
    none = {"joints": joints, "partitions": [{"joint": 0}]}
    assert merges_sentence(none, 8) == ""
    few = {"joints": joints, "partitions": [{"joint": 0, "merged": [2, 3]}, {"joint": 1}]}
    assert merges_sentence(few, 8) == (
        "2 partitions of fewer than 8 vertices are merged: 'b' into 'root', 'no bone' into 'root'."
    )
    many = {"joints": joints, "partitions": [{"joint": 0, "merged": list(range(4, 20))}]}
    assert merges_sentence(many, 5).endswith("'8' into 'root', '9' into 'root' and 6 more.")


def test_the_length_of_bones(good):
    assert compute_bone_lengths(good.rig) == pytest.approx([BONE] * 4)


def test_no_more_poses_are_read_than_are_needed(good, monkeypatch):
    monkeypatch.setattr(residual_scan, "MAX_SCANNED_POSES", 50)
    monkeypatch.setattr(residual_scan, "MAX_KEPT_VERTICES", 40)
    scan = residual_scan.scan_residuals(good)
    assert len(scan.poses) == 50 and (scan.poses[0], scan.poses[-1]) == (0, 199)
    assert all(len(r) == 50 and 8 <= r.shape[1] <= 10 for r in scan.residuals)
    for own, partition in zip(scan.vertices, good.partitions, strict=True):
        assert set(own) <= set(partition.vertices)
    lengths = np.linalg.norm(good.residuals[scan.poses], axis=2)
    np.testing.assert_allclose(scan.rms, np.sqrt((lengths**2).mean(axis=0)), rtol=1e-5)
    np.testing.assert_allclose(scan.largest, lengths.max(axis=0), rtol=1e-5)
    apart = np.linalg.norm(good.residuals[scan.poses] - good.residuals[0], axis=2)
    np.testing.assert_allclose(scan.change, apart.max(axis=0), rtol=1e-4, atol=1e-9)
    vertex = int(lengths.max(axis=0).argmax())
    assert scan.largest_pose[vertex] == scan.poses[lengths[:, vertex].argmax()]


def test_warnings_are_sentences():
    warning = RecordingWarning("flips", "It jumps; limit it.")
    assert str(warning) == "Warning (flips): It jumps; limit it."
    assert warning.to_json() == {"name": "flips", "text": "It jumps; limit it."}
    assert (
        format_list(["a"]) == "'a'"
        and format_list(["a", "b"]) == "'a' and 'b'"
        and format_list([1, 2, 3, 4, 5]) == "1, 2, 3 and 2 more"
    )
    assert (
        format_with_noun([3], "pose") == "the pose 3"
        and format_with_noun(["a", "b"], "joint") == "the 2 joints 'a' and 'b'"
    )


def test_lengths_are_metres_in_any_unit(good):
    words = ["0.04 mm", "87 mm", "250 mm", "1.23 m"]
    for metres in (1.0, 0.01):
        rig = with_rig(good, metres_per_unit=metres).rig
        assert [format_length(rig, m / metres) for m in (0.00004, 0.0871, 0.25, 1.234)] == words


def test_every_warning_is_documented():
    headings = re.findall(r"^#### `(.+)`$", CHECKS.read_text(encoding="utf-8"), re.MULTILINE)
    assert headings == list(WARNING_NAMES)
