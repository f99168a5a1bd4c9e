# SPDX-License-Identifier: GPL-3.0-or-later
"""A fixture of the tests of fast rigs: an arm of a studio."""

import pytest

from blend_fixtures.characters.dependencies import studio_arm
from fdda_addon.scene.scene_rig import SceneRig


@pytest.fixture
def scene_rig() -> SceneRig:
    """An arm with a control bone, a bone that nothing needs, and modifiers that a model replaces."""
    return SceneRig(*studio_arm())
