# SPDX-License-Identifier: GPL-3.0-or-later
"""Pose a model and write the deformed meshes, with only numpy and ONNX Runtime. Copy this code into other programs.

python play.py character.onnx posed.obj --turn elbow 80 0 0 --recording recording
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

Rotations = dict[str, tuple[float, ...]]
"""Rotations by name of the joint: degrees about its X, Y and Z axes."""


def load(path: str) -> tuple[onnxruntime.InferenceSession, dict]:
    """Load a model; return its session and its metadata."""
    try:
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    except Exception as error:  # The exceptions of ONNX Runtime have no other common base class.
        sys.exit(f"ONNX Runtime cannot load {path}; choose a model that 'train' has written. {error}")
    info = json.loads(session.get_modelmeta().custom_metadata_map.get("fdda", "{}"))
    if info.get("version") != 1:
        sys.exit(f"{path} is not an FDDA model of version 1; choose one that 'train' has written.")
    return session, info


def rotation(degrees: tuple[float, ...]) -> np.ndarray:
    """Return the (4, 4) rotation about X, then Y, then Z: Blender's Euler order XYZ."""
    matrix = np.eye(4)
    for axis, angle in enumerate(np.radians(degrees)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        axis_rotation = np.eye(4)
        axis_rotation[i, i] = axis_rotation[j, j] = np.cos(angle)
        axis_rotation[j, i], axis_rotation[i, j] = np.sin(angle), -np.sin(angle)
        matrix = axis_rotation @ matrix
    return matrix


def pose_matrices(info: dict, rotations: Rotations) -> np.ndarray:
    """Return the (J, 4, 4) float32 pose matrices of the rest pose with some joints rotated about their local axes."""
    rest = np.reshape(info["rest_matrices"], (-1, 4, 4))
    pose = rest.copy()
    for index, joint in enumerate(info["joints"]):  # every parent comes before its children
        if joint["parent"] >= 0:
            from_parent = np.linalg.inv(rest[joint["parent"]]) @ rest[index]
            pose[index] = pose[joint["parent"]] @ from_parent
        pose[index] = pose[index] @ rotation(rotations.get(joint["name"], (0, 0, 0)))
    return pose.astype(np.float32)


def control_values(controls: list[dict], values: dict[str, float]) -> np.ndarray:
    """Return the (C,) float32 control values; the default of a control is the value in its range nearest to 0."""
    defaults = [np.clip(0.0, control["low"], control["high"]) for control in controls]
    return np.float32(
        [values.get(control_name(control), default) for control, default in zip(controls, defaults, strict=True)]
    )


def control_name(control: dict) -> str:
    return f"{control['owner']}/{control['path']}"


def read_faces(folder: Path, info: dict) -> list[np.ndarray]:
    """Read the vertices of each face from the recording that the model was trained on."""
    if not (folder / "face_starts.npy").is_file():
        sys.exit(f"{folder} is not a recording with faces; record the rig again, or leave out --recording.")
    index = json.loads((folder / "recording.json").read_text(encoding="utf-8"))
    recorded, trained = ([mesh["fingerprint"]["topology"] for mesh in each["meshes"]] for each in (index, info))
    if recorded != trained:
        sys.exit(f"{folder} is a recording of a different mesh; choose the one that the model was trained on.")
    starts, vertices = (np.load(folder / f"face_{name}.npy") for name in ("starts", "vertices"))
    return np.split(vertices, starts[1:])


def write_obj(path: Path, info: dict, positions: np.ndarray, faces: list[np.ndarray]) -> None:
    """Write the meshes as objects of one file, in the space of the first."""
    lines, start = [], 0
    for mesh in info["meshes"]:
        end = start + mesh["vertices"]
        lines.append(f"o {mesh['name']}")
        lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in positions[start:end].tolist()]
        lines += ["f " + " ".join(str(vertex + 1) for vertex in face) for face in faces if start <= face[0] < end]
        start = end
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Pose a model and write the meshes.")
    parser.add_argument("model", help=".onnx file")
    parser.add_argument("out", type=Path, help=".obj file, or .npy file of an array (V, 3); mesh-object space")
    turn_options = {"nargs": 4, "metavar": ("JOINT", "X", "Y", "Z"), "help": "rotate a joint; degrees"}
    control_options = {"nargs": 2, "metavar": ("OWNER/PATH", "VALUE"), "help": "set a control"}
    parser.add_argument("--turn", **turn_options, action="append", default=[])
    parser.add_argument("--extra-input", **control_options, action="append", default=[])
    parser.add_argument("--recording", type=Path, help="folder of the recording, for the faces of the .obj file")
    arguments = parser.parse_args()
    try:
        arguments.turn = {name: tuple(map(float, angles)) for name, *angles in arguments.turn}
        arguments.extra_input = {name: float(value) for name, value in arguments.extra_input}
    except ValueError as error:
        parser.error(str(error))
    return arguments


def main() -> None:
    arguments = read_arguments()
    session, info = load(arguments.model)
    controls = info.get("controls", [])
    joints = [joint["name"] for joint in info["joints"] if joint["name"]]  # a joint without a name never moves
    for kind, requested_names, known_names in (
        ("joint", arguments.turn, joints),
        ("control", arguments.extra_input, [control_name(control) for control in controls]),
    ):
        if unknown := [name or "''" for name in requested_names if name not in known_names]:
            sys.exit(f"The model has no {kind} {', '.join(unknown)}; it has: {', '.join(known_names) or 'none'}.")

    inputs = {"pose_matrices": pose_matrices(info, arguments.turn)[None]}  # N = 1 pose
    if controls:
        inputs["controls"] = control_values(controls, arguments.extra_input)[None]
    positions, confidence = session.run(["positions", "confidence"], inputs)
    if arguments.out.suffix == ".npy":
        np.save(arguments.out, positions[0])
    else:
        write_obj(
            arguments.out, info, positions[0], read_faces(arguments.recording, info) if arguments.recording else []
        )
    print(f"{arguments.out}: {len(positions[0])} vertices, confidence {confidence.min():.2f}")


if __name__ == "__main__":
    main()
