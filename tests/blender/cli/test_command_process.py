# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m fdda_addon` as a process: exit statuses, stop signals, and names outside ASCII."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import bpy
import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.index import read_index
from fdda_addon.recording.run import BATCH_POSES

from ... import systems
from ..conftest import run
from ..refusals import file_contents, save_elbow

ROOT = Path(__file__).resolve().parents[3]

POSE_COUNT = 8 * BATCH_POSES

INTERRUPT_SIGNAL = "CTRL_BREAK_EVENT" if os.name == "nt" else "SIGINT"

STOP_SIGNALS = ("CTRL_BREAK_EVENT",) if os.name == "nt" else ("SIGINT", "SIGTERM", "SIGHUP")

IMPORT_HOOK = """
import signal, sys
def hook(event, arguments):
    global done
    if event == "import" and arguments[0] == {module!r} and not done:
        done = True
        signal.raise_signal(signal.SIGINT)
done = not "fdda_addon" in sys.orig_argv
sys.addaudithook(hook)
"""

REGISTRATION_HOOK = """
import signal, sys, typing
def hook(*arguments, **options):
    signal.raise_signal(signal.SIGINT)
    return get_type_hints(*arguments, **options)
get_type_hints = typing.get_type_hints
if "fdda_addon" in sys.orig_argv:
    typing.get_type_hints = hook
"""


def start_verb(*arguments: object, **environment: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    options = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if os.name == "nt" else {}
    return subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env={**os.environ, "PYTHONUNBUFFERED": "1", **environment},
        **options,
    )


def run_to_end(*arguments: object, **environment: str) -> tuple[int, str, str]:
    process = start_verb(*arguments, **environment)
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err


def test_a_failed_verb(tmp_path):
    path = tmp_path / "none.blend"
    assert run_to_end("record", path, tmp_path / "r") == (
        1,
        "",
        f"Error: There is no file '{path}'; give the path of a .blend file.\n",
    )


def wait_for(condition, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.005)


def recorded_pose_count(path: Path) -> int:
    try:
        return read_index(path)["complete"]
    except RecordingError:
        return -1


@pytest.mark.parametrize("is_killed", [False, True])
def test_a_stopped_recording_resumes(elbow_files, tmp_path, is_killed):
    """A recording that Ctrl-C or the system stops and `--resume` continues has the bytes of an uninterrupted one."""
    options = ["--poses", POSE_COUNT, "--seed", 5]
    path = tmp_path / "stopped"
    process = start_verb("record", elbow_files.rig, path, *options)
    wait_for(lambda: recorded_pose_count(path) > 0, process)
    process.kill() if is_killed else process.send_signal(getattr(signal, INTERRUPT_SIGNAL))
    out, err = process.communicate(timeout=60)
    assert process.returncode == (systems.KILLED if is_killed else 130), err
    if not is_killed:
        assert out.count("\n") == 2 and err.splitlines()[-1] == "Interrupted." and "Traceback" not in err
    assert 0 < recorded_pose_count(path) < POSE_COUNT
    assert run("record", elbow_files.rig, path, *options, "--resume") == 0
    assert run("record", elbow_files.rig, tmp_path / "whole", *options) == 0
    assert file_contents(path) == file_contents(tmp_path / "whole")


@pytest.mark.parametrize(
    "signal_name", [STOP_SIGNALS[0], *(pytest.param(name, marks=pytest.mark.slow) for name in STOP_SIGNALS[1:])]
)
def test_an_interrupted_training_leaves_neither_model_nor_trainer(elbow_files, tmp_path, signal_name):
    """Only the process of the verb gets the signal, as from a batch system."""
    process = start_verb("train", elbow_files.recording, tmp_path / "m.onnx", "--passes", 1_000_000)
    for line in process.stderr:
        if line.startswith("training: "):
            break
    process.send_signal(getattr(signal, signal_name))
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err and out == ""
    assert file_contents(tmp_path) == {}
    commands = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.is_file()]
    assert not any(os.fsencode(tmp_path) in command for command in commands)


@pytest.mark.parametrize(("module", "error"), [("argparse", ""), ("numpy", "Interrupted.\n")])
def test_ctrl_c_during_imports(tmp_path, module, error):
    (tmp_path / "sitecustomize.py").write_text(IMPORT_HOOK.format(module=module))
    verb = ("record", tmp_path / "none.blend", tmp_path / "r")
    assert run_to_end(*verb, PYTHONPATH=str(tmp_path)) == (130, "", error)


def test_ctrl_c_during_registration(elbow_files, tmp_path):
    """Blender prints exceptions that are raised while it reads the annotations of a class, and continues."""
    (tmp_path / "sitecustomize.py").write_text(REGISTRATION_HOOK)
    status, out, err = run_to_end(
        "record", elbow_files.rig, tmp_path / "r", "--poses", 10_000, PYTHONPATH=str(tmp_path)
    )
    assert (status, out, err) == (130, "", "Interrupted.\n")
    assert file_contents(tmp_path / "r") == {}


ASCII_ENVIRONMENT = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}


def rename_with_unicode(rig) -> None:
    rig.mesh_object.name = "Ärmel"
    rig.armature_object.data.bones["lower"].name = "前腕"


@pytest.fixture
def unicode_rig(tmp_path):
    return save_elbow(tmp_path / "ellbögen.blend", rename_with_unicode)


def run_verb(*arguments, **environment) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, env=ASCII_ENVIRONMENT | environment, capture_output=True, check=False)


def test_verbs_on_an_ascii_terminal(unicode_rig, tmp_path):
    assert "Ärmel" in bpy.data.objects
    recording = tmp_path / "Aufnahme ß"
    for arguments in (("record", unicode_rig, recording, "--poses", 12), ("check-recording", recording)):
        result = run_verb(*arguments)
        assert result.returncode == 0, result.stderr
        assert b"Aufnahme \\xdf" in result.stdout and b"Traceback" not in result.stderr


def test_error_messages_on_an_ascii_terminal(unicode_rig):
    result = run_verb("record", unicode_rig, unicode_rig.parent / "r", "--object", "Handschuh ü")
    assert result.returncode == 1
    assert b"no mesh object 'Handschuh" in result.stderr and b"'\\xc4rmel'" in result.stderr
    assert result.stderr.count(b"\n") == 1
