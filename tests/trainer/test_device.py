# SPDX-License-Identifier: GPL-3.0-or-later
"""The choice of the device that trains, and graphics cards that are too old, busy, or too small."""

import json
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from trainer import train
from trainer.__main__ import main
from trainer.device import CPU, GPU, TrainingDevice, choose_device

from .conftest import QUICK_OPTIONS

CARD = "GeForce GTX 960M"


@pytest.fixture(autouse=True)
def fresh_choice() -> Iterator[None]:
    choose_device.cache_clear()
    yield
    choose_device.cache_clear()


def raise_error(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    ("error", "problem"),
    [
        (
            torch.AcceleratorError("CUDA error: no kernel image is available for execution on the device\nSearch for"),
            "CUDA error: no kernel image is available for execution on the device",
        ),
        (
            RuntimeError("CUDA error: all CUDA-capable devices are busy or unavailable\n"),
            "CUDA error: all CUDA-capable devices are busy or unavailable",
        ),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has"), "CUDA out of memory"),
        (AssertionError("Torch not compiled with CUDA enabled"), "Torch not compiled with CUDA enabled"),
    ],
)
def test_a_card_that_cannot_run_a_kernel_is_not_chosen(monkeypatch: pytest.MonkeyPatch, error: Exception, problem: str):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _index: CARD)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: raise_error(error))
    ones = torch.ones
    monkeypatch.setattr(torch, "ones", lambda *shape, device, **options: ones(*shape, **options))
    assert choose_device() == TrainingDevice(CPU, CARD, problem)
    choose_device.cache_clear()
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    assert choose_device() == TrainingDevice(GPU, CARD)


def test_a_driver_that_is_too_old_is_named(monkeypatch: pytest.MonkeyPatch):
    text = "CUDA initialization: The NVIDIA driver on your system is too old (found version 11040). Please update"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: bool(warnings.warn(text, stacklevel=1)))
    problem = "CUDA initialization: The NVIDIA driver on your system is too old (found version 11040)"
    assert choose_device() == TrainingDevice(CPU, "the graphics card", problem)


def test_the_cpu_trains_what_a_card_fails_to_train(
    recording: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """The device "meta" has no memory, so the training fails on it after its first steps."""
    monkeypatch.setattr(train, "choose_device", lambda: TrainingDevice("meta", CARD))
    assert main([str(recording), str(tmp_path / "model.onnx"), "--messages", *QUICK_OPTIONS]) == 0
    messages = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (text,) = [message["text"] for message in messages if message.get("name") == "graphics-card"]
    assert text.startswith(f"{CARD} cannot be used (") and text.endswith(
        "), so the CPU trains this model, more slowly."
    )
    assert [message["device"] for message in messages if message["type"] == "started"] == ["meta"]
    assert json.loads((tmp_path / "report.json").read_text())["training"]["device"] == CPU
    assert (tmp_path / "model.onnx").read_bytes() == (trained / "model.onnx").read_bytes()
