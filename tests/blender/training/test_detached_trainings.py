# SPDX-License-Identifier: GPL-3.0-or-later
"""Detached trainings continue after the Blender that started them is closed; another Blender can attach to them."""

import subprocess
import sys
from pathlib import Path

import bpy
import pytest

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.formats.messages import MessageType
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.training import detached_process

from ... import systems

pytestmark = pytest.mark.one_blender_version

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
