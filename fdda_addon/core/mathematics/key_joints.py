# SPDX-License-Identifier: GPL-3.0-or-later
"""Key joints: a rig whose model reads fewer joints than those with skin weights."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

import numpy as np

from ..joint_option import AUTO, parse_joints
from ..rig import KEY_JOINTS_PREFIX, Fingerprint, Joint, Rig
from .partition import Partition

MAX_NAMED_JOINTS = 3


@dataclass(frozen=True)
class KeyJointReport:
    """How key joints were chosen.

    Attributes:
        requested: the option `joints`.
        joints, rig_joints: number of key joints, and of all joints.
        unexplained_mm: largest motion of another joint that key joints and controls do not explain, mm: rms over poses
            and over the vertices of the joint, times skin weights.
        tolerance_mm: unexplained motion with which "auto" removes any joint.
        independent: names of the removed joints that "auto" would not remove, the largest unexplained motion first.
        still: names of the removed joints that no pose moves relative to their parents.
    """

    requested: str
    joints: int
    rig_joints: int
    unexplained_mm: float
    tolerance_mm: float
    independent: tuple[str, ...] = ()
    still: tuple[str, ...] = ()

    def to_json(self) -> dict:
        """Return the JSON for `recording.json` and messages."""
        return asdict(self) | {"independent": list(self.independent), "still": list(self.still)}

    @staticmethod
    def from_json(value: dict) -> "KeyJointReport":
        """Read the JSON of `to_json`.

        Raises:
            KeyError, TypeError, ValueError: the JSON is damaged.
        """
        counts = [value[name] for name in ("joints", "rig_joints")]
        if any(type(count) is not int or count < 0 for count in counts):
            raise ValueError("the key joints are not counted by numbers")
        lost = [value[name] for name in ("independent", "still")]
        if not all(isinstance(names, list | tuple) and all(isinstance(name, str) for name in names) for names in lost):
            raise ValueError("the joints that are not read have no names")
        distances = [float(value[name]) for name in ("unexplained_mm", "tolerance_mm")]
        if not np.isfinite(distances).all() or not isinstance(value["requested"], str):
            raise ValueError("the errors of key joints are not numbers")
        return KeyJointReport(parse_joints(value["requested"]), *counts, *distances, *map(tuple, lost))

    def sentence(self) -> str:
        """Describe the choice, and what is lost."""
        removed = self.rig_joints - self.joints
        if not removed and self.requested != AUTO:
            return f"Key joints: all {self.rig_joints} joints are read, because {self.requested} were asked for."
        if not removed:
            return (
                f"Key joints: all {self.rig_joints} joints are read, because each moves by more than "
                f"{self.tolerance_mm:.2f} mm in ways that the others do not explain."
            )
        text = f"Key joints: the model reads {self.joints} of {self.rig_joints} joints"
        if self.independent:
            text += (
                f", but {len(self.independent)} of the others ({_first_names(self.independent)}) move independently of "
                f"these, by up to {self.unexplained_mm:.2f} mm (rms), and the model cannot learn that; read more "
                "joints, add their controls as inputs, or leave the choice to auto."
            )
        else:
            text += f"; in random poses the others follow from these within {self.unexplained_mm:.2f} mm (rms)."
        if self.still:
            text += (
                f" No random pose moves {len(self.still)} of the others ({_first_names(self.still)}) relative to their "
                "parents, so the model does not show their own motion."
            )
        return text


def _first_names(names: tuple[str, ...]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:MAX_NAMED_JOINTS])
    return shown + (f" and {len(names) - MAX_NAMED_JOINTS} more" if len(names) > MAX_NAMED_JOINTS else "")


def select_joints(rig: Rig, joints: tuple[Joint, ...]) -> Rig:
    """Return a rig with some of its joints.

    Weights of other joints count for the nearest ancestor that is selected, else for the first joint. The fingerprint
    identifies the skin weights of all joints by their names.

    Args:
        rig: the rig with its own skin weights.
        joints: joints with names of the rig's joints, every parent before its children.
    """
    indices = {joint.name: index for index, joint in enumerate(rig.joints)}
    selected = [indices[joint.name] for joint in joints]
    heirs = np.zeros(len(rig.joints), np.int32)
    for index, joint in enumerate(rig.joints):
        heirs[index] = heirs[joint.parent] if joint.parent >= 0 else 0
        if index in selected:
            heirs[index] = selected.index(index)
    skin_weights = _digest_weights(rig)
    return replace(
        rig,
        joints=joints,
        rest_matrices=rig.rest_matrices[selected],
        skin_joints=heirs[rig.skin_joints].astype(np.int32),
        fingerprint=replace(rig.fingerprint, skin_weights=f"{KEY_JOINTS_PREFIX}{skin_weights}"),
    )


def _digest_weights(rig: Rig) -> str:
    """Hash the skin weights of a rig, so that the hash does not depend on joints without weights and on their order."""
    vertices, slots = np.nonzero(rig.skin_weights > 0)
    joints, weights = rig.skin_joints[vertices, slots], rig.skin_weights[vertices, slots]
    names = sorted({rig.joint_names[joint] for joint in np.unique(joints)})
    ranks = {name: rank for rank, name in enumerate(names)}
    ranks_of_joints = np.array([ranks.get(name, 0) for name in rig.joint_names], np.int32)[joints]
    order = np.lexsort((ranks_of_joints, vertices))
    names_digest = Fingerprint.digest_text("\0".join(names))
    digest = Fingerprint.digest(vertices[order].astype(np.int32), ranks_of_joints[order], weights[order])
    return Fingerprint.digest_text(names_digest + digest)


def add_influences(
    partitions: tuple[Partition, ...], needed_inputs: np.ndarray, joint_count: int
) -> tuple[Partition, ...]:
    """Add inputs to the influences of partitions.

    Args:
        partitions: of a rig with `joint_count` joints.
        needed_inputs: (V, J + C) bool, the joints and controls from which the motion of a vertex follows.
        joint_count: J.
    """

    def merge(known: tuple[int, ...], added: Iterable[int]) -> tuple[int, ...]:
        return tuple(sorted({*known, *added}))

    result = []
    for partition in partitions:
        needed = needed_inputs[partition.vertices].any(axis=0)
        joints, controls = np.flatnonzero(needed[:joint_count]), np.flatnonzero(needed[joint_count:])
        result.append(
            replace(
                partition,
                influencing=merge(partition.influencing, joints.tolist()),
                controls=merge(partition.controls, controls.tolist()),
            )
        )
    return tuple(result)
