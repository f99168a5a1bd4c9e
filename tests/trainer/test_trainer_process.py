# SPDX-License-Identifier: GPL-3.0-or-later
"""The trainer as a process: messages, exit status, interruption, and text in any encoding."""

import errno
import io
import os
import signal
import subprocess
import sys
from dataclasses import replace

import pytest

from fdda_addon.core.formats.messages import STOP_FILE_VARIABLE, Message, MessageType
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.rig import Joint
from trainer.__main__ import main
from trainer.process import run_with_messages
from trainer.progress import MessageSink

from .. import systems
from ..recordings import write_recording
from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain, write_chain
from .conftest import QUICK_OPTIONS, REPOSITORY, start_trainer

ONLY_POSIX = pytest.mark.skipif(os.name != "posix", reason="Windows has no such signals.")


def decode_messages(text: str) -> list[Message]:
    messages = [Message.decode(line) for line in text.splitlines()]
    assert [m.type.is_last for m in messages] == [False] * (len(messages) - 1) + [True]
    return messages


def test_messages_from_start_to_finish(recording, tmp_path, capsys):
    model = tmp_path / "m.onnx"
    assert main([str(recording), str(model), *QUICK_OPTIONS]) == 0
    messages = decode_messages(capsys.readouterr().out)
    assert messages[0].type is MessageType.STARTED
    assert messages[0].values == {"partitions": 3, "poses": 120, "vertices": 90, "device": "cpu"}
    progress = [m.values for m in messages if m.type is MessageType.PROGRESS]
    assert [p["epoch"] for p in progress] == list(range(1, 41))
    for name in ("training_mm", "validation_mm"):
        assert 0 < progress[-1][name] < progress[0][name]
    joints = [m.values["joint"] for m in messages if m.type is MessageType.PARTITION_FINISHED]
    assert joints == ["bone_0", "bone_1", "bone_2"]
    assert messages[-1].type is MessageType.FINISHED and messages[-1].values["model"] == str(model)


def test_a_message_is_flushed_immediately(monkeypatch):
    buffer = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(buffer, encoding="utf-8"))
    MessageSink().send(MessageType.LOG, text="half way")
    assert Message.decode(buffer.getvalue().decode()).values == {"text": "half way"}


def test_two_processes_write_the_same_model_and_import_no_compiler(recording, tmp_path):
    """PyTorch's compiler takes long to import, and a training does not need it."""
    code = "import sys; from trainer.__main__ import main; print(main(sys.argv[1:]), 'torch._dynamo' in sys.modules)"
    models = [tmp_path / "first.onnx", tmp_path / "second.onnx"]
    for model in models:
        command = [sys.executable, "-c", code, str(recording), str(model), "--passes", "5", "--seed", "3"]
        result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
        assert (result.stdout.splitlines()[-1], result.stderr) == ("0 False", "")
    assert models[0].read_bytes() == models[1].read_bytes()


def run_failing_training(arguments, capsys) -> str:
    assert main([*map(str, arguments), "--passes", "2"]) == 1
    output = capsys.readouterr()
    messages = decode_messages(output.out)
    assert messages[-1].type is MessageType.FAILED
    assert output.err.strip() == messages[-1].values["text"]
    return output.err.strip()


def test_a_missing_recording_is_refused(tmp_path, capsys):
    assert "is not a recording" in run_failing_training([tmp_path / "none", tmp_path / "m.onnx"], capsys)


def test_too_few_poses_are_refused(tmp_path, capsys):
    write_chain(tmp_path / "few", pose_count=5)
    assert "has 5 poses and training takes at least 10" in run_failing_training(
        [tmp_path / "few", tmp_path / "m.onnx"], capsys
    )


def test_a_missing_output_folder_is_refused(recording, tmp_path, capsys):
    text = run_failing_training([recording, tmp_path / "no" / "m.onnx"], capsys)
    assert "does not exist; create it first" in text


def test_a_folder_as_output_is_refused(recording, tmp_path, capsys):
    (tmp_path / "m.onnx").mkdir()
    assert "it is a folder" in run_failing_training([recording, tmp_path / "m.onnx"], capsys)


def test_a_diverging_training_fails_with_one_sentence(recording, tmp_path, capsys):
    text = run_failing_training([recording, tmp_path / "m.onnx", "--learning-rate", "1e30"], capsys)
    assert "diverged in epoch 1" in text and "smaller learning rate than 1e+30" in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [["only-one"], ["recording", "m.onnx", "--learning-rate", "-1"]])
def test_wrong_usage_exits_with_two(arguments):
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2


@pytest.mark.parametrize("max_file_bytes", [pytest.param(20_000, marks=pytest.mark.slow), "after the model"])
def test_a_full_disk_leaves_the_old_files(recording, trained, tmp_path, max_file_bytes):
    if max_file_bytes == "after the model":
        # The report is written last and is the largest file, so only the report exceeds this limit.
        sizes = sorted(path.stat().st_size for path in trained.iterdir())
        max_file_bytes = (sizes[-2] + sizes[-1]) // 2

    resource = pytest.importorskip("resource")

    def limit_file_size() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_file_bytes, max_file_bytes))

    old_model = trained.joinpath("model.onnx").read_bytes()
    (tmp_path / "m.onnx").write_bytes(old_model)
    process = start_trainer(recording, tmp_path / "m.onnx", "--passes", "2", preexec_fn=limit_file_size)
    output, error_text = process.communicate(timeout=120)
    assert process.returncode == 1
    assert decode_messages(output)[-1].type is MessageType.FAILED
    assert error_text.startswith(
        f"Cannot write '{tmp_path / 'm.onnx'}' with 'm.checkpoint.npz', 'report.json', 'report.html': "
    )
    assert error_text.endswith("File too large; nothing was changed.\n")
    assert [p.name for p in tmp_path.iterdir()] == ["m.onnx"]
    assert (tmp_path / "m.onnx").read_bytes() == old_model


@pytest.mark.parametrize(
    "stop_request",
    [
        "file",
        pytest.param("SIGTERM", marks=ONLY_POSIX),
        *(pytest.param(name, marks=[ONLY_POSIX, pytest.mark.slow]) for name in ("SIGINT", "SIGHUP")),
    ],
)
def test_a_stopped_training_writes_nothing(recording, tmp_path, monkeypatch, stop_request):
    stop_file, folder = tmp_path / "stop", tmp_path / "models"
    folder.mkdir()
    monkeypatch.setenv(STOP_FILE_VARIABLE, str(stop_file))
    process = start_trainer(recording, folder / "m.onnx", "--passes", "100000")
    lines = []
    for line in process.stdout:
        lines.append(line)
        if len(lines) == 5:
            stop_file.touch() if stop_request == "file" else process.send_signal(getattr(signal, stop_request))
    process.wait(timeout=30)
    assert process.returncode == 130, process.stderr.read()
    messages = decode_messages("".join(lines))
    assert messages[-1] == Message(MessageType.CANCELLED)
    assert list(folder.iterdir()) == []


@ONLY_POSIX
def test_a_training_whose_reader_was_killed_writes_nothing(recording, tmp_path):
    """The export sends no more messages, so the trainer has to notice by itself."""
    process = start_trainer(recording, tmp_path / "m.onnx", "--passes", "2")
    while "Exporting the model" not in process.stdout.readline():
        pass
    process.stdout.close()
    assert process.wait(timeout=30) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_stop_request_before_the_start_cancels_the_training(recording, tmp_path, monkeypatch):
    monkeypatch.setenv(STOP_FILE_VARIABLE, str(recording))
    process = start_trainer(recording, tmp_path / "m.onnx")
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130 and Message.decode(output) == Message(MessageType.CANCELLED)
    assert list(tmp_path.iterdir()) == []


FULL_DISK_ERROR = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "x")


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (FULL_DISK_ERROR, 75, f"'x': {FULL_DISK_ERROR.strerror}; make room, end other programs, or try again."),
        (OSError(errno.EIO, "Input/output error"), 75, "Input/output error; make room, end other"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), 75, "The training lacks memory ("),
        (MemoryError(), 75, "The training lacks memory ("),
        (RuntimeError("DefaultCPUAllocator: not enough memory: you tried"), 75, "The training lacks memory ("),
        (OSError("[WinError 1455] The paging file is too small"), 75, "The training lacks memory ("),
        (OSError('[WinError 1114] … Error loading "c10.dll"'), 1, "install Microsoft's Visual C++ runtime from https:"),
        (ImportError("libgomp.so.1: cannot open shared object file: No such file"), 1, "Linux that has 'libgomp.so.1'"),
        (KeyError("x"), 1, "The trainer stopped on an error of its own (KeyError('x')); please report it."),
    ],
)
def test_an_error_has_its_sentence_and_exit_status(error, status, text, capsys):
    def fail():
        raise error

    assert run_with_messages(fail, MessageSink()) == status
    output, error_text = capsys.readouterr()
    values = Message.decode(output).values
    assert text in values["text"] and values.get("try_again", False) is (status == 75)
    assert error_text.splitlines()[-1] == values["text"]


def test_the_error_for_missing_torch_names_what_to_install(recording, tmp_path):
    code = "import sys; sys.modules['torch'] = None; from trainer.__main__ import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.run(
        [sys.executable, "-c", code, str(recording), str(tmp_path / "m.onnx")],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 1
    text = decode_messages(process.stdout)[-1].values["text"]
    assert "needs the Python package 'torch'" in text and "install torch" in text
    assert process.stderr.strip() == text


ASCII_ENVIRONMENT = {
    **os.environ,
    "PYTHONIOENCODING": "ascii",
    "LC_ALL": "C",
    "PYTHONUTF8": "0",
    "PYTHONCOERCECLOCALE": "0",
}


@pytest.fixture
def unicode_recording(tmp_path):
    """A recording of a chain with names in several scripts."""
    rig = chain_rig(2)
    mesh = replace(rig.meshes[0], name="Ärmel")
    rig = replace(rig, joints=(Joint("Wurzel ß", -1), Joint("前腕.L", 0)), meshes=(mesh,))
    angles = chain_angles(60, 2, 0)
    path = tmp_path / "Aufnahme äöü"
    arrays = pose_chain(rig, angles), chain_residuals(rig, angles)
    write_recording(path, rig, make_partitions(rig, {0: (1,), 1: (1,)}), chain_info(60), *arrays)
    return path


def run_module(*arguments) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=REPOSITORY, env=ASCII_ENVIRONMENT, capture_output=True, check=False)


def test_an_ascii_terminal_and_a_model_name_that_is_not_utf_8(unicode_recording, tmp_path):
    name = "modèle.onnx".encode() if systems.WINDOWS else b"m\xff.onnx"  # On Windows every file name is text.
    model = os.fsencode(tmp_path) + b"/" + name
    process = run_module("trainer", unicode_recording, model, "--passes", "2", "--hidden", "8")
    assert process.returncode == 0, process.stderr
    assert rb"\u524d\u8155.L" in process.stdout and rb"Wurzel \u00df" in process.stdout
    assert os.path.exists(model) and (tmp_path / "report.html").exists()
