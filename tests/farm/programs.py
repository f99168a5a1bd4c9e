# SPDX-License-Identifier: GPL-3.0-or-later
"""Programs that the tests of the workflow start: a program that runs verbs and counts them, and a small cluster."""

import os
import subprocess
import sys
import uuid
from pathlib import Path

PYTHON = Path(__file__).resolve().parents[2] / ".venv/bin/python"


def run_verb(calls: str, status_file: str, verb: str, *arguments: str) -> int:
    """Run a verb, and append it to a file, with a note if it trains a model that exists; return its exit status.

    If `status_file` exists, remove it and return the exit status that it contains.
    """
    note = " again" if verb == "train" and os.path.exists(arguments[1]) else ""
    with open(calls, "a") as file:
        file.write(f"{verb}{note} {arguments[0]}\n")
    if os.path.exists(status_file):
        status = int(Path(status_file).read_text())
        os.unlink(status_file)
        return status
    # This process becomes the verb, so that the verb is the process that a step starts.
    os.execv(PYTHON, [str(PYTHON), "-P", "-m", "fdda_addon", verb, *arguments])


def submit(folder: str, script: str) -> None:
    """Start a job script as a cluster does, in the background, and print its number."""
    job = Path(folder, uuid.uuid4().hex)
    process = subprocess.Popen(
        [sys.executable, __file__, "run_job", str(job), script],
        **dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL),
        start_new_session=True,
    )
    job.write_text(str(process.pid))
    print(job)


def run_job(job: str, script: str) -> None:
    status = subprocess.run(["sh", script], check=False).returncode
    Path(f"{job}.status").write_text("failed" if status else "success")


def print_status(job: str) -> None:
    """Print the state of a job. A killed job has failed, although what it started may still run."""
    is_running = Path("/proc", Path(job).read_text()).exists()
    status = Path(f"{job}.status")
    print(status.read_text() if status.exists() else "running" if is_running else "failed")


if __name__ == "__main__":
    programs = {"run_verb": run_verb, "submit": submit, "run_job": run_job, "status": print_status}
    sys.exit(programs[sys.argv[1]](*sys.argv[2:]))
