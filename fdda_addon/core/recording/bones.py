# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones of a recorded rig, as far as a choice of key joints and the fingerprint of its model depend on them."""

from dataclasses import asdict, dataclass, field

from ..rig import read_name


@dataclass(frozen=True)
class RecordedBones:
    """Bones of a recorded rig.

    Attributes:
        dependencies: indices of the joints that move the mesh otherwise than by skin weights.
        fixed: indices of the joints that keep their parents as reference joints.
        controlled: names of the bones whose transforms are controls.
        sources: the bones that a bone reads, by name, for joints and all bones on which they depend.
        settings: what moves a bone, as in the fingerprint (`core.deformation`), by name, for bones with skin weights
            and all bones on which they depend.
    """

    dependencies: tuple[int, ...] = ()
    fixed: tuple[int, ...] = ()
    controlled: tuple[str, ...] = ()
    sources: dict[str, list[str]] = field(default_factory=dict)
    settings: dict[str, dict] = field(default_factory=dict)

    def to_json(self) -> dict:
        """Return the JSON for `bones.json`."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}

    @staticmethod
    def from_json(value: dict, joint_count: int) -> "RecordedBones":
        """Read the JSON of `to_json`.

        Raises:
            KeyError, TypeError, ValueError: the JSON is damaged.
        """
        for key in ("dependencies", "fixed"):
            if not all(type(joint) is int and 0 <= joint < joint_count for joint in value[key]):
                raise ValueError(f"'{key}' are none of its {joint_count} joints")
        sources = {read_name(name): list(map(read_name, names)) for name, names in value["sources"].items()}
        settings = {read_name(name): dict(bone) for name, bone in value["settings"].items()}
        joints = (tuple(value[key]) for key in ("dependencies", "fixed"))
        return RecordedBones(*joints, tuple(map(read_name, value["controlled"])), sources, settings)
