# SPDX-License-Identifier: GPL-3.0-or-later
"""The index of a recording, `recording.json`, and `bones.json`, which does not change while poses are appended."""

import json
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ..controls import read_controls
from ..errors import OutputError, RecordingError, os_error_text
from ..files.input_file import read_input
from ..files.output import atomic_write, to_json_text
from ..json_check import COUNT, NOT_NEGATIVE, POSITIVE, WHOLE, check_json
from ..mathematics.poses import CONTROL, Channel, Overshoot
from ..mathematics.surface import MIN_CORNERS
from ..rig import read_joints, read_meshes, read_unit

FORMAT = "fdda-recording"
VERSION = 2
INDEX_NAME, BONES_NAME = "recording.json", "bones.json"
MAX_INDEX_BYTES = 16 << 20
"""Largest size of either file."""
MAX_INFLUENCES = 1000
"""Largest number of skin weights of a vertex."""
RANDOM, ACTION, STRIP, MIRRORED = "random", "action", "strip", "mirrored"
"""Kinds of sources of poses: random poses, frames of an action, frames of an NLA strip, and the mirrored frames of the
previous source."""
REFINED = "refined"
"""Kind of source for poses that a refinement added where a model had large errors.

They do not represent the range of motion and are never held out."""
ALONE = "alone"
"""Kind of source for poses in which one input moves alone from a base pose (`AloneMoves`).

They show what each input influences; nothing is trained on them."""
SOURCE_KINDS = (RANDOM, ACTION, STRIP, MIRRORED, ALONE, REFINED)
JOINT = "joint"
"""Kind of an input that is a joint; the other kind is `CONTROL`."""


REPEATED_POSES = 10
"""Largest number of poses that are reached from a second direction."""
POSE, FRAMES, SIMULATION = "pose", "frames", "simulation"
"""The dependence of a target: on the pose alone; on the frame, as a cache; or on the pose and earlier poses, as a
simulation."""
FOLLOWS_VALUES = (POSE, FRAMES, SIMULATION)


@dataclass(frozen=True)
class RecordedTarget:
    """How the target of a recording was evaluated.

    Attributes:
        object_name: name of the target object.
        follows: `POSE`, `FRAMES` or `SIMULATION`.
        pre_roll: number of frames in which the rig moved from the rest pose to the first frame of an action.
        settle_frames: largest number of frames for which a random pose was held; 0 where poses were not held.
        rest_threshold_mm: the target is at rest when no vertex moves by more than this between two frames, mm.
    """

    object_name: str
    follows: str
    pre_roll: int = 0
    settle_frames: int = 0
    rest_threshold_mm: float = 0.0

    def to_json(self) -> dict:
        settle_values = (
            {"settle_frames": self.settle_frames, "rest_threshold_mm": self.rest_threshold_mm}
            if self.settle_frames
            else {}
        )
        return {"object": self.object_name, "follows": self.follows, "pre_roll": self.pre_roll, **settle_values}

    @staticmethod
    def from_json(value: dict) -> "RecordedTarget":
        """Read a target from a file; raise ValueError where it is damaged."""
        rest_keys = {"settle_frames?": COUNT, "rest_threshold_mm?": NOT_NEGATIVE}
        check_json(value, {"object": str, "follows": set(FOLLOWS_VALUES), "pre_roll": COUNT, **rest_keys}, "target")
        rest = value.get("settle_frames", 0), value.get("rest_threshold_mm", 0.0)
        return RecordedTarget(value["object"], value["follows"], value["pre_roll"], *rest)


def repeated_poses(count: int, unsettled: Collection[int]) -> list[int]:
    """Return the indices of the poses that are reached from a second direction: the first that came to rest.

    Args:
        count: number of first poses among which they are: of all poses, or of those that are random and in the range.
        unsettled: indices of the poses in which the target did not come to rest.
    """
    return [index for index in range(count) if index not in unsettled][:REPEATED_POSES]


def repeatability_sentence(repeatability_mm: float | None) -> str:
    """Return a sentence about how closely a repeated pose gives the same surface; empty where it was not measured."""
    if repeatability_mm is None:
        return ""
    return (
        f"The same pose from two directions: {repeatability_mm:.3g} mm apart on average. No model can be closer than "
        "that."
    )


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
        return asdict(self)

    @staticmethod
    def from_json(value: dict, joint_count: int) -> "RecordedBones":
        """Read the JSON of `to_json`.

        Raises:
            ValueError: the JSON is damaged.
        """
        indices = [range(joint_count)]
        keys = {"dependencies": indices, "fixed": indices, "controlled": [str]}
        check_json(value, {**keys, "sources": {str: [str]}, "settings": {str: {}}})
        return RecordedBones(*(tuple(value[key]) for key in keys), value["sources"], value["settings"])


@dataclass(frozen=True)
class Source:
    """The origin of a run of consecutive poses in a recording.

    Attributes:
        kind: one of `SOURCE_KINDS`.
        poses: number of poses.
        name: name of the action or strip, also for mirrored frames; file name of the model for refined poses; empty for
            others.
        frames: first frame of the action or strip, and number of frames between poses; (0, 0) for other poses.
    """

    kind: str
    poses: int
    name: str = ""
    frames: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Sampling:
    """How poses are chosen; `overshoot` describes random poses outside of the range of motion and may be None."""

    seed: int
    spread: float
    channels: tuple[Channel, ...]
    sources: tuple[Source, ...]
    overshoot: Overshoot | None = None

    def to_json(self) -> dict:
        return {
            **({"overshoot": self.overshoot.to_json()} if self.overshoot else {}),
            "seed": self.seed,
            "spread": self.spread,
            "limits": [channel.to_json() for channel in self.channels],
            "sources": [asdict(source) for source in self.sources],
        }


@dataclass(frozen=True)
class AloneMoves:
    """The poses in which one input moves alone: for each base pose, the pose itself, then one pose for each input.

    Poses in which a shape key moves from the first base pose follow: a key moves the same vertices in all poses.

    Attributes:
        bases: number of base poses, the rest pose first.
        inputs: kind, and indices of the joint or of the controls that move together, of each input.
        keys: indices of the controls that are values of shape keys.
        undetectable: indices of the controls that cannot be moved alone, so that they may influence all vertices.
    """

    bases: int
    inputs: tuple[tuple[str, tuple[int, ...]], ...]
    keys: tuple[int, ...] = ()
    undetectable: tuple[int, ...] = ()

    @property
    def first_key_pose(self) -> int:
        """Return the index of the first pose, among these poses, in which a shape key moves."""
        return self.bases * (len(self.inputs) + 1)

    @property
    def poses(self) -> int:
        """Return the number of poses."""
        return self.first_key_pose + len(self.keys)

    def to_json(self) -> dict:
        return asdict(self) | {"inputs": [[kind, *indices] for kind, indices in self.inputs]}

    @staticmethod
    def from_json(value: dict, joints: int, controls: int) -> "AloneMoves":
        """Read the JSON of `to_json`, given the numbers of joints and controls.

        Raises:
            TypeError, ValueError: the JSON is damaged.
        """
        control_indices = [range(controls)]
        keys = {"bases": COUNT[1:], "inputs": [list], "keys": control_indices, "undetectable": control_indices}
        check_json(value, keys, "alone")
        inputs = tuple((kind, tuple(indices)) for kind, *indices in value["inputs"])
        for kind, indices in inputs:
            if kind not in (JOINT, CONTROL) or (kind == JOINT and len(indices) != 1):
                raise ValueError(f"a moved input is {kind!r} {indices!r}")
            check_json(list(indices), [range(joints)] if kind == JOINT else control_indices, f"a moved {kind}")
        return AloneMoves(value["bases"], inputs, tuple(value["keys"]), tuple(value["undetectable"]))


@dataclass(frozen=True)
class RecordingInfo:
    """Pose counts and origin of a recording, from `recording.json`.

    Attributes:
        poses, complete: number of all poses, and of complete poses.
        rig_file: name of the .blend file.
        blender: version of Blender.
        sampling: sampling of the poses.
        bones: the bones of the rig.
        target: target whose surface was recorded; None where the rig itself was recorded.
        unsettled: ascending indices of the poses in which the target did not come to rest.
        repeatability_mm: mean distance of the target from itself in poses that are reached from two directions, mm;
            None where it was not measured.
        alone: the poses in which one input moves alone; None where the target depends on time.
    """

    poses: int
    complete: int
    rig_file: str
    blender: str
    sampling: Sampling
    bones: RecordedBones = field(default_factory=RecordedBones)
    target: RecordedTarget | None = None
    unsettled: tuple[int, ...] = ()
    repeatability_mm: float | None = None
    alone: AloneMoves | None = None

    @property
    def alone_poses(self) -> range:
        """Return the indices of the poses in which one input moves alone."""
        start = 0
        for source in self.sampling.sources:
            if source.kind == ALONE:
                return range(start, start + source.poses)
            start += source.poses
        return range(0)


def read_index(path: Path) -> dict:
    """Read `recording.json` of a recording, complete or not, with `bones.json` as its `bones`; check their values.

    Raises:
        RecordingError: a file is missing, damaged, or of another version.
    """

    def check_format(index: dict) -> None:
        if not isinstance(index, dict) or index.get("format") != FORMAT:
            raise RecordingError(
                f"'{path / INDEX_NAME}' is not the index of a recording; give a folder that record made."
            )
        if index.get("version") != VERSION:
            raise RecordingError(
                f"'{path}' is a recording of version {index.get('version')!r} and this add-on reads version {VERSION}; "
                "record again."
            )
        _check_index(index)

    index = _read_json(path / INDEX_NAME, check_format)
    joint_count = len(index["joints"])
    return index | {"bones": _read_json(path / BONES_NAME, lambda bones: RecordedBones.from_json(bones, joint_count))}


def _read_json(path: Path, check: Callable[[dict], object]) -> dict:
    """Read a JSON file and check its value; `check` may raise the errors of damaged JSON."""
    try:
        value = json.loads(read_input(path, MAX_INDEX_BYTES, follow_links=False))
    except FileNotFoundError as error:
        raise RecordingError(
            f"'{path.parent}' is not a recording: it has no {path.name}; make one with record."
        ) from error
    except OSError as error:
        raise RecordingError(f"'{path}' cannot be read ({os_error_text(error)}); record again.") from error
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"'{path}' cannot be read ({error}); record again with --overwrite.") from error
    try:
        check(value)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"'{path}' is damaged: {error}; record again.") from error
    return value


_INDEX_KEYS = {
    **{"poses": COUNT, "complete": COUNT, "influences": range(1, MAX_INFLUENCES + 1)},
    **{"faces?": COUNT, "corners?": COUNT, "blender": str, "rig": {"file": str}, "unsettled?": [COUNT]},
    "repeatability_mm?": NOT_NEGATIVE,
    **{"joints": [{}], "meshes": [{}], "controls": [{}]},
    "sampling": {
        **{"seed": COUNT, "spread": POSITIVE, "limits": [{}]},
        "sources": [{"kind": set(SOURCE_KINDS), "poses": COUNT, "name": str, "frames": [WHOLE]}],
    },
}


def _check_index(index: dict) -> None:
    check_json(index, _INDEX_KEYS)
    if index["complete"] > index["poses"] or any(pose >= index["complete"] for pose in index.get("unsettled", ())):
        raise ValueError("its counts contradict each other")
    if index.get("corners", 0) < MIN_CORNERS * index.get("faces", 0):
        raise ValueError(f"{index['faces']} faces cannot have {index.get('corners', 0)} corners")
    read_controls(index["controls"])
    read_joints(index["joints"])
    read_meshes(index["meshes"])
    read_unit(index)
    info = read_info(index)
    if any(len(source.frames) != 2 for source in info.sampling.sources):
        raise ValueError("the frames of a source are not two")
    alone_counts = [source.poses for source in info.sampling.sources if source.kind == ALONE]
    expected_counts = [info.alone.poses] if info.alone else []
    if alone_counts != expected_counts:
        raise ValueError(f"it has {alone_counts} poses in which one input moves alone, not {expected_counts}")


def read_info(index: dict) -> RecordingInfo:
    """Return the pose counts and the origin of a recording from its index, which may lack its `bones`.

    Raises:
        TypeError, ValueError: the index is damaged.
    """
    joint_count, control_count, value = len(index["joints"]), len(index["controls"]), index["sampling"]
    sources = tuple(Source(s["kind"], s["poses"], s["name"], tuple(s["frames"])) for s in value["sources"])
    overshoot = Overshoot.from_json(value["overshoot"]) if "overshoot" in value else None
    random_pose_count = sum(source.poses for source in sources if source.kind == RANDOM)
    if overshoot and overshoot.poses > random_pose_count:
        raise ValueError(f"{overshoot.poses} of its {random_pose_count} random poses lie in the overshoot")
    channels = tuple(Channel.from_json(channel) for channel in value["limits"])
    return RecordingInfo(
        index["poses"],
        index["complete"],
        index["rig"]["file"],
        index["blender"],
        Sampling(value["seed"], float(value["spread"]), channels, sources, overshoot),
        RecordedBones.from_json(index["bones"], joint_count) if "bones" in index else RecordedBones(),
        RecordedTarget.from_json(index["target"]) if "target" in index else None,
        tuple(index.get("unsettled", ())),
        index.get("repeatability_mm"),
        AloneMoves.from_json(index["alone"], joint_count, control_count) if "alone" in index else None,
    )


def write_json(path: Path, value: dict) -> None:
    """Replace a file of a recording.

    Raises:
        OSError: it cannot be written.
    """
    try:
        with atomic_write(path, keep_on_failure=False) as temporary:
            temporary.write_text(to_json_text(value), encoding="utf-8")
    except OutputError as error:
        raise error.__cause__ from None


def find_different_keys(first: dict, second: dict, prefix: str = "") -> list[str]:
    """List the keys whose values differ between two dictionaries; nested keys are joined by dots."""
    different_keys = []
    for key in sorted(first.keys() | second.keys()):
        values = first.get(key), second.get(key)
        if all(isinstance(value, dict) for value in values):
            different_keys += find_different_keys(*values, f"{prefix}{key}.")
        elif key not in first or key not in second or values[0] != values[1]:
            different_keys.append(f"{prefix}{key}")
    return different_keys
