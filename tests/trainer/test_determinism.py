# SPDX-License-Identifier: GPL-3.0-or-later
"""The same recording, settings and seed give the same model, from one process to the next."""

from pathlib import Path

from .conftest import start_trainer


def test_two_processes_write_the_same_model(recording, tmp_path: Path):
    model_bytes = {}
    for name, seed in (("first", 3), ("second", 3), ("other", 4)):
        model = tmp_path / name / "model.onnx"
        model.parent.mkdir()
        process = start_trainer(recording, model, "--passes", "5", "--seed", str(seed))
        assert process.communicate()[1] == "" and process.returncode == 0
        model_bytes[name] = model.read_bytes()
    assert model_bytes["first"] == model_bytes["second"] != model_bytes["other"]
