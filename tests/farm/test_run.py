# SPDX-License-Identifier: GPL-3.0-or-later
"""Tasks: done once, gone on with after a kill, made again when what they depend on changes; real verbs in processes."""

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

from .conftest import ELBOW, ONE, ROOT, SMALL, contents, do_all, states

ROUNDS = ONE + "goal_mm = 0.001\nrounds = 1\n"


@pytest.fixture(scope="module")
def elbow_farm(tmp_path_factory):
    """The elbow's farm, done once: its folder, to be copied, and what became of the tasks."""
    folder = tmp_path_factory.mktemp("farm")
    (folder / "elbow.blend").write_bytes(ELBOW.read_bytes())

    (folder / "characters.toml").write_text(SMALL + ROUNDS)
    plan = read_plan(folder / "characters.toml")
    return plan, do_all(plan)


def test_all_tasks_of_a_character(elbow_farm):
    plan, outcomes = elbow_farm
    assert set(states(outcomes).values()) == {DONE}, outcomes
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


def test_nothing_is_done_twice(elbow_farm):
    plan, _ = elbow_farm
    before = contents(plan.farm.work)
    tasks = make_tasks(plan)
    assert outdated_tasks(tasks, InputFingerprints(plan.farm, tasks)) == ([], {})
    assert set(states(do_all(plan)).values()) == {UP_TO_DATE}
    assert contents(plan.farm.work) == before


def test_a_lost_file_is_made_again_with_what_it_needs_alone(elbow_farm):
    plan, _ = elbow_farm
    tasks = make_tasks(plan)
    fingerprints = InputFingerprints(plan.farm, tasks)
    lost = plan.farm.work / "elbow/evaluate-1/evaluation.json"
    kept = lost.read_bytes()
    lost.unlink()
    # What is done needs nothing before it: bind is.
    assert outdated_tasks(tasks, fingerprints) == ([], {})
    (plan.characters[0].output / "elbow.blend").unlink()
    assert outdated_tasks(tasks, fingerprints)[0] == ["elbow/evaluate-1", "elbow/bind"]
    assert run_task(plan.farm, tasks, "elbow/evaluate-1").state == DONE
    assert json.loads(lost.read_bytes())["fdda"] == json.loads(kept)["fdda"]
    assert run_task(plan.farm, tasks, "elbow/bind").state == DONE


def test_what_was_changed_is_not_used(elbow_farm):
    plan, _ = elbow_farm
    tasks = make_tasks(plan)
    model = plan.farm.work / "elbow/train-1/elbow.onnx"
    kept = model.read_bytes()
    model.write_bytes(kept[:-1] + b"x")
    tasks["elbow/evaluate-1"].manifest.unlink()
    outcome = run_task(plan.farm, tasks, "elbow/evaluate-1")
    assert outcome.state == FAILED
    assert f"'{model}' is not what 'elbow/train-1' left" in outcome.sentence and "it is made again" in outcome.sentence
    tasks["elbow/bind"].manifest.unlink()
    assert outdated_tasks(tasks, InputFingerprints(plan.farm, tasks))[0] == [
        f"elbow/{name}" for name in ("train-1", "evaluate-1", "bind")
    ]
    made = [run_task(plan.farm, tasks, f"elbow/{name}").state for name in ("train-1", "evaluate-1", "bind")]
    assert made == [DONE] * 3
    assert model.read_bytes() == kept, "the same recording and settings give the same bytes"


def test_a_goal_that_is_met_ends_the_rounds(elbow_farm):
    plan, _ = elbow_farm
    plan.path.write_text(plan.path.read_text().replace("goal_mm = 0.001", "goal_mm = 1000.0"))

    found = states(do_all(read_plan(plan.path)))
    assert {name: state for name, state in found.items() if "-1" in name and "record" not in name} == {
        f"elbow/{name}-1": NOT_NEEDED for name in ("refine", "train", "evaluate")
    }
    assert found["elbow/record-1"] == found["elbow/merge"] == UP_TO_DATE
    assert found["elbow/train-0"] == found["elbow/bind"] == DONE


def test_keys_follow_what_a_task_depends_on(written, tmp_path):
    def keys(text: str, head: str = "") -> dict[str, str]:
        plan = written(text, head)
        tasks = make_tasks(plan)
        return {name: InputFingerprints(plan.farm, tasks).of_task(name) for name in tasks}

    first = keys(ONE)

    def changed(text: str, head: str = "") -> set[str]:
        return {name for name, key in keys(text, head).items() if first.get(name) != key}

    everything, recorded = set(first), {name for name in first if "record" in name or "influences" in name}
    assert changed(ONE) == changed(ONE + 'shards = 4\n[characters.other]\nrig = "elbow.blend"\noutput = "o"') - {
        name for name in keys(ONE + '[characters.other]\nrig = "elbow.blend"\noutput = "o"') if "other" in name
    }
    assert changed(ONE + "seed = 3") == everything
    assert changed(ONE + "train = { epochs = 5 }") == {"elbow/train-0", "elbow/evaluate-0", "elbow/bind"}
    assert changed(ONE, "[farm]\nthreads = 2") == {"elbow/train-0", "elbow/evaluate-0", "elbow/bind"}
    assert changed(ONE + "use_in_render = true") == {"elbow/bind"}
    assert changed(ONE, '[farm]\nwork = "elsewhere"') == set(), "what was done may be moved"
    with open(tmp_path / "elbow.blend", "ab") as file:
        file.write(b"x")
    assert changed(ONE) == everything >= recorded


KILLED = """
import sys
from pathlib import Path
from farm.characters import read_plan
from farm.run import run_task
from farm.tasks import make_tasks
plan = read_plan(Path(sys.argv[1]))
print(run_task(plan.farm, make_tasks(plan), sys.argv[2]).state)
"""


def started(plan, name: str) -> subprocess.Popen:
    """A worker that does one task."""
    return subprocess.Popen(
        [sys.executable, "-c", KILLED, plan.path, name], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )


def wait_for(what, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def complete(path: Path) -> int:
    try:
        return json.loads((path / "recording.json").read_text())["complete"]
    except FileNotFoundError:
        return 0


@pytest.mark.parametrize("with_verb", [False, True])
def test_a_worker_that_is_killed_loses_nothing(written, with_verb):
    """Its verb goes on, and whoever is next waits for it; or it is killed too, and its poses are gone on with."""
    plan = written(ONE + "poses = 4000\nshards = 1")
    tasks = make_tasks(plan)
    assert run_task(plan.farm, tasks, "elbow/influences").state == DONE
    task = tasks["elbow/record-1"]
    worker = started(plan, task.name)
    recording = task.folder / "recording"
    wait_for(lambda: complete(recording))
    if with_verb:
        children = Path(f"/proc/{worker.pid}/task/{worker.pid}/children").read_text().split()
    worker.kill()
    worker.wait()
    if with_verb:
        for child in children:
            os.kill(int(child), signal.SIGKILL)
    before = complete(recording)
    assert 0 < before < 4000 and read_manifest(task) is None
    assert run_task(plan.farm, tasks, task.name).state == DONE
    last = task.log.read_text().rpartition("$ record")[2]
    first = next(int(line.split()[1]) for line in last.splitlines() if line.startswith("poses: "))
    assert first >= before and complete(recording) == 4000, "no pose is recorded twice"


def test_two_workers_take_turns(written):
    plan = written()
    workers = [started(plan, "elbow/influences") for _ in range(2)]
    assert sorted(worker.communicate()[0].strip() for worker in workers) == ["done", "up to date"]


def test_a_lock_is_free_when_its_last_process_is_gone(tmp_path):
    done = []
    with hold_lock(tmp_path / "lock") as lock:
        sleeper = subprocess.Popen(["sleep", "0.5"], pass_fds=(lock,))
    waiting = threading.Thread(target=lambda: done.append(hold_lock(tmp_path / "lock").__enter__()))
    waiting.start()
    time.sleep(0.1)
    assert not done and sleeper.poll() is None
    waiting.join(20)
    assert done and sleeper.wait() == 0


def ended(tmp_path: Path, monkeypatch, code: str) -> None:
    monkeypatch.setattr(process, "verb_command", lambda farm, verb: [sys.executable, "-c", code])
    with hold_lock(tmp_path / "lock") as lock:
        run_verb(None, ("record",), tmp_path, tmp_path / "log", lock)


@pytest.mark.parametrize(
    ("code", "error", "words"),
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
def test_how_a_verb_ended(tmp_path, monkeypatch, code, error, words):
    monkeypatch.setattr(process, "verb_environment", lambda farm, verb: dict(os.environ))
    with pytest.raises(error) as raised:
        ended(tmp_path, monkeypatch, code)
    assert str(raised.value).startswith(words) and type(raised.value) is error


def test_what_a_verb_inherits(tmp_path, monkeypatch):
    monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", "65536")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("OF_THE_USER", "yes")
    farm = Farm(tmp_path, threads=3)
    training, recording = (verb_environment(farm, (verb,)) for verb in ("train", "record"))
    assert (training["OMP_NUM_THREADS"], recording["OMP_NUM_THREADS"]) == ("3", "1")
    assert training["CUDA_VISIBLE_DEVICES"] == "" and training["OF_THE_USER"] == recording["OF_THE_USER"] == "yes"
    assert "MALLOC_TRIM_THRESHOLD_" not in {*training, *recording}, "it slows verbs down by a third"


def test_a_rig_that_is_broken_fails_with_its_sentence(written, tmp_path):
    plan = written(
        '[characters.bad]\nrig = "bad.blend"\noutput = "out"\n[characters.gone]\nrig = "gone.blend"\noutput = "o"'
    )
    (tmp_path / "bad.blend").write_text("no blend file")
    tasks = make_tasks(plan)
    outcome = run_task(plan.farm, tasks, "bad/influences")
    assert outcome.state == FAILED and "Blender cannot open" in outcome.sentence
    names, unreadable = outdated_tasks(tasks, InputFingerprints(plan.farm, tasks))
    assert "bad/influences" in names and list(unreadable) == ["gone/bind"]
    assert (
        unreadable["gone/bind"]
        == f"There is no file '{tmp_path / 'gone.blend'}' (No such file or directory); see the plan."
    )


def test_a_disk_that_is_full_is_tried_again(written, monkeypatch):
    """Where the farm itself writes: what verbs say is in their exit status."""
    plan = written()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device", "somewhere")

    monkeypatch.setattr("farm.run._prepare", full)
    outcome = run_task(plan.farm, make_tasks(plan), "elbow/influences")
    assert (outcome.state, outcome.sentence) == (AGAIN, "'somewhere': No space left on device.")
