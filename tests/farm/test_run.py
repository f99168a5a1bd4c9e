# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of running tasks with real verbs: once, again after a kill, and again after a change of their inputs."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from farm import process
from farm.characters import Farm, read_plan
from farm.fingerprints import InputFingerprints, outdated_tasks, read_manifest
from farm.process import TryAgainError, VerbError, hold_lock, run_verb, verb_environment
from farm.run import AGAIN, DONE, FAILED, NOT_NEEDED, UP_TO_DATE, run_task
from farm.tasks import make_tasks
from fdda_addon.core.errors import TRY_AGAIN
from fdda_addon.core.model import read_model_info
from fdda_addon.core.recording.reader import read_recording

from .conftest import ELBOW, ONE_CHARACTER, ROOT, SMALL_SETTINGS, read_all_files, run_tasks, states_by_task

CHARACTER_WITH_ROUNDS = ONE_CHARACTER + "goal_mm = 0.001\nrounds = 1\n"


@pytest.fixture(scope="module")
def elbow_farm(tmp_path_factory):
    """Run all tasks of the elbow's farm once; return its plan and the outcomes."""
    folder = tmp_path_factory.mktemp("farm")
    (folder / "elbow.blend").write_bytes(ELBOW.read_bytes())

    (folder / "characters.toml").write_text(SMALL_SETTINGS + CHARACTER_WITH_ROUNDS)
    plan = read_plan(folder / "characters.toml")
    return plan, run_tasks(plan)


def test_all_tasks_of_a_character_run_and_the_best_model_is_bound(elbow_farm):
    plan, outcomes = elbow_farm
    assert set(states_by_task(outcomes).values()) == {DONE}, outcomes
    out = plan.characters[0].output
    assert {"elbow.blend", "elbow.onnx", "report.html", "report.json", "evaluation.json"} <= set(os.listdir(out))
    refined = read_recording(plan.farm.work / "elbow/refine-1/recording")
    assert [source.poses for source in refined.info.sampling.sources] == [20, 6]
    trained = [read_model_info(plan.farm.work / f"elbow/train-{n}/elbow.onnx").trained_poses for n in (0, 1)]
    assert trained == [20, 26]
    best = min(
        (0, 1),
        key=lambda n: json.loads((plan.farm.work / f"elbow/evaluate-{n}/evaluation.json").read_text())["fdda"]["p999"],
    )
    bound = read_manifest(make_tasks(plan)["elbow/bind"]).notes["bound"]
    assert bound == {"elbow.onnx": f"elbow/train-{best}"}
    assert (out / "elbow.onnx").read_bytes() == (plan.farm.work / f"elbow/train-{best}/elbow.onnx").read_bytes()


def test_tasks_that_are_up_to_date_change_no_file(elbow_farm):
    plan, _ = elbow_farm
    old_files = read_all_files(plan.farm.work)
    tasks = make_tasks(plan)
    assert outdated_tasks(tasks, InputFingerprints(plan.farm, tasks)) == ([], {})
    assert set(states_by_task(run_tasks(plan)).values()) == {UP_TO_DATE}
    assert read_all_files(plan.farm.work) == old_files


def test_a_lost_file_is_made_again_only_when_a_task_needs_it(elbow_farm):
    plan, _ = elbow_farm
    tasks = make_tasks(plan)
    fingerprints = InputFingerprints(plan.farm, tasks)
    lost_file = plan.farm.work / "elbow/evaluate-1/evaluation.json"
    old_content = lost_file.read_bytes()
    lost_file.unlink()
    # bind is done, so no task needs the evaluation.
    assert outdated_tasks(tasks, fingerprints) == ([], {})
    (plan.characters[0].output / "elbow.blend").unlink()
    assert outdated_tasks(tasks, fingerprints)[0] == ["elbow/evaluate-1", "elbow/bind"]
    assert run_task(plan.farm, tasks, "elbow/evaluate-1").state == DONE
    assert json.loads(lost_file.read_bytes())["fdda"] == json.loads(old_content)["fdda"]
    assert run_task(plan.farm, tasks, "elbow/bind").state == DONE


def test_a_changed_output_is_refused_and_made_again(elbow_farm):
    plan, _ = elbow_farm
    tasks = make_tasks(plan)
    model = plan.farm.work / "elbow/train-1/elbow.onnx"
    old_model = model.read_bytes()
    model.write_bytes(old_model[:-1] + b"x")
    tasks["elbow/evaluate-1"].manifest.unlink()
    outcome = run_task(plan.farm, tasks, "elbow/evaluate-1")
    assert outcome.state == FAILED
    assert f"'{model}' was changed since 'elbow/train-1' wrote it" in outcome.sentence
    tasks["elbow/bind"].manifest.unlink()
    assert outdated_tasks(tasks, InputFingerprints(plan.farm, tasks))[0] == [
        f"elbow/{name}" for name in ("train-1", "evaluate-1", "bind")
    ]
    new_states = [run_task(plan.farm, tasks, f"elbow/{name}").state for name in ("train-1", "evaluate-1", "bind")]
    assert new_states == [DONE] * 3
    assert model.read_bytes() == old_model, "the same recording and settings give the same bytes"


def test_the_rounds_end_when_the_goal_is_met(elbow_farm):
    plan, _ = elbow_farm
    plan.path.write_text(plan.path.read_text().replace("goal_mm = 0.001", "goal_mm = 1000.0"))

    states = states_by_task(run_tasks(read_plan(plan.path)))
    assert {name: state for name, state in states.items() if "-1" in name and "record" not in name} == {
        f"elbow/{name}-1": NOT_NEEDED for name in ("refine", "train", "evaluate")
    }
    assert states["elbow/record-1"] == states["elbow/merge"] == UP_TO_DATE
    assert states["elbow/train-0"] == states["elbow/bind"] == DONE


def test_a_changed_setting_changes_the_fingerprints_of_dependent_tasks(write_plan, tmp_path):
    def fingerprints(characters: str, settings: str = "") -> dict[str, str]:
        plan = write_plan(characters, settings)
        tasks = make_tasks(plan)
        return {name: InputFingerprints(plan.farm, tasks).of_task(name) for name in tasks}

    old_fingerprints = fingerprints(ONE_CHARACTER)

    def changed(characters: str, settings: str = "") -> set[str]:
        new_fingerprints = fingerprints(characters, settings)
        return {name for name, key in new_fingerprints.items() if old_fingerprints.get(name) != key}

    all_tasks = set(old_fingerprints)
    assert changed(ONE_CHARACTER) == changed(
        ONE_CHARACTER + 'shards = 4\n[characters.other]\nrig = "elbow.blend"\noutput = "o"'
    ) - {
        name
        for name in fingerprints(ONE_CHARACTER + '[characters.other]\nrig = "elbow.blend"\noutput = "o"')
        if "other" in name
    }
    assert changed(ONE_CHARACTER + "seed = 3") == all_tasks
    assert changed(ONE_CHARACTER + "train = { epochs = 5 }") == {"elbow/train-0", "elbow/evaluate-0", "elbow/bind"}
    assert changed(ONE_CHARACTER, "[farm]\nthreads = 2") == {"elbow/train-0", "elbow/evaluate-0", "elbow/bind"}
    assert changed(ONE_CHARACTER + "use_in_render = true") == {"elbow/bind"}
    assert changed(ONE_CHARACTER, '[farm]\nwork = "elsewhere"') == set(), "the work folder may be moved"
    with open(tmp_path / "elbow.blend", "ab") as file:
        file.write(b"x")
    assert changed(ONE_CHARACTER) == all_tasks


WORKER_SCRIPT = """
import sys
from pathlib import Path
from farm.characters import read_plan
from farm.run import run_task
from farm.tasks import make_tasks
plan = read_plan(Path(sys.argv[1]))
print(run_task(plan.farm, make_tasks(plan), sys.argv[2]).state)
"""


def start_worker(plan, name: str) -> subprocess.Popen:
    """Start a process that runs one task."""
    return subprocess.Popen(
        [sys.executable, "-c", WORKER_SCRIPT, plan.path, name], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )


def wait_until(condition, max_seconds: float = 60) -> None:
    deadline = time.monotonic() + max_seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def count_complete_poses(recording: Path) -> int:
    try:
        return json.loads((recording / "recording.json").read_text())["complete"]
    except FileNotFoundError:
        return 0


@pytest.mark.parametrize("kills_verb", [False, True])
def test_a_killed_worker_loses_no_poses(write_plan, kills_verb):
    """A verb that survives its worker continues, and the next worker waits for it; a killed verb is resumed."""
    plan = write_plan(ONE_CHARACTER + "poses = 4000\nshards = 1")
    tasks = make_tasks(plan)
    assert run_task(plan.farm, tasks, "elbow/influences").state == DONE
    task = tasks["elbow/record-1"]
    worker = start_worker(plan, task.name)
    recording = task.folder / "recording"
    wait_until(lambda: count_complete_poses(recording))
    if kills_verb:
        children = Path(f"/proc/{worker.pid}/task/{worker.pid}/children").read_text().split()
    worker.kill()
    worker.wait()
    if kills_verb:
        for child in children:
            os.kill(int(child), signal.SIGKILL)
    pose_count = count_complete_poses(recording)
    assert 0 < pose_count < 4000 and read_manifest(task) is None
    assert run_task(plan.farm, tasks, task.name).state == DONE
    last_log = task.log.read_text().rpartition("$ record")[2]
    first_count = next(int(line.split()[1]) for line in last_log.splitlines() if line.startswith("poses: "))
    assert first_count >= pose_count and count_complete_poses(recording) == 4000, "no pose is recorded twice"


def test_the_second_of_two_workers_finds_the_task_done(write_plan):
    plan = write_plan()
    workers = [start_worker(plan, "elbow/influences") for _ in range(2)]
    assert sorted(worker.communicate()[0].strip() for worker in workers) == ["done", "up to date"]


def test_a_lock_is_released_when_its_last_process_ends(tmp_path):
    acquired_locks = []
    with hold_lock(tmp_path / "lock") as lock:
        sleeper = subprocess.Popen(["sleep", "0.5"], pass_fds=(lock,))
    waiting_thread = threading.Thread(target=lambda: acquired_locks.append(hold_lock(tmp_path / "lock").__enter__()))
    waiting_thread.start()
    time.sleep(0.1)
    assert not acquired_locks and sleeper.poll() is None
    waiting_thread.join(20)
    assert acquired_locks and sleeper.wait() == 0


def run_code_as_verb(tmp_path: Path, monkeypatch, code: str) -> None:
    """Run Python code in place of a verb."""
    monkeypatch.setattr(process, "verb_command", lambda farm, verb: [sys.executable, "-c", code])
    with hold_lock(tmp_path / "lock") as lock:
        run_verb(None, ("record",), tmp_path, tmp_path / "log", lock)


@pytest.mark.parametrize(
    ("code", "error", "message"),
    [
        (
            "import sys; print('poses: 1 of 2'); print('Error: No rig.', file=sys.stderr); sys.exit(1)",
            VerbError,
            "No rig.",
        ),
        (f"import sys; print('Error: Full.', file=sys.stderr); sys.exit({TRY_AGAIN})", TryAgainError, "Full."),
        ("import os; os.kill(os.getpid(), 9)", TryAgainError, "record was ended by signal 9."),
        ("import sys; print('usage: x', file=sys.stderr); sys.exit(2)", VerbError, "usage: x"),
        ("import sys; sys.exit(3)", VerbError, "record ended with status 3; see"),
    ],
)
def test_the_exit_status_of_a_verb_determines_its_error(tmp_path, monkeypatch, code, error, message):
    monkeypatch.setattr(process, "verb_environment", lambda farm, verb: dict(os.environ))
    with pytest.raises(error) as raised:
        run_code_as_verb(tmp_path, monkeypatch, code)
    assert str(raised.value).startswith(message) and type(raised.value) is error


def test_a_verb_inherits_the_environment_except_threads_and_dask_variables(tmp_path, monkeypatch):
    monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", "65536")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("OF_THE_USER", "yes")
    farm = Farm(tmp_path, threads=3)
    training, recording = (verb_environment(farm, (verb,)) for verb in ("train", "record"))
    assert (training["OMP_NUM_THREADS"], recording["OMP_NUM_THREADS"]) == ("3", "1")
    assert training["CUDA_VISIBLE_DEVICES"] == "" and training["OF_THE_USER"] == recording["OF_THE_USER"] == "yes"
    assert "MALLOC_TRIM_THRESHOLD_" not in {*training, *recording}, "it slows verbs down by a third"


def test_a_broken_or_missing_rig_fails_with_a_message(write_plan, tmp_path):
    plan = write_plan(
        '[characters.bad]\nrig = "bad.blend"\noutput = "out"\n[characters.missing]\nrig = "missing.blend"\noutput = "o"'
    )
    (tmp_path / "bad.blend").write_text("not a .blend file")
    tasks = make_tasks(plan)
    outcome = run_task(plan.farm, tasks, "bad/influences")
    assert outcome.state == FAILED and "Blender cannot open" in outcome.sentence
    names, unreadable = outdated_tasks(tasks, InputFingerprints(plan.farm, tasks))
    assert "bad/influences" in names and list(unreadable) == ["missing/bind"]
    assert (
        unreadable["missing/bind"]
        == f"There is no file '{tmp_path / 'missing.blend'}' (No such file or directory); see the plan."
    )


def test_a_full_disk_is_tried_again(write_plan, monkeypatch):
    """The test covers files that the farm itself writes; verbs report a full disk with their exit status."""
    plan = write_plan()

    def raise_disk_full(*_: object) -> None:
        raise OSError(28, "No space left on device", "somewhere")

    monkeypatch.setattr("farm.run._prepare_folder", raise_disk_full)
    outcome = run_task(plan.farm, make_tasks(plan), "elbow/influences")
    assert (outcome.state, outcome.sentence) == (AGAIN, "'somewhere': No space left on device.")
