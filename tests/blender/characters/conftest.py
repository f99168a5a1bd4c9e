# SPDX-License-Identifier: GPL-3.0-or-later
"""Elbows in various units and places, recorded and trained once for all tests."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import bpy
import pytest

from fdda_addon.scene.blend_file import save_copy

from ..conftest import run, train


class Trained(NamedTuple):
    """The files of an elbow."""

    rig: Path
    recording: Path
    model: Path


@pytest.fixture(scope="session")
def trained_elbow(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Callable[[], object]], Trained]:
    """Return a function that builds, records and trains an elbow; it needs the registered add-on."""

    @cache
    def make(build: Callable[[], object]) -> Trained:
        folder = tmp_path_factory.mktemp(build.__name__)
        files = Trained(*(folder / name for name in ("rig.blend", "recording", "elbow.onnx")))
        bpy.ops.wm.read_factory_settings(use_empty=True)
        build()
        save_copy(files.rig)
        assert run("record", files.rig, files.recording, "--poses", 120) == 0
        train(files.recording, files.model, "--passes", 40)
        return files

    return make
