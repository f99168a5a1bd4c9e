# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a verb as a step of the workflow, unless the verb has finished.

A step may be killed at any moment, and started again on any machine while its verb still runs. It then waits for that
verb, and continues what it left. The folder of DONE has the state of the step:

- `done`: the key. It is the output of the Snakemake rule, so Snakemake deletes it before it starts the step.
- `key`: a digest of the verb, its options and the contents of all inputs.
- `finished`: exists if the verb has finished for the key.
- `failed`: the log of a verb that would fail again.
- `lock`: locked while the verb runs.
"""

import argparse
import hashlib
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(PROJECT))

from fdda_addon.core.errors import TRY_AGAIN  # noqa: E402
from fdda_addon.core.files.child_process import child_options  # noqa: E402
from fdda_addon.core.files.file_lock import try_lock  # noqa: E402
from fdda_addon.core.files.output import write_text  # noqa: E402

PAUSE_SECONDS = 10
"""Time before a verb is tried again that failed because of its machine."""


def main() -> int:
    """Run the step; return the exit status of its verb."""
    parser = argparse.ArgumentParser(description="Run a verb as a step of the workflow, unless the verb has finished.")
    parser.add_argument("done", type=Path, help="file to write when the verb has finished")
    parser.add_argument("--attempt", type=int, required=True, help="number of the attempt, from 1")
    parser.add_argument("--program", required=True, help="command line of the program that runs the verbs")
    parser.add_argument("--inputs", nargs="+", type=Path, required=True, help="files that the verb reads")
    parser.add_argument("--result", type=Path, required=True, help="file or folder that the verb writes")
    parser.add_argument("verb", nargs="+", help="the verb and its options")
    step = parser.parse_args()
    step.done.parent.mkdir(parents=True, exist_ok=True)
    step.result.parent.mkdir(parents=True, exist_ok=True)
    with open(step.done.with_name("lock"), "w") as lock:
        while not try_lock(lock.fileno()):
            time.sleep(0.05)
        status = run(step, lock.fileno())
    if status == TRY_AGAIN:
        time.sleep(PAUSE_SECONDS)
    return status


def run(step: argparse.Namespace, lock: int) -> int:
    """Run the verb, unless it has finished; return its exit status. The verb inherits the lock."""
    result = step.result
    log, key_file, finished, failed = (step.done.with_name(name) for name in ("log", "key", "finished", "failed"))
    if step.attempt > 1 and failed.exists():
        shutil.copyfile(failed, log)
        return 1
    failed.unlink(missing_ok=True)
    digest = hashlib.sha256(repr(step.verb).encode())
    for path in step.inputs:
        with open(path, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    key = digest.hexdigest()
    is_continued = key_file.exists() and key_file.read_text() == key
    if not is_continued:
        if finished.exists() and result.is_file() and is_newer(result, finished):
            log.write_text(f"'{result}' has changed since the workflow wrote it; move it, or remove '{finished}'.\n")
            return 1
        finished.unlink(missing_ok=True)
        if result.is_dir():
            shutil.rmtree(result)
        write_text(key_file, key)
    # A file is written at the end of a verb, or of a round of a training that adds poses until its goal is met.
    has_result = is_continued and result.is_file() and is_newer(result, key_file)
    is_refined = "--refine" in step.verb
    if not (result.exists() and is_continued and (finished.exists() or (has_result and not is_refined))):
        status = run_verb(step, ["--warm-start"] if has_result and is_refined else [], log, lock)
        if status in (1, 2):
            shutil.copyfile(log, failed)
        if status:
            return status
    finished.touch()
    write_text(step.done, key)
    return 0


def is_newer(path: Path, other: Path) -> bool:
    return path.stat().st_mtime_ns > other.stat().st_mtime_ns


def run_verb(step: argparse.Namespace, options: list[str], log: Path, lock: int) -> int:
    """Run the verb; return its exit status, or 128 and the number of the signal that ended it."""
    with open(log, "wb") as output:
        process = subprocess.Popen(
            [*shlex.split(step.program), *step.verb, *options],
            stdout=output,
            stderr=output,
            pass_fds=(lock,),
            **child_options(PROJECT),
        )
        signal.signal(signal.SIGTERM, lambda *_: process.terminate())
        status = process.wait()
    return status if status >= 0 else 128 - status


if __name__ == "__main__":
    sys.exit(main())
