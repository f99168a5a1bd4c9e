# SPDX-License-Identifier: GPL-3.0-or-later
"""A training goes on when the Blender that started it is closed, and whoever opens the character follows it."""

import subprocess
import sys
import time
from pathlib import Path

import bpy
import pytest

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.messages import MessageType
from fdda_addon.core.model import read_model_info
from fdda_addon.training import detached_process

pytestmark = pytest.mark.one_blender_version

LEAVING = """
import sys
sys.path.insert(0, {root!r})
from pathlib import Path
from fdda_addon.training import detached_process
detached_process.user_folder = lambda: Path({user!r})
with detached_process.DetachedTraining([{recording!r}, {model!r}, "--epochs", "{epochs}"], Path({model!r})) as training:
    next(training.messages())
    training.detach()
"""
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def _user(tmp_path, monkeypatch):
    monkeypatch.setattr(detached_process, "user_folder", lambda: tmp_path / "user")


def leave_in_another_process(elbow, model: Path, epochs: int) -> None:
    """Start a training in a process of its own that ends while it goes on."""
    user = model.parent / "user"
    code = LEAVING.format(
        root=str(ROOT), user=str(user), recording=str(elbow.recording), model=str(model), epochs=epochs
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_it_goes_on_when_its_blender_is_closed_and_is_followed_from_the_start(elbow, tmp_path):
    model = tmp_path / "m.onnx"
    leave_in_another_process(elbow, model, 30)
    assert detached_process.is_detached(model) and not model.exists()
    with detached_process.AttachedTraining(model) as training:
        kinds = [message.type for message in training.messages()]
    assert kinds[0] is MessageType.STARTED and kinds.count(MessageType.PROGRESS) == 30
    assert kinds[-1] is MessageType.FINISHED
    assert read_model_info(model).training["epochs"] == 30
    assert not detached_process.is_detached(model)


def test_one_that_ended_meanwhile_is_followed_too(elbow, tmp_path):
    model = tmp_path / "m.onnx"
    leave_in_another_process(elbow, model, 3)
    end = time.monotonic() + 60
    while detached_process._ProcessFiles(model).is_running() and time.monotonic() < end:
        time.sleep(0.1)
    with detached_process.AttachedTraining(model) as training:
        assert [message.type for message in training.messages()][-1] is MessageType.FINISHED


def test_one_that_was_killed_says_so(elbow, tmp_path):
    model = tmp_path / "m.onnx"
    leave_in_another_process(elbow, model, 100_000)
    with detached_process.AttachedTraining(model) as training:
        training._process.kill()
        with pytest.raises(TrainingError, match="before it was done; no model was written, train again"):
            list(training.messages())
    assert not detached_process.is_detached(model)


def test_one_that_is_followed_can_be_cancelled(elbow, tmp_path):
    model = tmp_path / "m.onnx"
    leave_in_another_process(elbow, model, 100_000)
    with detached_process.AttachedTraining(model) as training:
        messages = training.messages()
        next(messages)
        training.cancel()
        assert list(messages)[-1].type is MessageType.CANCELLED
    assert not model.exists() and not detached_process.is_detached(model)
    assert list((tmp_path / "user" / "trainings").iterdir()) == []


def test_one_that_died_says_why_to_another_blender(tmp_path):
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


def test_one_that_is_not_left_ends_with_its_block(elbow, tmp_path):
    model = tmp_path / "m.onnx"
    with detached_process.DetachedTraining([str(elbow.recording), str(model), "--epochs", "100000"], model) as training:
        next(training.messages())
        process = training._process
    assert process.poll() is not None and not detached_process.is_detached(model)


def test_a_number_of_another_process_is_never_ended(tmp_path):
    """A machine that was switched off has given the number to somebody else."""
    model = tmp_path / "m.onnx"
    bystander = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        files = detached_process._ProcessFiles(model)
        files.new_messages().close()
        files.write_process_id(bystander.pid)
        with detached_process.AttachedTraining(model) as training:
            training.cancel()
            training._process.kill()
            list(training.messages())
        assert bystander.poll() is None
    finally:
        bystander.kill()
        bystander.wait()


def test_an_attached_training_ends_when_another_blender_has_removed_its_files(tmp_path):
    files = detached_process._ProcessFiles(tmp_path / "m.onnx")
    with files.new_messages():
        files.write_process_id(1)
        with detached_process.AttachedTraining(tmp_path / "m.onnx") as training:
            files.remove()
            training._reader.join(5)
            assert not training._reader.is_alive() and training._lines.get_nowait() is None


def test_what_is_no_record_is_none(tmp_path):
    files = detached_process._ProcessFiles(tmp_path / "m.onnx")
    files.new_messages().close()
    for text in ("", "[]", '{"process": "x"}', '{"process": null}'):
        files._path.write_text(text)
        assert not detached_process.is_detached(tmp_path / "m.onnx")


def test_adjust_last_operation_is_not_offered_for_any_job():
    """It would do the work again at every change, in the foreground."""
    from importlib import import_module

    from fdda_addon import operators
    from fdda_addon.operators.job import JobOperator

    classes = [c for name in operators.MODULES for c in import_module(f"fdda_addon.operators.{name}").CLASSES]
    jobs = [c for c in classes if issubclass(c, JobOperator)]
    assert len(jobs) > 5 and [c.bl_idname for c in jobs if "UNDO" in c.bl_options] == []


def test_another_file_knows_nothing_of_a_job_that_ended(rig):
    from fdda_addon.jobs import job

    bpy.ops.fdda.measure()
    assert job.state_of("measure").subject == rig.mesh_object.session_uid
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert job.state_of("measure") is None
