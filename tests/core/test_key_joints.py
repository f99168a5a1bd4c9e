# SPDX-License-Identifier: GPL-3.0-or-later
"""Key joints: the option, the report, rigs with fewer joints, and their fingerprints."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.mathematics.key_joints import KeyJointReport, select_joints
from fdda_addon.core.mathematics.skin_fit import FitReport
from fdda_addon.core.rig import Fingerprint, Joint, MeshPart, Rig, rig_differences
from fdda_addon.core.settings import parse_joints

REPORT = KeyJointReport("auto", 60, 500, 0.4, 0.5, still=("a", "b", "c", "d", "e"))
ERRORS = FitReport({"rig": 2.0, "fitted": 1.0}, {"rig": 20.0, "fitted": 10.0})


def chain_rig(*names: str, weighted: tuple[str, ...] = ("a", "b", "c", "d")) -> Rig:
    """Return a chain of joints with names; four vertices follow `weighted` joints, each with some of the next."""
    joints = tuple(Joint(name, index - 1) for index, name in enumerate(names))
    matrices = np.tile(np.eye(4, dtype=np.float32), (len(names), 1, 1))
    matrices[:, 0, 3] = np.arange(len(names))
    skin_joints = np.zeros((4, 4), np.int32)
    skin_joints[:, 0] = [names.index(name) for name in weighted]
    skin_joints[:, 1] = [names.index(name) for name in (*weighted[1:], weighted[0])]
    weights = np.tile(np.array([0.75, 0.25, 0, 0], np.float32), (4, 1))
    positions = np.arange(12, dtype=np.float32).reshape(4, 3)
    return Rig(joints, positions, matrices, skin_joints, weights, (MeshPart("mesh", 4, Fingerprint("t", "r", "s")),))


@pytest.mark.parametrize("text", ["all", "auto", "1", "50", "0050"])
def test_the_option_is_read(text):
    assert parse_joints(text) == text.lstrip("0")


@pytest.mark.parametrize("text", ["", "0", "-1", "1.5", "Auto", "1e3", "²", "1000000"])
def test_other_options_are_refused(text):
    with pytest.raises(ValueError, match=r"joints are auto, all, or a number from 1, and not "):
        parse_joints(text)


def test_weights_of_other_joints_count_for_the_nearest_ancestor():
    rig = chain_rig("a", "b", "c", "d")
    selected = select_joints(rig, (Joint("a", -1), Joint("c", 0)))
    assert selected.joint_names == ("a", "c")
    assert selected.skin_joints[:, :2].tolist() == [[0, 0], [0, 1], [1, 1], [1, 0]]
    np.testing.assert_array_equal(selected.rest_matrices, rig.rest_matrices[[0, 2]])
    assert selected.meshes[0].fingerprint.has_key_joints and not rig.meshes[0].fingerprint.has_key_joints


def test_the_fingerprint_depends_on_all_weights_but_not_on_joints_without_weights():
    joints = (Joint("a", -1), Joint("c", 0))

    def fingerprint(rig: Rig) -> str:
        return select_joints(rig, joints).meshes[0].fingerprint.skin_weights

    rig = chain_rig("a", "b", "c", "d")
    assert fingerprint(chain_rig("root", "a", "b", "x", "c", "d")) == fingerprint(rig)
    # The other slots of a vertex may have another order.
    swapped = replace(rig, skin_joints=rig.skin_joints[:, [1, 0, 2, 3]], skin_weights=rig.skin_weights[:, [1, 0, 2, 3]])
    assert fingerprint(swapped) == fingerprint(rig)
    changed = rig.skin_weights.copy()
    changed[3, :2] = 0.5
    others = [
        replace(rig, skin_weights=changed),
        chain_rig("a", "b", "c", "d", weighted=("a", "c", "b", "d")),
        chain_rig("a", "b", "c", "e", weighted=("a", "b", "c", "e")),
    ]
    assert len({fingerprint(rig), *map(fingerprint, others)}) == 4
    selected = select_joints(others[0], joints)
    recorded = select_joints(rig, joints)
    assert rig_differences(recorded.joints, recorded.rest_matrices, recorded.meshes, selected) == [
        "the skin weights differ"
    ]


def test_the_report_is_read_back_and_says_what_is_lost():
    assert KeyJointReport.from_json(REPORT.to_json()) == REPORT
    assert REPORT.sentence() == (
        "Key joints: the model reads 60 of 500 joints; in random poses the others follow from these within 0.40 mm "
        "(rms). No random pose moves 5 of the others ('a', 'b', 'c' and 2 more) relative to their parents, so the "
        "model does not show their own motion."
    )
    assert replace(REPORT, requested="600", joints=500).sentence() == (
        "Key joints: all 500 joints are read, because 600 were asked for."
    )
    assert replace(REPORT, independent=("x", "y"), still=()).sentence() == (
        "Key joints: the model reads 60 of 500 joints, but 2 of the others ('x' and 'y') move independently of these, "
        "by up to 0.40 mm (rms), and the model cannot learn that; read more joints, add their controls as inputs, or "
        "leave the choice to auto."
    )


@pytest.mark.parametrize(("key", "value"), [("still", "ab"), ("rig_joints", -1), ("requested", "none")])
def test_damaged_reports_are_refused(key, value):
    with pytest.raises((TypeError, ValueError)):
        KeyJointReport.from_json({**REPORT.to_json(), key: value})
