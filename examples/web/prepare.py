# SPDX-License-Identifier: GPL-3.0-or-later
"""Copy a model and the faces of its mesh to the folder of the page: prepare.py MODEL RECORDING [FOLDER]."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import onnxruntime


def triangulate(starts: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Split each face into a fan of triangles around its first corner.

    Args:
        starts: (F,) index of the first corner of each face in `vertices`.
        vertices: (C,) vertex of each corner of all faces.

    Returns:
        (T, 3) uint32 vertices of the triangles.
    """
    corner_counts = np.diff(starts, append=len(vertices))
    first_corners = np.repeat(starts, corner_counts - 2)
    # The second corners of a face's triangles are its corners 1 to n - 2; n is its number of corners.
    second_corners = (
        first_corners
        + 1
        + np.arange(len(first_corners))
        - np.repeat(np.cumsum(corner_counts - 2) - (corner_counts - 2), corner_counts - 2)
    )
    return vertices[np.stack([first_corners, second_corners, second_corners + 1], axis=1)].astype("<u4")


def main(model: Path, recording: Path, folder: Path) -> None:
    try:
        session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    except Exception as error:  # The exceptions of ONNX Runtime have no other common base class.
        sys.exit(f"ONNX Runtime cannot load {model}; choose a model that 'train' has written. {error}")
    info = json.loads(session.get_modelmeta().custom_metadata_map.get("fdda", "{}"))
    if info.get("version") != 1:
        sys.exit(f"{model} is not an FDDA model of version 1; choose one that 'train' has written.")
    if not (recording / "face_starts.npy").is_file():
        sys.exit(f"{recording} is not a recording with faces; record the rig again.")
    index = json.loads((recording / "recording.json").read_text(encoding="utf-8"))
    recorded, trained = ([mesh["fingerprint"]["topology"] for mesh in each["meshes"]] for each in (index, info))
    if recorded != trained:
        sys.exit(f"{recording} is a recording of a different mesh; choose the one that the model was trained on.")
    triangles = triangulate(*(np.load(recording / f"face_{name}.npy") for name in ("starts", "vertices")))
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(model, folder / "model.onnx")
    (folder / "triangles.bin").write_bytes(triangles.tobytes())
    print(f"{folder}: model.onnx, triangles.bin ({len(triangles)} triangles)")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    main(*map(Path, sys.argv[1:3]), Path(sys.argv[3] if len(sys.argv) == 4 else Path(__file__).parent / "dist"))
