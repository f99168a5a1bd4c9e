# SPDX-License-Identifier: GPL-3.0-or-later
"""The index of a recording, `recording.json`: what it says beside the arrays, read and checked."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from .controls import read_controls
from .errors import RecordingError
from .poses import Channel
from .rig import Fingerprint
from .skin_fit import SkinFit
from .surface import LEAST_CORNERS
from .unit import read_unit

FORMAT = "fdda-recording"
VERSION = 1
INDEX = "recording.json"
MAX_INDEX_BYTES = 64 << 20
RANDOM, ACTION, STRIP, MIRRORED = "random", "action", "strip", "mirrored"
"""Kinds of the poses that a recording is made of: drawn at random, frames of an action, frames of a strip of the NLA,
and the frames of the source before, left and right exchanged."""
REFINED = "refined"
"""Kind of the poses that were added where a model was worst: no sample of the range of motion, so never held out."""


@dataclass(frozen=True)
class Source:
    """Where poses of a recording came from.

    Attributes:
        kind: `RANDOM`, `ACTION`, `STRIP`, `MIRRORED` or `REFINED`.
        poses: how many.
        name: of the action or strip, mirrored or not; file name of the model that refined poses were chosen for; empty
            for random poses.
        frames: first frame of the action or strip and the step between poses, (0, 0) for other poses.
    """

    kind: str
    poses: int
    name: str = ""
    frames: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Sampling:
    """How the poses were chosen."""

    seed: int
    spread: float
    channels: tuple[Channel, ...]
    sources: tuple[Source, ...]

    def to_json(self) -> dict:
        return {
            "seed": self.seed,
            "spread": self.spread,
            "limits": [channel.to_json() for channel in self.channels],
            "sources": [asdict(source) for source in self.sources],
        }


@dataclass(frozen=True)
class RecordingInfo:
    """What `recording.json` says beside the arrays; `fit` where its skin weights are not the rig's own."""

    poses: int
    complete: int
    rig_file: str
    object_name: str
    blender: str
    sampling: Sampling
    fit: SkinFit | None = None


def read_index(path: Path) -> dict:
    """Read `recording.json` of a recording, complete or not, and check the types of its values.

    Raises:
        RecordingError: it is missing, damaged, or of another version.
    """
    index_path = path / INDEX
    try:
        if index_path.stat().st_size > MAX_INDEX_BYTES:
            raise RecordingError(f"'{index_path}' is larger than {MAX_INDEX_BYTES >> 20} MB; it is no recording.")
        index = json.loads(index_path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise RecordingError(f"'{path}' is not a recording: it has no {INDEX}; make one with record.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f"'{index_path}' cannot be read ({error}); record again.") from error
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise RecordingError(f"'{index_path}' is not the index of a recording; give a folder that record made.")
    if index.get("version") != VERSION:
        raise RecordingError(
            f"'{path}' is a recording of version {index.get('version')!r} and this add-on reads version {VERSION}; "
            "record again."
        )
    try:
        _check_index(index)
    except KeyError as error:
        raise RecordingError(f"'{index_path}' is damaged: it lacks {error}; record again.") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordingError(f"'{index_path}' is damaged: {error}; record again.") from error
    return index


def _check_index(index: dict) -> None:
    for key in ("poses", "complete", "vertices", "influences"):
        if type(index[key]) is not int or index[key] < 0:
            raise ValueError(f"'{key}' is {index[key]!r}")
    if index["complete"] > index["poses"] or not index["vertices"] or not index["influences"]:
        raise ValueError("its counts contradict each other")
    for key in ("faces", "corners"):
        if type(index.get(key, 0)) is not int or index.get(key, 0) < 0:
            raise ValueError(f"'{key}' is {index[key]!r}")
    if index.get("corners", 0) < LEAST_CORNERS * index.get("faces", 0):
        raise ValueError(f"{index['faces']} faces cannot have {index.get('corners', 0)} corners")
    controls = read_controls(index["controls"])
    for text in (index["blender"], index["rig"]["file"], index["rig"]["object"]):
        if not isinstance(text, str):
            raise TypeError(f"{text!r} stands where text belongs")
    names = [str(joint["name"]) for joint in index["joints"]]
    if len(set(names)) != len(names) or not names:
        raise ValueError("it has no joints, or two of one name")
    for number, joint in enumerate(index["joints"]):
        if type(joint["parent"]) is not int or not -1 <= joint["parent"] < number:
            raise ValueError(f"the parent of joint {joint['name']!r} is {joint['parent']!r}")
    for partition in index["partitions"]:
        for joint in (partition["joint"], *partition["influencing"], *partition.get("merged", ())):
            if type(joint) is not int or not 0 <= joint < len(names):
                raise ValueError(f"a partition has joint {joint!r} of {len(names)}")
        for control in partition.get("controls", ()):
            if type(control) is not int or not 0 <= control < len(controls):
                raise ValueError(f"a partition has control {control!r} of {len(controls)}")
    Fingerprint(**index["rig"]["fingerprint"])
    read_unit(index)
    if "fit" in index:
        SkinFit.from_json(index["fit"])
    for source in _sampling(index["sampling"]).sources:
        if type(source.poses) is not int or source.poses < 0:
            raise ValueError(f"a source has {source.poses!r} poses")


def _sampling(value: dict) -> Sampling:
    return Sampling(
        int(value["seed"]),
        float(value["spread"]),
        tuple(Channel(**channel) for channel in value["limits"]),
        tuple(Source(s["kind"], s["poses"], s["name"], tuple(s["frames"])) for s in value["sources"]),
    )


def read_info(index: dict) -> RecordingInfo:
    """What an index says beside the arrays."""
    return RecordingInfo(
        index["poses"],
        index["complete"],
        index["rig"]["file"],
        index["rig"]["object"],
        index["blender"],
        _sampling(index["sampling"]),
        SkinFit.from_json(index["fit"]) if "fit" in index else None,
    )
