# SPDX-License-Identifier: GPL-3.0-or-later
"""Pose a model and write the mesh, with nothing but numpy and ONNX Runtime; made to be copied.

python play.py character.onnx posed.obj --turn elbow 80 0 0 --recording recording
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime

Turns = dict[str, tuple[float, ...]]
"""Degrees about the X, Y and Z axis of a joint, by its name."""


def load(path: str) -> tuple[onnxruntime.InferenceSession, dict]:
    """The model, ready to run, and what it says of itself."""
    try:
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's exceptions have no common base but this.
        sys.exit(f"ONNX Runtime cannot load {path}; name a model that 'train' has written. {error}")
    info = json.loads(session.get_modelmeta().custom_metadata_map.get("fdda", "{}"))
    if info.get("version") != 1:
        sys.exit(f"{path} is no FDDA model of version 1; name one that 'train' has written.")
    return session, info


def rotation(degrees: tuple[float, ...]) -> np.ndarray:
    """(4, 4), about X, then Y, then Z: the Euler angles XYZ of Blender."""
    matrix = np.eye(4)
    for axis, angle in enumerate(np.radians(degrees)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(4)
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
        matrix = turn @ matrix
    return matrix


def pose_matrices(info: dict, turns: Turns) -> np.ndarray:
    """(J, 4, 4) float32: some joints turned out of the rest pose, about their own axes, and with them all below."""
    rest = np.reshape(info["rest_matrices"], (-1, 4, 4))
    pose = rest.copy()
    for number, joint in enumerate(info["joints"]):  # every parent stands before its children
        if joint["parent"] >= 0:
            from_parent = np.linalg.inv(rest[joint["parent"]]) @ rest[number]
            pose[number] = pose[joint["parent"]] @ from_parent
        pose[number] = pose[number] @ rotation(turns.get(joint["name"], (0, 0, 0)))
    return pose.astype(np.float32)


def control_values(controls: list[dict], values: dict[str, float]) -> np.ndarray:
    """(C,) float32: a control that is not given is 0, or what of its range is nearest."""
    rest = [np.clip(0.0, control["low"], control["high"]) for control in controls]
    return np.float32([values.get(name_of(control), at) for control, at in zip(controls, rest, strict=True)])


def name_of(control: dict) -> str:
    return f"{control['owner']}/{control['path']}"


def read_faces(folder: Path, info: dict) -> list[np.ndarray]:
    """The vertices of each face, from the recording that the model was trained on."""
    if not (folder / "face_starts.npy").is_file():
        sys.exit(f"{folder} is no recording with faces; record the rig again, or leave --recording out.")
    recorded = json.loads((folder / "recording.json").read_text(encoding="utf-8"))["rig"]["fingerprint"]
    if recorded["topology"] != info["fingerprint"]["topology"]:
        sys.exit(f"{folder} is a recording of another mesh; name the one that the model was trained on.")
    starts, vertices = (np.load(folder / f"face_{name}.npy") for name in ("starts", "vertices"))
    return np.split(vertices, starts[1:])


def write_obj(path: Path, positions: np.ndarray, faces: list[np.ndarray]) -> None:
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in positions.tolist()]
    lines += ["f " + " ".join(str(vertex + 1) for vertex in face) for face in faces]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Pose a model and write the mesh.")
    parser.add_argument("model", help=".onnx file")
    parser.add_argument("out", type=Path, help=".obj file, or .npy file of an array (V, 3); mesh-object space")
    of_turns = {"nargs": 4, "metavar": ("JOINT", "X", "Y", "Z"), "help": "degrees"}
    of_controls = {"nargs": 2, "metavar": ("OWNER/PATH", "VALUE"), "help": "an input beside the joints"}
    parser.add_argument("--turn", **of_turns, action="append", default=[])
    parser.add_argument("--control", **of_controls, action="append", default=[])
    parser.add_argument("--recording", type=Path, help="folder of the recording, for the faces of the .obj file")
    arguments = parser.parse_args()
    try:
        arguments.turn = {name: tuple(map(float, angles)) for name, *angles in arguments.turn}
        arguments.control = {name: float(value) for name, value in arguments.control}
    except ValueError as error:
        parser.error(str(error))
    return arguments


def main() -> None:
    arguments = read_arguments()
    session, info = load(arguments.model)
    controls = info.get("controls", [])
    joints = [joint["name"] for joint in info["joints"] if joint["name"]]  # one without a name never moves
    for what, asked, known in (
        ("joint", arguments.turn, joints),
        ("control", arguments.control, [name_of(control) for control in controls]),
    ):
        if unknown := [name or "''" for name in asked if name not in known]:
            sys.exit(f"The model has no {what} {', '.join(unknown)}; it has: {', '.join(known) or 'none'}.")

    inputs = {"pose_matrices": pose_matrices(info, arguments.turn)[None]}  # N = 1 pose
    if controls:
        inputs["controls"] = control_values(controls, arguments.control)[None]
    positions, confidence = session.run(["positions", "confidence"], inputs)
    if arguments.out.suffix == ".npy":
        np.save(arguments.out, positions[0])
    else:
        write_obj(arguments.out, positions[0], read_faces(arguments.recording, info) if arguments.recording else [])
    print(f"{arguments.out}: {len(positions[0])} vertices, confidence {confidence.min():.2f}")


if __name__ == "__main__":
    main()
