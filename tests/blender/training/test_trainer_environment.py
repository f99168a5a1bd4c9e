# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that trains: its check, and the environment that the add-on makes, with tiny packages."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import bpy
import pytest

from fdda_addon.core.errors import TrainerEnvironmentError
from fdda_addon.core.files import path_limits
from fdda_addon.core.progress import run_job
from fdda_addon.jobs.job import JobRunner, current, state_of, stop
from fdda_addon.jobs.state import ENVIRONMENT
from fdda_addon.operators.trainer_environment import FDDA_OT_create_trainer_environment, _check, start_job
from fdda_addon.training.environment import check, choice, creation, folder, session
from fdda_addon.training.environment.check import CheckResult
from fdda_addon.training.environment.choice import PYTHON_VARIABLE, Origin
from fdda_addon.training.environment.creation import EnvironmentCreation
from fdda_addon.training.environment.folder import COMPLETION_MARKER, PACKAGES, FolderState, interpreter_path

from ... import systems
from ..conftest import run
from ..stand_ins import import_from, write_program
from .tiny_wheels import TORCH, pinned_version, write_wheel, write_wheels

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep the files of the add-on in a folder of the test, and unset the variable that names a Python."""
    monkeypatch.setattr(folder, "user_folder", lambda: tmp_path / "user")
    monkeypatch.delenv(choice.PYTHON_VARIABLE, raising=False)
    stop("of another test", ENVIRONMENT)
    session.store_result(None)
    return tmp_path / "user"


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_wheels(tmp_path_factory.mktemp("tiny") / "wheels")


@pytest.fixture(scope="module")
def made(wheels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment that is complete."""
    path = tmp_path_factory.mktemp("made") / "trainer"
    answer = run_job(EnvironmentCreation(path, path.with_name("log"), wheels).steps())
    assert answer.level == "INFO"
    return path


@pytest.fixture
def own(made: Path, user: Path) -> Path:
    """The add-on's own environment, complete."""
    shutil.copytree(made, folder.environment_folder(), symlinks=True)
    return folder.environment_folder()


def create(**options: str) -> set[str]:
    return bpy.ops.fdda.create_trainer_environment(**options)


def refused(operator, **options: str) -> str:
    """Run an operator that must fail and return its error message."""
    with pytest.raises(RuntimeError) as caught:
        operator(**options)
    return str(caught.value).removeprefix("Error: ").strip()


def test_the_environment_is_created_from_a_folder_of_wheels(user: Path, wheels: Path):
    junk = folder.environment_folder() / "bin" / "left by one that was interrupted"
    junk.mkdir(parents=True)
    assert session.environment_state() is FolderState.INCOMPLETE
    assert create(wheels=str(wheels)) == {"FINISHED"}
    assert session.environment_state() is FolderState.READY and not junk.exists()
    assert choice.select_python() == (str(folder.interpreter_path(folder.environment_folder())), Origin.OWN)
    assert session.check_result.message.endswith(f"torch {pinned_version('torch')}.")
    assert session.check_result.message.startswith("Ready to train on the CPU: Python 3.")
    assert f"onnx {pinned_version('onnx')}" in session.check_result.details
    log = folder.log_path().read_text()
    assert "-m venv" in log and "Successfully installed" in log and "Ready to train" in log
    assert sorted(path.name for path in user.iterdir()) == ["trainer", "trainer.lock", "trainer.log"]
    assert not (folder.environment_folder() / "temporary").exists()


PIP_SETTINGS = """
[global]
user = true
prefix = /nowhere
find-links = /nowhere
no-index = true
[install]
require-hashes = true
python = /nowhere
find-links =
    {wheels}
"""


def test_settings_of_pip_and_of_a_launcher_do_not_change_where_and_what_is_installed(
    user: Path, wheels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The settings that a download needs are used: here the folder of packages, which overrides another."""
    (tmp_path / "pip.conf").write_text(PIP_SETTINGS.format(wheels=wheels))
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    variables = {"PIP_CONFIG_FILE": str(tmp_path / "pip.conf"), "PIP_ROOT": str(tmp_path / "root"), "PIP_QUIET": "3"}
    for name, value in (variables | {"PIP_PROXY": "http://me:secret@nowhere", "PYTHONHOME": "/nowhere"}).items():
        monkeypatch.setenv(name, value)
    log = tmp_path / "log"
    answer = run_job(EnvironmentCreation(tmp_path / "trainer", log).steps())
    assert answer.level == "INFO" and folder.folder_state(tmp_path / "trainer") is FolderState.READY
    used = re.search(r"Settings of pip that are used: (.*)", log.read_text())[1].split(", ")
    assert {"find-links", "no-index", "proxy"} <= set(used) <= {"find-links", "no-index", "proxy", "cert"}
    assert "secret" not in log.read_text() and not (tmp_path / "root").exists()


def test_settings_of_pip_that_cannot_be_read_are_named(user: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "pip.conf").write_text("user = true\n")
    monkeypatch.setenv("PIP_CONFIG_FILE", str(tmp_path / "pip.conf"))
    with pytest.raises(TrainerEnvironmentError, match=r"The settings of pip cannot be read \(.*pip\.conf.*\); correct"):
        list(EnvironmentCreation(tmp_path / "trainer", tmp_path / "log").steps())
    assert not (tmp_path / "trainer").exists()


def test_preferences_and_variable_come_before_the_own_environment(
    own: Path, preferences, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert choice.select_python() == (str(folder.interpreter_path(own)), Origin.OWN)
    monkeypatch.setenv(choice.PYTHON_VARIABLE, "/of/the/variable")
    assert choice.select_python() == ("/of/the/variable", Origin.VARIABLE)
    preferences.trainer_python = "/of/the/preferences"
    assert choice.select_python() == ("/of/the/preferences", Origin.PREFERENCES)
    preferences.trainer_python = str(own) + os.sep
    assert choice.select_python() == (str(folder.interpreter_path(own)), Origin.PREFERENCES)


@pytest.mark.slow
def test_creation_warns_if_another_python_is_used_instead(user: Path, wheels: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(choice.PYTHON_VARIABLE, sys.executable)
    assert create(wheels=str(wheels)) == {"FINISHED"}
    assert session.check_result is None and session.notice.level == "WARNING"
    assert "FDDA_TRAINER_PYTHON names another Python, which is used instead" in session.notice.message


def test_a_missing_wheel_is_named(own: Path, wheels: Path, tmp_path: Path):
    shutil.copytree(wheels, tmp_path / "fewer")
    next((tmp_path / "fewer").glob("onnx-*")).unlink()
    text = refused(create, wheels=str(tmp_path / "fewer"))
    assert text.startswith(f"The packages of '{tmp_path / 'fewer'}' could not be installed (")
    assert "Cannot install onnx because" in text and session.notice.message == text
    assert session.environment_state() is FolderState.MISSING


@pytest.mark.slow
def test_an_environment_with_broken_packages_is_removed(user: Path, wheels: Path, tmp_path: Path):
    shutil.copytree(wheels, tmp_path / "broken")
    write_wheel(tmp_path / "broken", "torch", "raise OSError('libcudart.so.13 is missing')\n")
    text = refused(create, wheels=str(tmp_path / "broken"))
    assert "installed but do not work: torch of" in text and "libcudart.so.13 is missing" in text
    assert session.environment_state() is FolderState.MISSING


def test_without_online_access_wheels_are_required(user: Path, preferences, tmp_path: Path):
    assert not bpy.app.online_access
    assert refused(create) == (
        "Blender's online access is off: allow it in Preferences > System > Network, choose a folder under Offline "
        "Packages, or choose an existing Python that has torch."
    )
    preferences.wheels_folder = str(tmp_path)
    assert f"The packages of '{tmp_path}' could not be installed (" in refused(create)


@pytest.mark.one_blender_version
def test_paths_that_are_too_long_for_windows_are_refused_before_the_installation(tmp_path, monkeypatch):
    monkeypatch.setattr(path_limits, "is_windows", lambda: True)
    monkeypatch.setattr(path_limits, "supports_long_windows_paths", lambda: False)
    path = tmp_path / ("x" * 130)
    with pytest.raises(TrainerEnvironmentError, match=r"characters, and Windows takes 259\); allow long paths \("):
        list(EnvironmentCreation(path, tmp_path / "log").steps())
    assert not path.exists()


@pytest.mark.one_blender_version
def test_too_little_disk_space_is_refused_before_the_installation(
    user: Path, own: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(creation, "MIN_FREE_GB", 10**9)
    with pytest.raises(TrainerEnvironmentError, match=r"needs 1000000000 GB and '.*' has [\d.]+ GB left; make room"):
        list(EnvironmentCreation(own, folder.log_path()).steps())
    assert session.environment_state() is FolderState.READY


def test_a_python_that_cannot_create_environments_is_refused(
    user: Path, wheels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sys, "executable", write_program(tmp_path / "python", "sys.exit('Error: no room for it')"))
    text = refused(create, wheels=str(wheels))
    assert "cannot be created ('" in text and "Error: no room for it); choose an existing Python" in text
    monkeypatch.setattr(creation, "PINNED_REQUIREMENTS", {})
    assert "is too new); choose an existing Python" in refused(create, wheels=str(wheels))


@pytest.mark.one_blender_version
def test_an_environment_on_a_drive_without_locks_is_removed(own: Path, monkeypatch: pytest.MonkeyPatch):
    systems.refuse_locks(monkeypatch)
    assert bpy.ops.fdda.remove_trainer_environment() == {"FINISHED"} and not own.exists()


@pytest.mark.one_blender_version
def test_a_folder_locked_by_another_blender_is_refused(user: Path, own: Path):
    code = "import sys; from pathlib import Path; from fdda_addon.training.environment.folder import creation_lock\n"
    code += "with creation_lock(Path(sys.argv[1])): print('mine', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code, own], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "mine\n"
        text = refused(bpy.ops.fdda.remove_trainer_environment)
        assert text == "Another Blender is installing or removing the training environment; wait until it is done."
        assert own.is_dir()
        other.communicate()
    assert bpy.ops.fdda.remove_trainer_environment() == {"FINISHED"}
    assert session.environment_state() is FolderState.MISSING


def wait_for(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def begin_creation(job: EnvironmentCreation) -> JobRunner:
    """Start the creation as a background job, as its button does in a window."""
    return start_job(
        "create_trainer_environment", "Create", job.steps(), job.cancel, FDDA_OT_create_trainer_environment.store_result
    )


def test_a_canceled_creation_ends_its_process_and_removes_its_files(user: Path, wheels: Path):
    job = EnvironmentCreation(folder.environment_folder(), folder.log_path(), wheels)
    run = begin_creation(job)
    assert not bpy.ops.fdda.create_trainer_environment.poll() and not run.work(0)
    wait_for(lambda: folder.environment_folder().is_dir())
    process = job._process
    assert bpy.ops.fdda.cancel_trainer_environment() == {"FINISHED"}
    wait_for(lambda: run.work(0), 10)
    assert process is None or process.poll() is not None
    assert current(ENVIRONMENT) is None and run.state.outcome == session.notice.message
    assert session.notice.level == "WARNING" and "was canceled; nothing was kept" in session.notice.message
    assert session.environment_state() is FolderState.MISSING
    assert not bpy.ops.fdda.cancel_trainer_environment.poll()


@pytest.mark.one_blender_version
def test_a_creation_canceled_before_its_start_keeps_the_environment(own: Path, wheels: Path):
    job = EnvironmentCreation(own, folder.log_path(), wheels)
    job.cancel()
    with pytest.raises(TrainerEnvironmentError, match="was canceled; the previous environment was kept"):
        list(job.steps())
    assert session.environment_state() is FolderState.READY


def test_unregistering_cancels_a_running_creation(user: Path, wheels: Path):
    import fdda_addon

    job = EnvironmentCreation(folder.environment_folder(), folder.log_path(), wheels)
    begin_creation(job).work(0)
    wait_for(lambda: folder.environment_folder().is_dir())
    fdda_addon.unregister()
    assert current(ENVIRONMENT) is None and choice.preferred_python is None and not folder.environment_folder().exists()


def test_the_result_of_a_background_check_is_stored(own: Path):
    run = start_job("check_trainer", "Check", _check(choice.select_python()), None, session.store_result)
    assert not run.work(0) and not run.state.can_cancel and not bpy.ops.fdda.cancel_trainer_environment.poll()
    wait_for(lambda: run.work(0))
    assert state_of("check_trainer").outcome == session.check_result.message
    assert session.check_result.level == "INFO" and session.notice is None


def test_an_environment_without_its_python_is_broken(
    own: Path, elbow_files, tmp_path: Path, capfd: pytest.CaptureFixture
):
    folder.interpreter_path(own).unlink()
    assert session.environment_state() is FolderState.BROKEN
    assert run("train", elbow_files.recording, tmp_path / "m.onnx") == 1
    python = folder.interpreter_path(own)
    assert capfd.readouterr().err.strip() == (
        f"Error: The trainer's Python '{python}' cannot be started (No such file or directory); reinstall the "
        "training environment in the add-on's preferences."
    )


@pytest.mark.one_blender_version
def test_an_environment_of_other_versions_still_trains(own: Path):
    (own / folder.COMPLETION_MARKER).write_text("of another time\n")
    assert session.environment_state() is FolderState.OUTDATED
    assert choice.select_python().origin is Origin.OWN
    (own / folder.COMPLETION_MARKER).write_bytes(b"\xff\xfe\x00")
    assert folder.folder_state(own) is FolderState.INCOMPLETE


@pytest.mark.one_blender_version
def test_an_environment_that_cannot_be_removed_is_incomplete(own: Path, monkeypatch: pytest.MonkeyPatch):
    def rmtree(path: object, ignore_errors: bool = False) -> None:
        if not ignore_errors:
            raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(shutil, "rmtree", rmtree)
    text = refused(bpy.ops.fdda.remove_trainer_environment)
    assert text.startswith("The training environment cannot be removed (Permission denied: ") and str(own) in text
    assert session.environment_state() is FolderState.INCOMPLETE and choice.select_python().origin is Origin.THIS


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
