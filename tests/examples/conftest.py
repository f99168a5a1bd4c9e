# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures: two small models, trained once: of one mesh, and of two with a shape key and a static joint."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import bpy  # noqa: F401  it includes mathutils
import numpy as np
import pytest
from mathutils import Euler, Matrix

from fdda_addon.core.controls import Control
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.rig import STATIC_JOINT, Joint
from trainer.__main__ import main as train

from ..recordings import write_recording
from ..trainer.chain import chain_angles, chain_residuals, chain_rig, pose_chain, write_chain

ROOT = Path(__file__).resolve().parents[2]
JOINTS, POSES = 4, 100
PIPE_VERTICES = 40
"""Number of vertices of the lower of two meshes."""
CONTROL = Control("shape_keys:hose", 'key_blocks["bulge"].value', 0.25, 1.0)
Rotations = dict[str, tuple[float, float, float]]
"""Rotations by name of the joint: degrees about its X, Y and Z axes."""


@dataclass(frozen=True)
class Character:
    """A model and the recording that it was trained on."""

    model: Path
    recording: Path


def train_character(recording: Path) -> Character:
    model = recording.with_suffix(".onnx")
    assert train([str(recording), str(model), "--passes", "20", "--hidden", "16", "16", "--batch-size", "16"]) == 0
    return Character(model, recording)


@pytest.fixture(scope="session")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Character:
    """Return a model of a tube on a chain of joints, bone_0 to bone_3."""
    recording = tmp_path_factory.mktemp("chain") / "recording"
    write_chain(recording, POSES, joint_count=JOINTS)
    return train_character(recording)


@pytest.fixture(scope="session")
def controlled_chain(tmp_path_factory: pytest.TempPathFactory) -> Character:
    """Return a model of a pipe, whose lowest vertices have no bone, and of a hose on it with a shape key."""
    recording = tmp_path_factory.mktemp("controlled") / "recording"
    rig, angles = chain_rig(JOINTS), chain_angles(POSES, JOINTS, seed=1)
    order = np.argsort(rig.rest_positions[:, 2])
    names = ("rest_positions", "skin_joints", "skin_weights")
    rig = replace(rig, **{name: getattr(rig, name)[order] for name in names})
    faces = np.argsort(order)[rig.face_vertices].reshape(-1, 3)
    faces = faces[(faces < PIPE_VERTICES).all(axis=1) | (faces >= PIPE_VERTICES).all(axis=1)].astype(np.int32)
    (mesh,) = rig.meshes
    hose_vertices = mesh.vertices - PIPE_VERTICES
    raised = (1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1)
    values = np.random.default_rng(2).uniform(CONTROL.low, CONTROL.high, (POSES, 1)).astype(np.float32)
    poses, residuals = pose_chain(rig, angles), chain_residuals(rig, angles)
    residuals[:, PIPE_VERTICES:, 1] += 0.05 * values
    is_static = rig.rest_positions[:, 2] < 0.15
    residuals[:, is_static] = 0
    rig = replace(
        rig,
        joints=(*rig.joints, Joint(STATIC_JOINT, -1)),
        rest_matrices=np.concatenate([rig.rest_matrices, np.eye(4, dtype=np.float32)[None]]),
        skin_joints=np.where(is_static[:, None], [JOINTS, 0], rig.skin_joints).astype(np.int32),
        skin_weights=np.where(is_static[:, None], [1, 0], rig.skin_weights).astype(np.float32),
        controls=(CONTROL,),
        meshes=(
            replace(mesh, name="pipe", vertices=PIPE_VERTICES),
            replace(mesh, name="hose", vertices=hose_vertices, transform=raised),
        ),
        face_starts=np.arange(0, faces.size, 3, dtype=np.int32),
        face_vertices=faces.ravel(),
    )
    poses = np.concatenate([poses, np.broadcast_to(np.eye(4, dtype=np.float32), (POSES, 1, 4, 4))], axis=1)
    moving_joints = {joint: tuple(i for i in (joint, joint + 1) if 0 < i < JOINTS) for joint in range(JOINTS)}
    partitions = make_partitions(rig, moving_joints, {joint: (0,) for joint in range(JOINTS)})
    info = RecordingInfo(POSES, 0, "chain.blend", "5.2.0", Sampling(1, 1.0, (), (Source("random", POSES),)))
    write_recording(recording, rig, partitions, info, poses, residuals, values)
    return train_character(recording)


def blender_pose(info: dict, rotations: Rotations) -> np.ndarray:
    """Compute pose matrices with Blender's mathutils: (1, J, 4, 4) float32."""
    rest = [Matrix([row[start : start + 4] for start in (0, 4, 8, 12)]) for row in info["rest_matrices"]]
    pose: list[Matrix] = []
    for index, joint in enumerate(info["joints"]):
        rotation = Euler(np.radians(rotations.get(joint["name"], (0, 0, 0))), "XYZ").to_matrix().to_4x4()
        parent = joint["parent"]
        unrotated = rest[index] if parent < 0 else pose[parent] @ rest[parent].inverted() @ rest[index]
        pose.append(unrotated @ rotation)
    return np.array(pose, np.float32)[None]


def expected_positions(model: Path, rotations: Rotations, controls: tuple[float, ...] = ()) -> np.ndarray:
    """Compute the vertex positions of a pose with the add-on's runtime: (V, 3), meters."""
    from fdda_addon.runtime.network import Network

    network = Network(model)
    pose = blender_pose(json.loads(network.info.to_json()), rotations)
    return network.positions(pose, np.float32([controls]) if controls else None)[0].copy()
