# SPDX-License-Identifier: GPL-3.0-or-later
"""What is said of two rigs that differ."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.rig import REST_TOLERANCE, Fingerprint, Joint, Rig, differences

from .limb import JOINTS, make_rig


def found(rig: Rig, **changes) -> list[str]:
    """Differences between the rig, as a model knows it, and itself with changes."""
    return differences(rig.joints, rig.rest_matrices, rig.vertex_count, rig.fingerprint, replace(rig, **changes))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return make_rig()


def test_the_same_rig(rig):
    assert found(rig) == []


def test_vertex_count(rig):
    assert found(rig, rest_positions=rig.rest_positions[:-3]) == ["it has 40 vertices, the mesh has 37"]


def renamed(*names: str) -> tuple[Joint, ...]:
    return tuple(Joint(name, joint.parent) for name, joint in zip(names, JOINTS, strict=False))


@pytest.mark.parametrize(
    ("joints", "sentences"),
    [
        (renamed("root", "upper", "lower"), ["the armature lacks the joint 'thumb'"]),
        (
            renamed("root", "a", "b", "thumb"),
            ["the armature lacks the joints 'lower', 'upper'", "it does not know the joints 'a', 'b'"],
        ),
        (renamed("a", "b", "c", "d"), [
            "the armature lacks the joints 'lower', 'root', 'thumb' and 1 more",
            "it does not know the joints 'a', 'b', 'c' and 1 more",
        ]),
        ((*JOINTS, Joint("tail", 0)), ["it does not know the joint 'tail'"]),
        ((*JOINTS[:3], Joint("thumb", 2)), ["its joints have other parents"]),
    ],
)  # fmt: skip
def test_joints(rig, joints, sentences):
    rest = np.resize(rig.rest_matrices, (len(joints), 4, 4))
    assert found(rig, joints=joints, rest_matrices=rest) == sentences


def test_rest_pose_of_the_armature(rig):
    moved = rig.rest_matrices.copy()
    moved[2, 0, 3] += 2 * REST_TOLERANCE
    assert found(rig, rest_matrices=moved) == ["the rest pose of the armature differs"]
    moved[2, 0, 3] -= 1.5 * REST_TOLERANCE
    assert found(rig, rest_matrices=moved) == [], "versions of Blender compute a rest matrix a few steps apart"


@pytest.mark.parametrize(
    ("part", "sentence"),
    [
        ("topology", "the topology of the mesh differs"),
        ("rest_positions", "the rest pose of the mesh differs"),
        ("skin_weights", "the skin weights differ"),
    ],
)
def test_fingerprint(rig, part, sentence):
    assert found(rig, fingerprint=replace(rig.fingerprint, **{part: "0"})) == [sentence]


def test_digest_tells_values_shapes_and_types_apart():
    array = np.arange(12, dtype=np.int32)
    digests = {
        Fingerprint.digest(array),
        Fingerprint.digest(array + 1),
        Fingerprint.digest(array.reshape(3, 4)),
        Fingerprint.digest(array.astype(np.int64)),
        Fingerprint.digest(array, array),
    }
    assert len(digests) == 5
    assert all(len(digest) == 16 and int(digest, 16) >= 0 for digest in digests)
    assert Fingerprint.digest(array.reshape(3, 4).T.copy().T) == Fingerprint.digest(array.reshape(3, 4))
