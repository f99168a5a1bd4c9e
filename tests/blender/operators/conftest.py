# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures of the tests of operators: an arm with control bones, and a face with shape keys."""

from pathlib import Path

import pytest

from blend_fixtures.characters import control_rigs, controls
from fdda_addon.scene.scene_rig import SceneRig

from ..arm_and_face import saved


@pytest.fixture
def arm(tmp_path: Path) -> SceneRig:
    """An arm that is posed by an IK and an FK chain, which its deforming bones copy."""
    control_rigs.ik_fk()
    return saved(tmp_path)


@pytest.fixture
def face(tmp_path: Path) -> SceneRig:
    """Two shape keys that an animator sets by hand."""
    controls.free_shape_keys()
    return saved(tmp_path)
