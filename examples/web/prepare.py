# SPDX-License-Identifier: GPL-3.0-or-later
"""Puts a model and the faces of its mesh beside the page: prepare.py MODEL RECORDING [FOLDER]."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import onnxruntime


def triangulate(starts: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """(T, 3) uint32: each face as a fan of triangles around its first corner.

    Args:
        starts: (F,) where each face begins in `vertices`.
        vertices: (C,) the corners of all faces.
    """
    sizes = np.diff(starts, append=len(vertices))
    first = np.repeat(starts, sizes - 2)
    # Corner numbers 1 .. size - 2 of each face: where its second edge of the fan begins.
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(sizes - 2) - (sizes - 2), sizes - 2)
    return vertices[np.stack([first, second, second + 1], axis=1)].astype("<u4")


def main(model: Path, recording: Path, folder: Path) -> None:
    try:
        session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's exceptions have no common base but this.
        sys.exit(f"ONNX Runtime cannot load {model}; name a model that 'train' has written. {error}")
    info = json.loads(session.get_modelmeta().custom_metadata_map.get("fdda", "{}"))
    if info.get("version") != 1:
        sys.exit(f"{model} is no FDDA model of version 1; name one that 'train' has written.")
    if not (recording / "face_starts.npy").is_file():
        sys.exit(f"{recording} is no recording with faces; record the rig again.")
    recorded = json.loads((recording / "recording.json").read_text(encoding="utf-8"))["rig"]["fingerprint"]
    if recorded["topology"] != info["fingerprint"]["topology"]:
        sys.exit(f"{recording} is a recording of another mesh; name the one that the model was trained on.")
    triangles = triangulate(*(np.load(recording / f"face_{name}.npy") for name in ("starts", "vertices")))
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(model, folder / "model.onnx")
    (folder / "triangles.bin").write_bytes(triangles.tobytes())
    print(f"{folder}: model.onnx, triangles.bin ({len(triangles)} triangles)")


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    main(*map(Path, sys.argv[1:3]), Path(sys.argv[3] if len(sys.argv) == 4 else Path(__file__).parent / "dist"))
