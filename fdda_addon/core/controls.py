# SPDX-License-Identifier: GPL-3.0-or-later
"""Controls: inputs of a model beside the joints, such as values of shape keys."""

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

from .json_check import NUMBER, check_json

ARMATURE_OBJECT, ARMATURE, MESH_OBJECT, SHAPE_KEYS = "armature_object", "armature", "mesh_object", "shape_keys"
OWNERS = (ARMATURE_OBJECT, ARMATURE, MESH_OBJECT, SHAPE_KEYS)
SHAPE_KEY_PATH = re.compile(r'key_blocks\["(?P<name>(?:[^"\\]|\\.)*)"\]\.value', re.DOTALL)
"""Path of the value of a shape key; `name` is escaped."""
EVALUATION_TIME = "eval_time"
"""Path of the evaluation time of absolute shape keys."""
OTHER_OBJECT = "object:"
"""Prefix of the owner of a control on another object; the name of the object follows."""
MESH_OWNER = re.compile(rf"(?P<owner>{MESH_OBJECT}|{SHAPE_KEYS}):(?P<mesh>.+)", re.DOTALL)
"""Owner of a control on another mesh of the rig than the first: `shape_keys:shirt`."""


@dataclass(frozen=True)
class Control:
    """An animatable number that deforms the mesh.

    Attributes:
        owner: the data-block that has the property. It is identified by its role in the rig, one of `OWNERS`, so that a
            linked or renamed character keeps its controls; by `MESH_OWNER`; or by `OTHER_OBJECT` and the name of an
            object.
        path: RNA path inside the owner, `key_blocks["Smile"].value`, `pose.bones["hand"]["fist"]`; one element of an
            array is `location[0]`.
        low, high: range of the control, in the unit of the property.
    """

    owner: str
    path: str
    low: float
    high: float

    @property
    def is_shape_key(self) -> bool:
        """Whether the control is the value of a shape key of a mesh of the rig."""
        return self.owner.partition(":")[0] == SHAPE_KEYS and bool(SHAPE_KEY_PATH.fullmatch(self.path))

    @property
    def name(self) -> str:
        """Name of the control: owner and path. It is unique among the controls of a rig."""
        return f"{self.owner}/{self.path}"

    def to_json(self) -> dict:
        return asdict(self)

    @staticmethod
    def from_json(value: dict) -> "Control":
        """Read a control from a file.

        Raises:
            ValueError: it is damaged.
        """
        check_json(value, {"owner": str, "path": str, "low": NUMBER, "high": NUMBER}, "control")
        control = Control(value["owner"], value["path"], float(value["low"]), float(value["high"]))
        is_other = control.owner.startswith(OTHER_OBJECT) or MESH_OWNER.fullmatch(control.owner)
        if (control.owner not in OWNERS and not is_other) or not control.path:
            raise ValueError(f"a control belongs to {control.owner!r} and is called {control.path!r}")
        if control.low > control.high:
            raise ValueError(f"the control {control.name!r} has the range {control.low} to {control.high}")
        return control


def controls_of_mesh(controls: Iterable[Control], mesh: str) -> tuple[Control, ...]:
    """Return the controls of a rig as they are in a rig of one of its meshes, without those of the other meshes.

    Args:
        controls: controls of the rig.
        mesh: name of the mesh; empty for the first mesh.
    """
    own = []
    for control in controls:
        match = MESH_OWNER.fullmatch(control.owner)
        owner, owner_mesh = (match["owner"], match["mesh"]) if match else (control.owner, "")
        if owner not in (MESH_OBJECT, SHAPE_KEYS) or owner_mesh == mesh:
            own.append(replace(control, owner=owner))
    return tuple(own)


def owners_from_mesh(first_mesh: str, mesh: str) -> dict[str, str]:
    """Return how the owners of controls are named if another mesh of the rig comes first; the others keep their names.

    Args:
        first_mesh: name of the first mesh of the rig.
        mesh: name of the mesh that comes first.
    """
    if mesh == first_mesh:
        return {}
    owners = MESH_OBJECT, SHAPE_KEYS
    return {owner: f"{owner}:{first_mesh}" for owner in owners} | {f"{owner}:{mesh}": owner for owner in owners}


def read_controls(values: list) -> tuple[Control, ...]:
    """Read the controls of a recording or model.

    Raises:
        TypeError, ValueError: they are damaged, or two have one name.
    """
    controls = tuple(Control.from_json(value) for value in values)
    if len({control.name for control in controls}) != len(controls):
        raise ValueError("two of its controls have one name")
    return controls
