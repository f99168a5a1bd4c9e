# SPDX-License-Identifier: GPL-3.0-or-later
"""An untrained model passes the checks of a model file, and is linear skinning."""

from dataclasses import replace

import numpy as np
import onnxruntime
import pytest

from fdda_addon.core.controls import Control
from fdda_addon.core.formats.model import CONTROLS_INPUT, POSE_INPUT, POSITIONS_OUTPUT, check_model
from fdda_addon.core.formats.untrained_model import build_untrained_model
from fdda_addon.core.mathematics.skinning import LinearSkinning

from ..limb import make_rig, random_poses

KEYS = tuple(Control("shape_keys", f'key_blocks["key {index}"].value', 0.0, 1.0) for index in range(40))


@pytest.mark.parametrize("controls", [(), (Control("armature_object", '["fist"]', 0.0, 1.0), *KEYS)])
def test_an_untrained_model_is_linear_skinning(controls):
    rig = replace(make_rig(), controls=controls)
    distances = {control.name: np.ones(rig.vertex_count) for control in KEYS}
    data = build_untrained_model(rig, distances)
    info = check_model(data, "untrained")
    assert info.meshes == rig.meshes and info.controls == controls and info.constant_bytes > 0
    poses = random_poses(5).astype(np.float32)
    inputs = {POSE_INPUT: poses}
    if controls:
        inputs[CONTROLS_INPUT] = np.ones((len(poses), len(controls)), np.float32)
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    (positions,) = session.run([POSITIONS_OUTPUT], inputs)
    np.testing.assert_allclose(positions, LinearSkinning(rig).positions(poses), atol=1e-5)


def test_a_mesh_without_weights_follows_the_nearest_joints():
    rig = make_rig()
    unweighted = replace(rig, skin_weights=np.zeros_like(rig.skin_weights))
    info = check_model(build_untrained_model(unweighted, {}), "untrained")
    assert len(info.partitions) > 1 and sum(partition.vertices for partition in info.partitions) == rig.vertex_count
