# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks whether a Python can train, or can be the base of a training environment."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from fdda_addon.training.environment import check, folder
from fdda_addon.training.environment.check import CheckResult
from fdda_addon.training.environment.choice import PYTHON_VARIABLE
from fdda_addon.training.environment.creation import query_interpreter
from fdda_addon.training.environment.folder import COMPLETION_MARKER, PACKAGES, interpreter_path

from ..conftest import run
from ..stand_ins import import_from, write_program
from .tiny_wheels import TORCH

ROOT = Path(__file__).resolve().parents[3]
ADVICE = "do this"


def asked(python: object) -> CheckResult:
    return check.check(str(python), ADVICE)


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The first folder of Python's import path, with a module for each package."""
    import_from(tmp_path / "packages", monkeypatch)
    for name in PACKAGES:
        (tmp_path / "packages" / name).mkdir(parents=True)
        (tmp_path / "packages" / name / "__init__.py").write_text(
            (TORCH if name == "torch" else "").replace("{version}", "9")
        )
    return tmp_path / "packages"


def test_a_python_with_all_packages_can_train(packages: Path):
    answer = asked(sys.executable)
    version = ".".join(map(str, sys.version_info[:3]))
    assert answer.level == "INFO" and answer.message == f"Ready to train on the CPU: Python {version}, torch 9."
    assert answer.details[0] == f"Python {version}: {sys.executable}" and answer.details[-1] == "Device: the CPU"


def test_check_trainer_prints_the_result(packages: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture):
    monkeypatch.setenv(PYTHON_VARIABLE, sys.executable)
    assert run("check-trainer") == 0
    assert capfd.readouterr().out.splitlines()[-1].startswith("Ready to train on the CPU: ")
    monkeypatch.setenv(PYTHON_VARIABLE, "/none/python")
    assert run("check-trainer") == 1
    assert re.fullmatch(
        r"Error: The trainer's Python '/none/python' cannot be started \(No such file or directory.*\); set "
        r"FDDA_TRAINER_PYTHON to a Python that has torch\.\n",
        capfd.readouterr().err,
    )


CARD = """
from unittest.mock import MagicMock
__version__ = "9"
class cuda(MagicMock):
    is_available = staticmethod(lambda: True)
    get_device_name = staticmethod(lambda index: f"Card {index}")
    synchronize = MagicMock()
ones = MagicMock()
"""


def test_the_device_is_named(packages: Path):
    (packages / "torch/__init__.py").write_text(CARD)
    answer = asked(sys.executable)
    assert "Ready to train on Card 0: " in answer.message and answer.details[-1] == "Device: Card 0 (CUDA)"


def test_a_card_that_cannot_be_used_is_named(packages: Path):
    error = "RuntimeError('CUDA error: no kernel image is available\\nCompile with `TORCH_USE_CUDA_DSA`')"
    (packages / "torch/__init__.py").write_text(f"{CARD}ones.side_effect = {error}\n")
    answer = asked(sys.executable)
    assert answer.level == "INFO" and answer.details[-1] == "Device: the CPU"
    assert answer.message.startswith(
        "Ready to train on the CPU, because Card 0 cannot be used (CUDA error: no kernel image is available): Python"
    )


def test_output_of_imported_packages_is_ignored(packages: Path):
    with (packages / "torch/__init__.py").open("a") as file:
        file.write("print('[1, 2]', end='')\n")
    assert asked(sys.executable).level == "INFO"


def test_missing_packages_are_named(packages: Path):
    (packages / "sitecustomize.py").write_text(
        "import sys\nsys.modules.update(dict.fromkeys(['torch', 'onnx', 'numpy']))\n"
    )
    answer = asked(sys.executable)
    assert answer.level == "ERROR" and answer.message.endswith("lacks torch, onnx and numpy; do this.")


def test_a_broken_package_is_named_with_its_error(packages: Path):
    (packages / "torch/__init__.py").write_text("raise OSError('libtorch.so: no such file')\n")
    answer = asked(sys.executable)
    assert answer.level == "ERROR" and "torch of " in answer.message and "libtorch.so: no such file" in answer.message
    (packages / "torch/__init__.py").write_text("import typing_extensions_of_nobody\n")
    assert (
        "torch of " in asked(sys.executable).message and "typing_extensions_of_nobody" in asked(sys.executable).message
    )


def test_an_old_python_is_refused(tmp_path: Path):
    said = json.dumps({"version": [3, 9, 18], "packages": {}, "broken": {}})
    python = write_program(tmp_path / "python3.9", f"print({said!r})")
    assert asked(python).message == f"'{python}' is Python 3.9.18, and the trainer needs 3.11 or later; do this."


@pytest.mark.parametrize("said", ["", "hello", "5", "{}", '{"version": 3}'])
def test_a_program_that_is_no_python_is_refused(tmp_path: Path, said: str):
    python = write_program(tmp_path / "program", f"print({said!r})")
    answer = asked(python)
    assert answer.level == "ERROR"
    assert answer.message.startswith(f"'{python}' does not answer as a Python does (status 0); do this.")


def test_the_error_of_a_failing_python_is_shown(tmp_path: Path):
    answer = asked(write_program(tmp_path / "program", "sys.exit('wrong machine of Jürgen 李')"))
    assert "(wrong machine of Jürgen 李)" in answer.message
    answer = asked(write_program(tmp_path / "crashes", "import faulthandler", "faulthandler._read_null()"))
    assert ("(crashed: status 0xC0000005" if os.name == "nt" else "(was ended by signal 11") in answer.message


def test_a_hanging_python_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(check, "TIMEOUT_SECONDS", 0.5)
    assert asked(write_program(tmp_path / "program", "time.sleep(5)")).message.endswith(
        "did not answer in 0 s; do this."
    )


@pytest.mark.parametrize(
    ("answer", "lacks"),
    [
        ([[3, 10], True, [], "/p"], "is none of 3.11, 3.12, 3.13"),
        ([[3, 13], False, [], "/p"], "is not 64-bit"),
        ([[3, 13], True, ["ensurepip", "venv"], "/p"], "lacks the module ensurepip"),
    ],
)
def test_a_base_python_says_what_it_lacks(tmp_path: Path, answer: list, lacks: str):
    base = query_interpreter(write_program(tmp_path / "python", f"print({json.dumps(answer)!r})"))
    assert base.problem == lacks and str(base) == f"'/p' (Python {answer[0][0]}.{answer[0][1]})"


def test_a_training_without_blenders_program_finds_the_environment_that_blender_made(tmp_path: Path):
    own = tmp_path / "datafiles" / "fdda" / "trainer"
    python = interpreter_path(own)
    python.parent.mkdir(parents=True)
    (own / COMPLETION_MARKER).write_text("made with other versions\n")
    python.write_text("no program")
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path), "PYTHONPATH": str(ROOT)}
    environment.pop(PYTHON_VARIABLE, None)
    command = [sys.executable, "-m", "fdda_addon", "check-trainer"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr.startswith(f"Error: The trainer's Python '{python}' cannot be started ("), done.stderr


@pytest.mark.one_blender_version
def test_package_names_match_the_trainer_group_of_pyproject():
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["dependency-groups"]
    assert set(folder.PACKAGES) == {requirement.partition("==")[0] for requirement in groups["trainer"]}
    assert all(path.is_file() for path in map(folder.requirements_file, folder.PINNED_REQUIREMENTS))
