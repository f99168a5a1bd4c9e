# SPDX-License-Identifier: GPL-3.0-or-later
"""What a Python answers when it is asked whether it can train, or be the base of an environment."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fdda_addon.training.environment import bases, check
from fdda_addon.training.environment.answer import Answer
from fdda_addon.training.environment.bases import ask, find_bases
from fdda_addon.training.environment.choice import PYTHON_VARIABLE
from fdda_addon.training.environment.folder import MARK, PACKAGES

from .conftest import run
from .tiny_wheels import TORCH

ROOT = Path(__file__).resolve().parents[2]
ADVICE = "do this"


def script(path: Path, *lines: str) -> str:
    """A program in place of a Python."""
    path.write_text("\n".join(["#!/bin/sh", *lines, ""]))
    path.chmod(0o755)
    return str(path)


def asked(python: object) -> Answer:
    return check.check(str(python), ADVICE)


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that Python imports from before all others, with a module for each package."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "packages"))
    for name in PACKAGES:
        (tmp_path / "packages" / name).mkdir(parents=True)
        (tmp_path / "packages" / name / "__init__.py").write_text(
            (TORCH if name == "torch" else "").replace("{version}", "9")
        )
    return tmp_path / "packages"


def test_it_can_train(packages: Path):
    answer = asked(sys.executable)
    version = ".".join(map(str, sys.version_info[:3]))
    assert answer.level == "INFO" and answer.message == f"Ready to train on the processor: Python {version}, torch 9."
    assert answer.details[0] == f"Python {version}: {sys.executable}" and answer.details[-1] == "Device: the processor"


def test_the_command_line_says_it_too(packages: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture):
    monkeypatch.setenv(PYTHON_VARIABLE, sys.executable)
    assert run("check-trainer") == 0
    assert capfd.readouterr().out.splitlines()[-1].startswith("Ready to train on the processor: ")
    monkeypatch.setenv(PYTHON_VARIABLE, "/none/python")
    assert run("check-trainer") == 1
    assert capfd.readouterr().err == (
        "Error: The trainer's Python '/none/python' cannot be started (No such file or directory); set "
        "FDDA_TRAINER_PYTHON to a Python that has torch.\n"
    )


def test_the_device_is_named(packages: Path):
    (packages / "torch/__init__.py").write_text(
        "__version__ = '9'\nclass cuda:\n    is_available = staticmethod(lambda: True)\n"
        "    get_device_name = staticmethod(lambda index: f'Card {index}')\n"
    )
    answer = asked(sys.executable)
    assert "Ready to train on Card 0: " in answer.message and answer.details[-1] == "Device: Card 0 (CUDA)"


def test_a_library_may_print(packages: Path):
    with (packages / "torch/__init__.py").open("a") as file:
        file.write("print('[1, 2]', end='')\n")
    assert asked(sys.executable).level == "INFO"


def test_packages_are_missing(packages: Path):
    (packages / "sitecustomize.py").write_text(
        "import sys\nsys.modules.update(dict.fromkeys(['torch', 'onnx', 'numpy']))\n"
    )
    answer = asked(sys.executable)
    assert answer.level == "ERROR" and answer.message.endswith("lacks torch, onnx and numpy; do this.")


def test_a_package_is_broken(packages: Path):
    (packages / "torch/__init__.py").write_text("raise OSError('libtorch.so: no such file')\n")
    answer = asked(sys.executable)
    assert answer.level == "ERROR" and "torch of " in answer.message and "libtorch.so: no such file" in answer.message
    (packages / "torch/__init__.py").write_text("import typing_extensions_of_nobody\n")
    assert (
        "torch of " in asked(sys.executable).message and "typing_extensions_of_nobody" in asked(sys.executable).message
    )


def test_an_old_python(tmp_path: Path):
    said = json.dumps({"version": [3, 9, 18], "packages": {}, "broken": {}})
    answer = asked(script(tmp_path / "python3.9", f"echo '{said}'"))
    assert answer.message == f"'{tmp_path}/python3.9' is Python 3.9.18, and the trainer needs 3.11 or later; do this."


def test_it_is_not_there():
    assert asked("/none/python").message == (
        "The trainer's Python '/none/python' cannot be started (No such file or directory); do this."
    )


@pytest.mark.parametrize("lines", [["exit 0"], ["echo hello"], ["echo 5"], ["echo '{}'"], ["echo '{\"version\": 3}'"]])
def test_it_is_no_python(tmp_path: Path, lines: list[str]):
    answer = asked(script(tmp_path / "program", *lines))
    assert answer.level == "ERROR"
    assert answer.message.startswith(f"'{tmp_path}/program' does not answer as a Python does (status 0); do this.")


def test_it_says_why_it_fails(tmp_path: Path):
    answer = asked(script(tmp_path / "program", "echo 'wrong machine' >&2; exit 1"))
    assert "(wrong machine)" in answer.message


def test_it_never_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(check, "TIMEOUT_SECONDS", 0.5)
    assert asked(script(tmp_path / "program", "exec sleep 60")).message.endswith("did not answer in 0 s; do this.")


def test_a_base_is_run_and_not_just_found(tmp_path: Path):
    shim = script(tmp_path / "python3.13", "echo 'this version is not selected' >&2; exit 127")
    hangs = script(tmp_path / "hangs", "exit 0")
    real = script(tmp_path / "real", f'exec "{sys.executable}" "$@"')
    found = list(find_bases(iter([[shim], [hangs], ["/none"], [real], [sys.executable]])))
    assert [(base.path, base.version, base.lacks) for base in found] == [(sys.executable, sys.version_info[:2], "")]


@pytest.mark.parametrize(
    ("answer", "lacks"),
    [
        ([[3, 10], True, [], "/p"], "is none of 3.11, 3.12, 3.13"),
        ([[3, 13], False, [], "/p"], "is not 64-bit"),
        ([[3, 13], True, ["ensurepip", "venv"], "/p"], "lacks the module ensurepip"),
    ],
)
def test_what_a_base_lacks(tmp_path: Path, answer: list, lacks: str):
    base = ask([script(tmp_path / "python", f"echo '{json.dumps(answer)}'")])
    assert base.lacks == lacks and str(base) == f"'/p' (Python {answer[0][0]}.{answer[0][1]})"


def test_blenders_own_python_is_the_first(monkeypatch: pytest.MonkeyPatch):
    assert next(bases.usual_candidates()) == [sys.executable]
    assert next(find_bases()).path == sys.executable


def test_a_training_without_blenders_program_finds_the_environment_that_blender_made(tmp_path: Path):
    own = tmp_path / "datafiles" / "fdda" / "trainer"
    (own / "bin").mkdir(parents=True)
    (own / MARK).write_text("made with other versions\n")
    script(own / "bin" / "python", "echo the own environment")
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path), "PYTHONPATH": str(ROOT)}
    environment.pop(PYTHON_VARIABLE, None)
    command = [sys.executable, "-m", "fdda_addon", "train", "--help"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.startswith("the own environment\n"), done.stderr
