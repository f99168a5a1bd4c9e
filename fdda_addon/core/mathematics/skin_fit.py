# SPDX-License-Identifier: GPL-3.0-or-later
"""Fitted skin weights: the report of a fit, and the encoding of the weights as text for a model's metadata.

docs/formats.md describes the formats.
"""

import base64
import binascii
import json
from dataclasses import asdict, dataclass

import numpy as np

from ..json_check import COUNT, NUMBER, check_json
from .key_joints import KeyJointReport

FIT_KINDS = ("hard", "smooth")
"""Kinds of fits: one joint per vertex, or at most `INFLUENCES` joints per vertex."""
DEFAULT_KIND = "smooth"
"""Kind of the fit for key joints, if no other is chosen."""
INFLUENCES = 4
"""Number of fitted skin weights of a vertex."""
MAX_INFLUENCES = 64
"""Largest number of skin weights of a vertex in the metadata of a model."""


@dataclass(frozen=True)
class FitReport:
    """Distances of linear skinning from the rig over poses and vertices, mm.

    Attributes:
        rms_mm, max_mm: distances by the skin weights that were used: "rig" for the rig's own, and "fitted".
    """

    rms_mm: dict[str, float]
    max_mm: dict[str, float]

    def format_errors(self, weights_kind: str) -> str:
        """Format the distances for "rig" or "fitted": "1.25 rms and 8.0 max"."""
        return f"{self.rms_mm[weights_kind]:.2f} rms and {self.max_mm[weights_kind]:.1f} max"


@dataclass(frozen=True)
class SkinFit:
    """How skin weights were fitted, and the errors before and after.

    Attributes:
        kind: one of `FIT_KINDS`.
        poses: number of evaluated poses.
        held_out: errors on half of the poses, which were held out.
        training: errors on the other half.
        key_joints: how the joints with weights were chosen; None if they are all joints.
    """

    kind: str
    poses: int
    held_out: FitReport
    training: FitReport
    key_joints: KeyJointReport | None = None

    def to_json(self) -> dict:
        """Return the JSON for the metadata of a model."""
        value = {"kind": self.kind, "poses": self.poses, **asdict(self.held_out), "training": asdict(self.training)}
        return value | ({"key_joints": self.key_joints.to_json()} if self.key_joints else {})

    @staticmethod
    def from_json(value: dict) -> "SkinFit":
        """Read the JSON of `to_json`.

        Raises:
            ValueError: the JSON is damaged.
        """
        distances = {"rig": NUMBER, "fitted": NUMBER}
        errors = {"rms_mm": distances, "max_mm": distances}
        check_json(value, {"kind": set(FIT_KINDS), "poses": COUNT, **errors, "training": errors}, "fit")
        key_joints = KeyJointReport.from_json(value["key_joints"]) if "key_joints" in value else None
        reports = (FitReport(errors["rms_mm"], errors["max_mm"]) for errors in (value, value["training"]))
        return SkinFit(value["kind"], value["poses"], *reports, key_joints)

    def sentence(self) -> str:
        """Describe the key joints, and the errors before and after the fit."""
        held_out, training = self.poses // 2, self.poses - self.poses // 2
        key_joints = f"{self.key_joints.sentence()} " if self.key_joints else ""
        return (
            f"{key_joints}Linear skinning with fitted weights ({self.kind}), mm: "
            f"{self.held_out.format_errors('fitted')} on {held_out} held-out poses, "
            f"{self.held_out.format_errors('rig')} with the rig's own weights; "
            f"{self.training.format_errors('fitted')} on the {training} poses of the fit, "
            f"{self.training.format_errors('rig')} with the rig's own."
        )


def are_skin_weights(joints: np.ndarray, weights: np.ndarray, joint_count: int) -> bool:
    """Return whether (V, I) joint indices are valid and (V, I) weights are not negative and sum to 1 in each row."""
    return bool(
        np.isfinite(weights).all()
        and (weights >= 0).all()
        and np.allclose(weights.sum(axis=1), 1, atol=1e-4)
        and (joints >= 0).all()
        and (joints < joint_count).all()
    )


def skin_to_text(joints: np.ndarray, weights: np.ndarray) -> str:
    """Encode (V, I) int32 joints and (V, I) float32 weights as JSON."""
    value = {
        "influences": joints.shape[1],
        "joints": base64.b64encode(joints.astype("<i4").tobytes()).decode("ascii"),
        "weights": base64.b64encode(weights.astype("<f4").tobytes()).decode("ascii"),
    }
    return json.dumps(value)


def skin_from_text(text: str, vertex_count: int, joint_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Decode the text of `skin_to_text` to (V, I) int32 joints and (V, I) float32 weights.

    Raises:
        ValueError: the text is damaged, or has other numbers of vertices or joints. The message is a clause about the
            model.
    """
    try:
        if len(text) > 2 * (-(-4 * vertex_count * MAX_INFLUENCES // 3) * 4) + (1 << 20):
            raise ValueError(f"they have {len(text)} characters")
        value = json.loads(text)
        influences = value["influences"]
        if type(influences) is not int or not 1 <= influences <= MAX_INFLUENCES:
            raise ValueError(f"they have {influences!r} joints per vertex")
        # Check the length before decoding. A number has four bytes; Base64 encodes three bytes as four characters.
        encoded_length = -(-4 * vertex_count * influences // 3) * 4
        if any(len(value[name]) != encoded_length for name in ("joints", "weights")):
            raise ValueError(f"they are not for {vertex_count} vertices")
        joints, weights = (
            np.frombuffer(base64.b64decode(value[name], validate=True), dtype).reshape(vertex_count, influences)
            for name, dtype in (("joints", "<i4"), ("weights", "<f4"))
        )
    except (binascii.Error, json.JSONDecodeError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"its skin weights cannot be read ({error})") from error
    except ValueError as error:
        raise ValueError(f"its skin weights are damaged: {error}") from error
    if not are_skin_weights(joints, weights, joint_count):
        raise ValueError("its skin weights are no weights of its joints")
    return joints.astype(np.int32), weights.astype(np.float32)
