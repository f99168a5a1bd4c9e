# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about a recording are sent as messages and shown in the report. A strict training fails on them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.formats.messages import Message, MessageType
from trainer.__main__ import main

from .conftest import QUICK_OPTIONS


@pytest.fixture(scope="module")
def suspicious_recording(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of the chain. Thirty of its 120 poses repeat an earlier pose, one of them with other positions."""
    path = shutil.copytree(recording, tmp_path_factory.mktemp("suspicious") / "recording")
    for name in ("pose_matrices", "positions"):
        array = np.load(path / f"{name}.npy", mmap_mode="r+")
        array[20:51] = array[20]
        if name == "positions":
            array[50, :, 0] += 0.0005
        array.flush()
    return path


WARNING_NAMES = ["duplicate-poses", "hidden-inputs"]


def test_warnings_are_sent_before_the_training_and_reported(suspicious_recording, tmp_path, capsys):
    assert (
        main([str(suspicious_recording), str(tmp_path / "m.onnx"), "--messages", *QUICK_OPTIONS[2:], "--passes", "2"])
        == 0
    )
    messages = [Message.decode(line) for line in capsys.readouterr().out.splitlines()]
    log = MessageType.LOG
    first_message_types = [MessageType.STARTED, log, *[MessageType.WARNING] * 2, log, MessageType.PREPARING]
    assert [m.type for m in messages[:6]] == first_message_types
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert [w["name"] for w in report["warnings"]] == WARNING_NAMES
    assert [m.values for m in messages[2:4]] == report["warnings"]
    assert report["warnings"][0]["text"].startswith("30 of 120 poses repeat an earlier one, such as pose 21 pose 20")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<h2>Warnings</h2>" in page and page.count("<dt>hidden-inputs</dt>") == 1
    assert "Poses 20 and 50 have the same joints and controls" in page


@pytest.mark.parametrize("messages", [[], ["--messages"]])
def test_a_strict_training_fails_before_it_starts(suspicious_recording, tmp_path, capsys, messages):
    assert main([str(suspicious_recording), str(tmp_path / "m.onnx"), "--strict", *messages, *QUICK_OPTIONS]) == 1
    output = capsys.readouterr()
    assert output.err.startswith("30 of 120 poses repeat an earlier one, such as pose 21 pose 20: ")
    assert output.err.endswith(" (duplicate-poses; 1 more: hidden-inputs).\n")
    assert output.err.count("\n") == 1
    expected_warning = (
        '{"type": "warning", "name": "hidden-inputs", "text": ' if messages else "Warning (hidden-inputs): "
    )
    assert expected_warning in output.out
    assert ("epoch" in output.out, list(tmp_path.iterdir())) == (False, [])
