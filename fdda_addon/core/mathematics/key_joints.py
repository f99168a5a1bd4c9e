# SPDX-License-Identifier: GPL-3.0-or-later
"""Key joints: a rig whose model reads fewer joints than those with skin weights."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from ..json_check import COUNT, NUMBER, check_json
from ..rig import KEY_JOINTS_PREFIX, STATIC_JOINT, Fingerprint, Joint, Rig
from ..settings import AUTO, parse_joints
from ..wording import format_list


@dataclass(frozen=True)
class KeyJointReport:
    """How key joints were chosen.

    Attributes:
        requested: the setting `bones_to_read`.
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
        """Return the JSON for the metadata of a model."""
        return asdict(self) | {"independent": list(self.independent), "still": list(self.still)}

    @staticmethod
    def from_json(value: dict) -> "KeyJointReport":
        """Read the JSON of `to_json`.

        Raises:
            ValueError: the JSON is damaged.
        """
        keys = {
            **{"requested": str, "joints": COUNT, "rig_joints": COUNT, "unexplained_mm": NUMBER},
            **{"tolerance_mm": NUMBER, "independent": [str], "still": [str]},
        }
        check_json(value, keys, "key joints")
        values = {key: tuple(value[key]) if isinstance(value[key], list) else value[key] for key in keys}
        return KeyJointReport(**values | {"requested": parse_joints(value["requested"])})

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
                f", but {len(self.independent)} of the others ({format_list(self.independent)}) move independently of "
                f"these, by up to {self.unexplained_mm:.2f} mm (rms), and the model cannot learn that; read more "
                "joints, add their controls as inputs, or leave the choice to auto."
            )
        else:
            text += f"; in random poses the others follow from these within {self.unexplained_mm:.2f} mm (rms)."
        if self.still:
            text += (
                f" No random pose moves {len(self.still)} of the others ({format_list(self.still)}) relative to their "
                "parents, so the model does not show their own motion."
            )
        return text


def select_joints(rig: Rig, joints: tuple[Joint, ...]) -> Rig:
    """Return a rig with some of its joints.

    Weights of other joints count for the nearest ancestor that is selected, else for the first joint. The
    fingerprints identify the skin weights of all joints by their names.

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
    meshes = tuple(
        replace(
            mesh,
            fingerprint=replace(
                mesh.fingerprint,
                skin_weights=KEY_JOINTS_PREFIX
                + _digest_weights(rig.joint_names, rig.skin_joints[vertices], rig.skin_weights[vertices]),
            ),
        )
        for mesh, vertices in zip(rig.meshes, rig.mesh_slices, strict=True)
    )
    return replace(
        rig,
        joints=joints,
        rest_matrices=rig.rest_matrices[selected],
        skin_joints=heirs[rig.skin_joints].astype(np.int32),
        meshes=meshes,
    )


def joints_with_indices(rig: Rig, indices: Iterable[int]) -> tuple[Joint, ...]:
    """Return some joints of a rig; the parent of each is its nearest ancestor among them.

    Args:
        indices: ascending indices of the joints.
    """
    new_indices = {joint: index for index, joint in enumerate(indices)}
    joints = []
    for joint in new_indices:
        parent = rig.joints[joint].parent
        while parent >= 0 and parent not in new_indices:
            parent = rig.joints[parent].parent
        joints.append(Joint(rig.joints[joint].name, new_indices.get(parent, -1)))
    return tuple(joints)


def find_unread_bones(
    sources: dict[str, list[str]], controlled: Iterable[str], rig: Rig, joint_names: Iterable[str]
) -> list[str]:
    """Find the bones whose changes move the mesh without moving what a model reads.

    These are the bones with skin weights that are no joints, and the bones that move these alone.

    Args:
        sources, controlled: as in `RecordedBones`.
        rig: the rig with its own skin weights and all joints.
        joint_names: names of the joints of the model.

    Returns:
        Names in alphabetical order.
    """
    weighted = {rig.joint_names[joint] for joint in np.unique(rig.skin_joints[rig.skin_weights > 0])}
    joints = set(joint_names)
    followers = weighted - joints - {STATIC_JOINT}
    visible = with_sources(sources, {*joints, *controlled})
    return sorted(followers | (with_sources(sources, followers) - visible))


def with_sources(sources: Mapping[str, Iterable[str]], names: Iterable[str]) -> set[str]:
    """Return bones and all bones on which they depend, given the bones that each bone reads."""
    found, queue = set(), [name for name in names if name in sources]
    while queue:
        name = queue.pop()
        if name not in found:
            found.add(name)
            queue += [source for source in sources[name] if source in sources]
    return found


def _digest_weights(joint_names: Sequence[str], skin_joints: np.ndarray, skin_weights: np.ndarray) -> str:
    """Hash the skin weights of a mesh; the hash does not depend on joints without weights and on their order."""
    vertices, slots = np.nonzero(skin_weights > 0)
    joints, weights = skin_joints[vertices, slots], skin_weights[vertices, slots]
    names = sorted({joint_names[joint] for joint in np.unique(joints)})
    ranks = {name: rank for rank, name in enumerate(names)}
    ranks_of_joints = np.array([ranks.get(name, 0) for name in joint_names], np.int32)[joints]
    order = np.lexsort((ranks_of_joints, vertices))
    names_digest = Fingerprint.digest_text("\0".join(names))
    digest = Fingerprint.digest(vertices[order].astype(np.int32), ranks_of_joints[order], weights[order])
    return Fingerprint.digest_text(names_digest + digest)
