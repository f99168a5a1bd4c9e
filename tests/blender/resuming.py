# SPDX-License-Identifier: GPL-3.0-or-later
"""Interrupts a recording with fitted weights and resumes it."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.folder import read_folder
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.scene.scene_rig import SceneRig
from fdda_addon.training.environment.choice import PYTHON_VARIABLE

from .scene_state import assert_same_state, drain, scene_state


def check_resuming(
    rig: SceneRig,
    folder: Path,
    settings: RecordingSettings,
    others: Iterable[RecordingSettings],
    options: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Resume an interrupted recording, and compare it with one that was not interrupted.

    Args:
        rig: the rig.
        folder: an empty folder.
        settings: settings of the recordings.
        others: other settings, with which resuming is refused.
        options: the options of `record` that the refusal names.
        monkeypatch: takes the trainer's Python away for the resumed recording, which contains the weights.
    """
    before = scene_state(rig)
    drain(record(rig, folder / "whole", settings))
    assert_same_state(before, scene_state(rig))
    steps = record(rig, folder / "broken", settings)
    for step in steps:
        if step.stage == "poses" and step.done == 30:
            break
    steps.close()
    assert read_folder(folder / "broken").complete == 30
    monkeypatch.setenv(PYTHON_VARIABLE, "/none/python")
    for other in others:
        with pytest.raises(RecordingError) as error:
            drain(record(rig, folder / "broken", replace(other, resume=True)))
        assert str(error.value) == (
            f"Cannot resume '{folder / 'broken'}': it was recorded with {options}; give that, or record into another "
            "folder."
        )
    drain(record(rig, folder / "broken", replace(settings, resume=True)))
    for file in (folder / "whole").iterdir():
        assert file.read_bytes() == (folder / "broken" / file.name).read_bytes(), file.name
