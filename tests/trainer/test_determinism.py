# SPDX-License-Identifier: GPL-3.0-or-later
"""The same recording, settings and seed give the same model, from one process to the next."""

from pathlib import Path

import pytest

from .conftest import start_trainer


@pytest.mark.parametrize(
    "options", [(), pytest.param(("--dropout", "0.1"), marks=pytest.mark.slow)], ids=["defaults", "dropout"]
)
def test_two_processes_write_the_same_model(recording, tmp_path: Path, options):
    model_bytes = {}
    for name, seed in (("first", 3), ("second", 3), ("other", 4)):
        model = tmp_path / name / "model.onnx"
        model.parent.mkdir()
        process = start_trainer(recording, model, "--epochs", "5", "--seed", str(seed), *options)
        assert process.communicate()[1] == "" and process.returncode == 0
        model_bytes[name] = model.read_bytes()
    assert model_bytes["first"] == model_bytes["second"] != model_bytes["other"]
