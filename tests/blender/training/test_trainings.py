# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainers that are missing, fail or die, and trainings that continue without the Blender that started them."""

import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest

from fdda_addon.core.errors import TRY_AGAIN, TrainingError
from fdda_addon.core.formats.messages import Message, MessageType
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.training import detached_process
from fdda_addon.training.environment.choice import PYTHON_VARIABLE
from fdda_addon.training.process import trainer_command

from ... import systems
from ..conftest import run
from ..stand_ins import import_from, print_message_code, stand_in_trainer

pytestmark = pytest.mark.one_blender_version


@pytest.fixture
def train_refusal(refusal, elbow_files, tmp_path):
    """Return a function that runs `train` on the elbow's recording, and returns its error message."""

    def run_train(*options: object, status: int = 1) -> str:
        return refusal("train", elbow_files.recording, tmp_path / "m.onnx", *options, status=status)

    return run_train


STARTED = print_message_code(MessageType.STARTED, partitions=1, poses=1, vertices=1, device="cpu")

PROGRESSED = print_message_code(MessageType.PROGRESS, epoch=1, epochs=2, validation_mm=0.5)


def test_a_python_without_torch_is_reported(train_refusal, tmp_path, monkeypatch):
    packages = tmp_path / "packages"
    packages.mkdir()
    (packages / "sitecustomize.py").write_text("import sys\nsys.modules['torch'] = None\n")
    import_from(packages, monkeypatch)
    text = train_refusal()
    python = os.environ.get(PYTHON_VARIABLE) or sys.executable
    assert text.startswith(f"Training needs the Python package 'torch', which {python} does not have; install torch")
    assert PYTHON_VARIABLE in text


def test_a_python_that_cannot_import_the_trainer_is_reported(train_refusal, tmp_path, monkeypatch):
    stand_in_trainer(
        tmp_path,
        monkeypatch,
        "import subprocess",
        "status = subprocess.call([sys.executable, '-I', '-S', *sys.orig_argv[1:]])",
    )
    assert re.match(
        r"The trainer ended with status 1 before it was done \(.*trainer.*\); no model was written", train_refusal()
    )


def test_a_trainer_in_the_current_folder_is_not_run(tmp_path):
    (tmp_path / "trainer").mkdir()
    for name in ("__init__", "__main__"):
        (tmp_path / "trainer" / f"{name}.py").write_text("raise SystemExit('another trainer')")
    command, environment = trainer_command(["--help"])
    result = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0 and "usage: " in result.stdout, result.stderr


@pytest.mark.parametrize("is_missing", [True, False], ids=["missing", "not executable"])
def test_a_python_that_cannot_be_started_is_reported(train_refusal, tmp_path, monkeypatch, is_missing):
    python = tmp_path / "python"
    if not is_missing:
        python.write_text("")
    monkeypatch.setenv(PYTHON_VARIABLE, str(python))
    cause = "No such file or directory.*" if is_missing else ".+"
    assert re.fullmatch(
        rf"The trainer's Python {re.escape(repr(str(python)))} cannot be started \({cause}\); set "
        "FDDA_TRAINER_PYTHON to a Python that has torch.",
        train_refusal(),
    )


LOAD_ERROR = "ImportError: DLL load failed while importing _C: Das angegebene Modul wurde nicht gefunden."

AGAIN = "no model was written, train again."

NOISE = ("print('a warning')", "print('{}')", "sys.stdout.buffer.write(b'\\xfc\\n')", STARTED, "print()")

# On Windows, a process that the Task Manager kills has exit status 1, like a process that fails.
KILLED = "was ended from outside" if os.name == "nt" else "was ended by signal 9"

CRASHED = "crashed: status 0xC0000005" if os.name == "nt" else "was ended by signal 11"


@pytest.mark.parametrize(
    ("lines", "trainer_status", "status", "start"),
    [
        ((), 3, 1, f"The trainer ended with status 3 before it was done; {AGAIN}"),
        ((STARTED,), 0, 1, "The trainer ended with status 0 before it was done;"),
        (
            ("sys.stderr.write('first\\nImportError: Jürgen 李\\n')",),
            1,
            1,
            f"The trainer ended with status 1 before it was done (ImportError: Jürgen 李); {AGAIN}",
        ),
        (
            (f"sys.stderr.write({LOAD_ERROR!r})",),
            1,
            1,
            f"The trainer ended with status 1 before it was done ({LOAD_ERROR}); install Microsoft's Visual C++ "
            "runtime from https://aka.ms/vs/17/release/vc_redist.",
        ),
        (
            (STARTED, PROGRESSED, "os.kill(os.getpid(), getattr(signal, 'SIGKILL', 15))"),
            0,
            TRY_AGAIN,
            f"The trainer {KILLED} before it was done; {AGAIN}",
        ),
        ((STARTED, "import faulthandler", "faulthandler._read_null()"), 0, TRY_AGAIN, f"The trainer {CRASHED}"),
        ((STARTED, print_message_code(MessageType.FAILED, text="The sky fell; wait.")), 1, 1, "The sky fell; wait."),
        ((*NOISE, print_message_code(MessageType.FAILED, text="Enough.")), 0, 1, "Enough."),
    ],
    ids=["no output", "status 0", "error", "library", "killed", "crashed", "message", "noise"],
)
def test_a_trainer_that_fails_is_reported(train_refusal, tmp_path, monkeypatch, lines, trainer_status, status, start):
    stand_in_trainer(tmp_path, monkeypatch, *lines, status=trainer_status)
    text = train_refusal(status=status)
    # A sentence with a full stop is the whole message.
    assert text == start if start.endswith(("again.", "wait.", "Enough.")) else text.startswith(start)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="/dev/full is Linux's")
@pytest.mark.parametrize("is_silent", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_trainer_whose_disk_is_full_is_reported(elbow_files, train_refusal, tmp_path, monkeypatch, is_silent):
    """The trainer cannot write to stdout, and in one case not to stderr."""
    lines = ["os.dup2(os.open('/dev/full', os.O_WRONLY), 1)", *(["os.dup2(1, 2)"] if is_silent else [])]
    packages = tmp_path / "packages"
    packages.mkdir()
    code = "\n".join(["import os, sys", "if 'trainer' in sys.orig_argv:", *(f"    {line}" for line in lines), ""])
    (packages / "sitecustomize.py").write_text(code)
    import_from(packages, monkeypatch)
    text = train_refusal("--passes", 1, status=TRY_AGAIN)
    assert is_silent or "No space left on device; make room, end other programs, or try again." in text


@pytest.mark.parametrize("lines", [(STARTED, print_message_code(MessageType.CANCELLED)), ()])
def test_a_trainer_that_another_program_cancels_ends_with_status_130(elbow_files, tmp_path, monkeypatch, lines):
    stand_in_trainer(tmp_path, monkeypatch, *lines, status=130)
    assert run("train", elbow_files.recording, tmp_path / "m.onnx") == 130
    assert not (tmp_path / "m.onnx").exists()


def test_a_trainer_that_ignores_the_stop_request_is_killed(tmp_path, monkeypatch):
    """Leaving the `with` block ends a process that would run for an hour and ignores requests."""
    from fdda_addon.training import process

    monkeypatch.setattr(process, "KILL_AFTER_SECONDS", 0.5)
    stand_in_trainer(tmp_path, monkeypatch, STARTED, "time.sleep(3600)")
    with process.Training([]) as training:
        assert next(training.messages()).type is MessageType.STARTED
        popen = training._process
    assert popen.returncode not in (None, 0) and not training._stop_file.exists()


def test_polling_a_silent_trainer_does_not_block(tmp_path, monkeypatch):
    """A modal operator polls for messages. A poll returns at once, and a canceled trainer ends without an error."""
    from fdda_addon.training import process

    stand_in_trainer(tmp_path, monkeypatch, STARTED, "time.sleep(3600)")
    with process.Training([]) as training:
        messages = training.messages(wait=False)
        message = next_message(messages)
        assert message.type is MessageType.STARTED
        seconds = []
        for _ in range(100):
            start = time.monotonic()
            assert next(messages) is None
            seconds.append(time.monotonic() - start)
        assert statistics.median(seconds) < 0.0005  # Other processes may delay some polls.
        assert max(seconds) < 1
        monkeypatch.setattr(process, "KILL_AFTER_SECONDS", 0.5)
        training.cancel()
        assert next_message(messages) is None


def next_message(messages: Iterator[Message | None], seconds: float = 20) -> Message | None:
    """Poll until a training has a message and return the message, or None if the training ends."""
    deadline = time.monotonic() + seconds
    for message in messages:
        if message is not None:
            return message
        assert time.monotonic() < deadline, "neither a message nor an end"
        time.sleep(0.01)
    return None


DETACHING_CODE = """
import sys
sys.path.insert(0, {root!r})
from pathlib import Path
from fdda_addon.training import detached_process
detached_process.user_folder = lambda: Path({user!r})
with detached_process.DetachedTraining([{recording!r}, {model!r}, "--passes", "{epochs}"], Path({model!r})) as training:
    next(training.messages())
    training.detach()
"""

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def _temporary_user_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(detached_process, "user_folder", lambda: tmp_path / "user")


def detach_in_another_process(elbow_files, model: Path, epochs: int) -> None:
    """Start a training and detach from it in another process, which then ends."""
    user = model.parent / "user"
    code = DETACHING_CODE.format(
        root=str(ROOT), user=str(user), recording=str(elbow_files.recording), model=str(model), epochs=epochs
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_a_detached_training_continues_and_is_read_from_its_start(elbow_files, tmp_path):
    model = tmp_path / "m.onnx"
    detach_in_another_process(elbow_files, model, 30)
    assert detached_process.is_detached(model) and not model.exists()
    with detached_process.AttachedTraining(model) as training:
        message_types = [message.type for message in training.messages()]
    assert message_types[0] is MessageType.STARTED and message_types.count(MessageType.PROGRESS) == 30
    assert message_types[-1] is MessageType.FINISHED
    assert read_model_info(model).training["passes"] == 30
    assert not detached_process.is_detached(model)


def test_attaching_to_a_killed_training_raises_an_error(elbow_files, tmp_path):
    model = tmp_path / "m.onnx"
    detach_in_another_process(elbow_files, model, 100_000)
    with detached_process.AttachedTraining(model) as training:
        training._process.kill()
        with pytest.raises(TrainingError, match="before it was done; no model was written, train again"):
            list(training.messages())
    assert not detached_process.is_detached(model)


def test_an_attached_training_can_be_canceled(elbow_files, tmp_path):
    model = tmp_path / "m.onnx"
    detach_in_another_process(elbow_files, model, 100_000)
    with detached_process.AttachedTraining(model) as training:
        messages = training.messages()
        next(messages)
        training.cancel()
        assert list(messages)[-1].type is MessageType.CANCELLED
    assert not model.exists() and not detached_process.is_detached(model)
    assert list((tmp_path / "user" / "trainings").iterdir()) == []


def test_attaching_to_a_failed_training_shows_its_error(tmp_path):
    files = detached_process._ProcessFiles(tmp_path / "m.onnx")
    with files.new_messages(), files.new_errors() as errors:
        errors.write("Traceback\nImportError: Jürgen 李\n")
    files.write_process_id(1)
    with (
        detached_process.AttachedTraining(tmp_path / "m.onnx") as training,
        pytest.raises(
            TrainingError, match=r"The trainer ended before it was done \(ImportError: Jürgen 李\); no model"
        ),
    ):
        list(training.messages())
    assert not detached_process.is_detached(tmp_path / "m.onnx")


def test_a_training_that_is_not_detached_ends_with_its_block(elbow_files, tmp_path):
    model = tmp_path / "m.onnx"
    with detached_process.DetachedTraining(
        [str(elbow_files.recording), str(model), "--passes", "100000"], model
    ) as training:
        next(training.messages())
        process = training._process
    assert process.poll() is not None and not detached_process.is_detached(model)


def test_another_process_with_the_same_id_is_not_killed(tmp_path):
    """After a restart, the system may have given the process ID to another process."""
    model = tmp_path / "m.onnx"
    other_process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        files = detached_process._ProcessFiles(model)
        files.new_messages().close()
        files.write_process_id(other_process.pid)
        with detached_process.AttachedTraining(model) as training:
            training.cancel()
            training._process.kill()
            list(training.messages())
        assert other_process.poll() is None
    finally:
        other_process.kill()
        other_process.wait()


@systems.forks
def test_a_training_on_a_drive_without_locks_runs_until_its_process_has_ended(tmp_path, monkeypatch):
    systems.refuse_locks(monkeypatch)
    files = detached_process._ProcessFiles(tmp_path / "m.onnx")
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as process:
        files.new_messages().close()
        files.write_process_id(process.pid)
        assert files.is_running()
        with detached_process.AttachedTraining(tmp_path / "m.onnx") as training:
            assert training._process.poll() is None
            # It is not certain that the process with this id is the training, so it gets no signal.
            training._process.kill()
            assert process.poll() is None and training._process.poll() == "ended"
        files.new_messages().close()
        files.write_process_id(process.pid)
    assert not files.is_running()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows removes no open files")
def test_an_attached_training_ends_when_another_blender_has_removed_its_files(tmp_path):
    files = detached_process._ProcessFiles(tmp_path / "m.onnx")
    with files.new_messages():
        files.write_process_id(1)
        with detached_process.AttachedTraining(tmp_path / "m.onnx") as training:
            files.remove()
            assert training._lines.join(5) and training._lines.next() is None


def test_an_invalid_process_file_is_ignored(tmp_path):
    files = detached_process._ProcessFiles(tmp_path / "m.onnx")
    files.new_messages().close()
    for text in ("", "[]", '{"process": "x"}', '{"process": null}'):
        files._path.write_text(text)
        assert not detached_process.is_detached(tmp_path / "m.onnx")


def test_no_job_supports_adjust_last_operation():
    """Adjust Last Operation would repeat the whole job at every change of an option."""
    from importlib import import_module

    from fdda_addon import operators
    from fdda_addon.operators.job import JobOperator

    classes = [c for name in operators.MODULES for c in import_module(f"fdda_addon.operators.{name}").CLASSES]
    jobs = [c for c in classes if issubclass(c, JobOperator)]
    assert len(jobs) > 5 and [c.bl_idname for c in jobs if "UNDO" in c.bl_options] == []


def test_opening_a_file_clears_ended_jobs(rig):
    from fdda_addon.jobs import job

    bpy.ops.fdda.measure()
    assert job.state_of("measure").subject == rig.mesh_object.session_uid
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert job.state_of("measure") is None
