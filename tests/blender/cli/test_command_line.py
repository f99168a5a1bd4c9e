# SPDX-License-Identifier: GPL-3.0-or-later
"""Exit statuses, options, output and files of the command line."""

import errno
import io
import os
import shutil

import bpy
import pytest

import fdda_addon
from fdda_addon.cli import build_arm
from fdda_addon.cli.main import VERBS
from fdda_addon.cli.progress import ProgressPrinter
from fdda_addon.core.errors import TRY_AGAIN, OutputError
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.runtime.session import session

from ..conftest import assert_plays, evaluated_positions, pose, run
from ..refusals import file_contents, save_elbow


@pytest.mark.parametrize("arguments", [["--help"], *([verb, "--help"] for verb in VERBS)], ids=" ".join)
def test_help_prints_the_usage(arguments, capfd):
    assert run(*arguments) == 0
    captured = capfd.readouterr()
    assert captured.out.startswith("usage: ") and not captured.err
    if arguments == ["--help"]:
        assert all(verb in captured.out for verb in VERBS)


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["paint"],
        ["record"],
        ["record", "a.blend", "b", "--poses", "many"],
        ["record", "a.blend", "b", "--poses", "-1"],
        ["record", "a.blend", "b", "--spread", "nan"],
        ["record", "a.blend", "b", "--color"],
        ["record", "a.blend", "b", "--overwrite", "--resume"],
        ["record", "a.blend", "b", "--settle-frames", "3"],
        ["build-arm", "a.blend", "--density", "4"],
        ["bind", "a.blend", "m.onnx"],
        ["evaluate", "a.blend", "m.onnx", "--json", "e.json", "--poses", "0"],
        ["evaluate", "a.blend", "m.onnx", "--json", "e.json", "--range-scale", "0"],
        ["benchmark", "a.blend", "m.onnx", "--json", "b.json", "--frames", "0"],
        ["fast-rig", "a.blend", "m.onnx", "b.blend", "--frames", "-1"],
        ["fast-rig", "a.blend", "m.onnx", "b.blend", "--controls", "shown"],
        ["train"],
        ["train", "recording", "m.onnx", "--color", "red"],
    ],
    ids=" ".join,
)
def test_wrong_usage(arguments, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    captured = capfd.readouterr()
    assert captured.err.strip() and not captured.out
    assert "Traceback" not in captured.err
    assert file_contents(tmp_path) == {}


def test_a_full_disk_ends_with_the_status_for_another_try(tmp_path, monkeypatch, capfd):
    """Render farms repeat jobs that end with this status."""

    def fail(_options: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(build_arm, "run", fail)
    assert run("build-arm", tmp_path / "arm.blend") == TRY_AGAIN == 75
    assert capfd.readouterr().err.startswith("Error: No space left on device")


def test_train_passes_its_options_to_the_trainer(elbow_files, tmp_path, capfd):
    model = tmp_path / "m.onnx"
    options = ["--passes", 3, "--hidden", 8, 16, "--activation", "tanh", "--seed", 9, "--learning-rate", "0.002"]
    assert run("train", elbow_files.recording, model, *options) == 0
    from fdda_addon.core.formats.model import read_model_info

    training = read_model_info(model).training
    assert (training["passes"], training["hidden"], training["activation"], training["seed"]) == (3, [8, 16], "tanh", 9)
    assert training["learning_rate"] == 0.002
    captured = capfd.readouterr()
    assert captured.out.splitlines()[-1].startswith(f"{model}: trained in ")
    assert "training: 3 of 3, " in captured.err and "validation " in captured.err
    assert sorted(file_contents(tmp_path)) == ["m.checkpoint.npz", "m.onnx", "report.html", "report.json"]


def test_record_prints_plain_lines_without_a_terminal(elbow_files, tmp_path, capfd):
    assert run("record", elbow_files.rig, tmp_path / "r", "--poses", 20, "--seed", 4, "--action", "elbow_wave") == 0
    captured = capfd.readouterr()
    choice, estimate, summary = captured.out.splitlines()
    assert choice == "Random poses combine limbs from 1 recorded action."
    assert estimate.startswith(
        "50 poses, and 12 to find what each bone and input moves, each of 300 vertices: less than 1 MB on the disk, "
        "about "
    )
    assert summary.startswith(f"{tmp_path / 'r'}: 50 poses, and 12 to find what each bone and input moves, in ")
    lines = captured.err.splitlines()
    assert lines[0].startswith("poses: 0 of 50, ") and lines[-1].startswith("influences: 12 of 12, ")
    assert any(line.startswith("poses: 50 of 50, ") for line in lines)
    assert "\r" not in captured.err and "\x1b" not in captured.err
    recording = read_recording(tmp_path / "r")
    assert recording.info.sampling.seed == 4
    assert [(s.kind, s.poses) for s in recording.info.sampling.sources] == [
        *(("random", 20), ("action", 30), ("alone", 12)),
    ]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_a_progress_bar():
    stream = Terminal()
    with ProgressPrinter(stream) as progress:
        for done_count in range(5):
            progress.show("poses", done_count, 4, "fine")
        progress.say("hello")
        progress.show("more", 1, 2)
    lines = stream.getvalue().split("\n")
    assert lines[0].count("\r") == 5 and "4/4" in lines[0] and "█" * 30 in lines[0] and "fine" in lines[0]
    assert lines[1] == "hello"
    assert "1/2" in lines[2] and "█" * 15 + "░" * 15 in lines[2] and lines[3] == ""


def test_a_stage_prints_about_ten_plain_lines():
    stream = io.StringIO()
    with ProgressPrinter(stream) as progress:
        for done_count in range(1001):
            progress.show("poses", done_count, 1000)
        progress.show("next", 0, 0)
    lines = stream.getvalue().splitlines()
    assert (
        len(lines) == 12 and lines[0].startswith("poses: 0 of 1000, ") and lines[10].startswith("poses: 1000 of 1000")
    )


def test_the_option_object_selects_a_mesh(elbow_files, tmp_path, capfd):
    def add_second(rig):
        second = rig.mesh_object.copy()
        second.data = second.data.copy()
        second.name = "sleeve"
        bpy.context.scene.collection.objects.link(second)
        rig.mesh_object.hide_viewport = True

    path = save_elbow(tmp_path / "rig.blend", add_second)
    assert run("record", path, tmp_path / "r", "--object", "sleeve", "--poses", 3) == 0
    assert read_recording(tmp_path / "r").rig.meshes[0].name == "sleeve"
    assert run("record", path, tmp_path / "other", "--object", "elbow", "--poses", 3) == 1
    assert "'elbow' is hidden" in capfd.readouterr().err


def open_in_new_session(path) -> bpy.types.Object:
    """Open a file without the models that a user has selected in this session, and return its elbow."""
    session.reset()
    session.chosen_paths.clear()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.data.objects["elbow"]


def test_a_bound_file_plays_when_it_is_opened(elbow_files, tmp_path, capfd):
    """Rig, model and bound file are in different folders, so the model is copied into the bound file's folder."""
    model, out = tmp_path / "models" / "m.onnx", tmp_path / "out" / "bound.blend"
    for path in (model, out):
        path.parent.mkdir()
    shutil.copy(elbow_files.model, model)
    assert run("bind", elbow_files.rig, model, out) == 0
    assert capfd.readouterr().out.splitlines() == [
        f"{out.parent / 'm.onnx'}: a copy of {model}, beside the file that plays it",
        f"{out}: 'elbow' plays m.onnx",
    ]
    assert (out.parent / "m.onnx").read_bytes() == elbow_files.model.read_bytes()
    shutil.rmtree(model.parent)
    moved = out.parent.rename(tmp_path / "elsewhere")
    mesh_object = open_in_new_session(moved / "bound.blend")
    assert mesh_object.fdda.model == "//m.onnx" and not mesh_object.fdda.use_in_render
    pose(angle=0.3)
    first = assert_plays(mesh_object, elbow_files.model)
    pose(angle=1.7)
    assert abs(assert_plays(mesh_object, elbow_files.model) - first).max() > 0.01


def test_a_bound_file_that_cannot_be_saved_leaves_no_copy_of_the_model(elbow_files, tmp_path, monkeypatch):
    def fail(_path: object) -> None:
        raise OutputError("There is no room.")

    monkeypatch.setattr("fdda_addon.cli.bind.save_copy", fail)
    assert run("bind", elbow_files.rig, elbow_files.model, tmp_path / "b.blend") == 1
    assert file_contents(tmp_path) == {}


def test_a_model_below_the_folder_is_not_copied(elbow_files, tmp_path, monkeypatch):
    (tmp_path / "models").mkdir()
    shutil.copy(elbow_files.model, tmp_path / "models" / "m.onnx")
    monkeypatch.chdir(tmp_path)
    assert run("bind", elbow_files.rig, "models/m.onnx", "bound.blend") == 0
    assert sorted(file_contents(tmp_path)) == ["bound.blend", "models", "models/m.onnx"]
    mesh_object = open_in_new_session(tmp_path / "bound.blend")
    assert mesh_object.fdda.model == "//models/m.onnx"
    pose(angle=1.0)
    assert_plays(mesh_object, elbow_files.model)


def test_binding_does_not_write_rig_and_model_nor_an_identical_model_in_the_folder(elbow_files, tmp_path):
    shutil.copy2(elbow_files.model, tmp_path / elbow_files.model.name)
    before = (tmp_path / elbow_files.model.name).stat(), elbow_files.rig.read_bytes(), elbow_files.model.read_bytes()
    assert run("bind", elbow_files.rig, elbow_files.model, tmp_path / "b.blend") == 0
    after = (tmp_path / elbow_files.model.name).stat()
    assert (before[0].st_mtime_ns, before[0].st_ino) == (after.st_mtime_ns, after.st_ino)
    assert (elbow_files.rig.read_bytes(), elbow_files.model.read_bytes()) == before[1:]


def test_binding_a_bound_file_again_keeps_one_modifier(elbow_files, tmp_path):
    assert run("bind", elbow_files.bound, elbow_files.model, tmp_path / "b.blend") == 0
    mesh_object = open_in_new_session(tmp_path / "b.blend")
    assert sum(m.type == "NODES" for m in mesh_object.modifiers) == 1
    pose(angle=1.3)
    assert_plays(mesh_object, elbow_files.model)


@pytest.mark.parametrize("options", [(), ("--use-in-render",)])
def test_bind_sets_use_in_render_and_without_the_add_on_the_file_shows_the_rig(elbow_files, tmp_path, options):
    assert run("bind", elbow_files.rig, elbow_files.model, tmp_path / "b.blend", *options) == 0
    rig_shape = evaluated_positions(open_in_new_session(elbow_files.rig))
    mesh_object = open_in_new_session(tmp_path / "b.blend")
    model_shape = evaluated_positions(mesh_object)
    assert mesh_object.fdda.use_in_render == bool(options)
    if options:
        assert [m.show_render for m in mesh_object.modifiers] == [False, False, True, True]
    fdda_addon.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b.blend"))
    error = abs(evaluated_positions(bpy.data.objects["elbow"]) - rig_shape).max()
    assert error < 1e-6 < abs(model_shape - rig_shape).max()


def test_verbs_restore_whether_the_add_on_is_registered(elbow_files, tmp_path):
    assert run("record", elbow_files.rig, tmp_path / "a", "--poses", 1) == 0
    assert fdda_addon.is_registered()
    fdda_addon.unregister()
    assert run("record", elbow_files.rig, tmp_path / "b", "--poses", 1) == 0
    assert not fdda_addon.is_registered() and not hasattr(bpy.types.Object, "fdda")
