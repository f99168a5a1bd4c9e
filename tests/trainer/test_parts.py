# SPDX-License-Identifier: GPL-3.0-or-later
"""A partition is divided where its parts need different shape keys; the parts are trained and continued as one."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.controls import Control
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.runtime.network import Network
from trainer import preparation
from trainer.__main__ import main
from trainer.fits import parts
from trainer.fits.joint_fit import JointFit
from trainer.fits.parts import divide_by_mesh, divide_partition, mesh_of

from ..recordings import write_recording
from .chain import chain_angles, chain_info, chain_rig, pose_chain
from .conftest import QUICK_OPTIONS

POSES, KEYS = 150, 8


def key_motions(vertex_count: int) -> np.ndarray:
    """Return (3 KEYS, V) motions: half of the keys move the odd vertices, the others the even ones."""
    motions = np.random.default_rng(0).normal(0, 0.01, (KEYS, 3, vertex_count))
    motions[: KEYS // 2, :, ::2] = 0
    motions[KEYS // 2 :, :, 1::2] = 0
    return motions.reshape(3 * KEYS, vertex_count).astype(np.float32)


@pytest.mark.parametrize("vertex_count", [200, 4000])
def test_vertices_with_different_keys_are_divided_if_they_are_many(vertex_count):
    factors = np.zeros((4, vertex_count), np.float32)
    fit = JointFit(np.zeros(1, np.int64), factors, np.arange(KEYS), key_motions(vertex_count))
    groups = divide_partition(fit, np.full(KEYS, 0.3), 4e-5)
    if vertex_count == 200:
        assert [group.tolist() for group in groups] == [list(range(200))]
    else:
        assert sorted(group[:3].tolist() for group in groups) == [[0, 2, 4], [1, 3, 5]]


@pytest.mark.parametrize(
    "counts, min_vertices, expected", [((4, 5), 4, [4, 5]), ((4, 5), 5, [9]), ((2, 3, 2, 4), 3, [3, 8])]
)
def test_partitions_are_divided_by_mesh_where_each_mesh_has_enough_vertices(counts, min_vertices, expected):
    rig = chain_rig(vertex_count=100 + sum(counts))
    rig = replace(rig, meshes=tuple(replace(rig.meshes[0], vertices=count) for count in (100, *counts)))
    partition = Partition(0, (), np.arange(100, 100 + sum(counts), dtype=np.int32))
    divided = sorted(divide_by_mesh(rig, [partition], min_vertices), key=lambda part: len(part.vertices))
    assert [len(part.vertices) for part in divided] == expected
    assert np.array_equal(np.sort(np.concatenate([part.vertices for part in divided])), partition.vertices)
    assert all((np.diff(part.vertices) > 0).all() for part in divided)
    if len(expected) == len(counts):
        assert [mesh_of(rig, part) for part in divided] == [1, 2]


@pytest.fixture
def divided(tmp_path, monkeypatch) -> Path:
    """Return a folder with a recording, and a model that divides its partitions."""
    monkeypatch.setattr(preparation, "MIN_DIVIDED_VERTICES", 50)
    monkeypatch.setattr(parts, "PART_PARAMETERS", 100)
    keys = tuple(Control("shape_keys", f'key_blocks["{index}"].value', 0, 1) for index in range(KEYS))
    rig = replace(chain_rig(vertex_count=300), controls=keys)
    values = np.random.default_rng(1).uniform(0, 1, (POSES, KEYS)).astype(np.float32)
    poses = pose_chain(rig, chain_angles(POSES, 3, 0))
    residuals = (values @ key_motions(300).reshape(KEYS, -1)).reshape(POSES, 3, 300).transpose(0, 2, 1).copy()
    # The product of the first two keys is not linear.
    residuals[:, 1::2, 0] += 0.01 * values[:, :1] * values[:, 1:2]
    influences = {0: (), 1: (1,), 2: (2,)}, {joint: tuple(range(KEYS)) for joint in range(3)}
    arrays = poses, residuals, values
    write_recording(tmp_path / "recording", rig, make_partitions(rig, *influences), chain_info(POSES), *arrays)
    assert main([str(tmp_path / "recording"), str(tmp_path / "model.onnx"), *QUICK_OPTIONS]) == 0
    np.savez(tmp_path / "truth", poses=poses, values=values, residuals=residuals)
    return tmp_path


def test_a_divided_partition_is_one_partition_of_the_model(divided):
    report = json.loads((divided / "report.json").read_text())
    assert [p["parts"] for p in report["partitions"]] == [2, 2, 2]
    assert len(read_model_info(divided / "model.onnx").partitions) == 3
    network, truth = Network(divided / "model.onnx"), np.load(divided / "truth.npz")
    rig = chain_rig(vertex_count=300)
    expected = LinearSkinning(rig, make_partitions(rig)).complex_positions(truth["poses"], truth["residuals"])
    errors = np.linalg.norm(network.positions(truth["poses"], truth["values"]) - expected, axis=2)
    assert errors.mean() < 3e-4 and report["fdda"]["held_out"]["mean"] < 0.3
    assert network.confidence(truth["poses"], truth["values"]).shape == (POSES, 3)


def test_a_warm_start_keeps_the_parts(divided, monkeypatch):
    before = json.loads((divided / "report.json").read_text())
    monkeypatch.setattr(parts, "PART_PARAMETERS", 1e9)
    options = (*QUICK_OPTIONS, "--passes", "10", "--warm-start")
    assert main([str(divided / "recording"), str(divided / "model.onnx"), *options]) == 0
    after = json.loads((divided / "report.json").read_text())
    assert [p["parts"] for p in after["partitions"]] == [2, 2, 2]
    assert after["fdda"]["held_out"]["mean"] < 1.5 * before["fdda"]["held_out"]["mean"]
