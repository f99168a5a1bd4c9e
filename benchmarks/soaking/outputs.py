# SPDX-License-Identifier: GPL-3.0-or-later
"""Soak test of output paths that are long, are device names, are inputs, or are open in another process."""

import contextlib
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fdda_addon.cli.main import main
from fdda_addon.core.file_kind import BLEND, WARNINGS, FileKind

from .cases import CaseFailedError, is_sentence, print_case, run_case

PATH_KINDS = ("long", "device", "input", "open")
DEVICE_NAMES = ("con", "NUL", "aux.json", "com1.blend", "lpt9 .x", "ends.", "blank ", "a:b", "what?")
OUTPUT_FOLDER = "odd outputs"
OPEN_FILE_SCRIPT = (
    "import sys, time; file = open(sys.argv[1], 'rb'); print('open', flush=True); time.sleep(float(sys.argv[2]))"
)
EXIT_STATUSES = (0, 1, 75)


def run(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Let verbs write to unusual output paths."""
    actions = {"long": _write_long_path, "device": _write_device_name, "input": _write_input, "open": _write_open_file}
    for case_index in range(first_case, end_case):
        random, kind = np.random.default_rng((seed, case_index)), PATH_KINDS[case_index % len(PATH_KINDS)]
        action = actions[kind]
        print_case(
            run_case("odd outputs", f"output {seed}/{case_index} ({kind})", lambda a=action, r=random: a(folder, r))
        )


def _write_long_path(folder: Path, random: np.random.Generator) -> None:
    with _output_folder(folder) as output:
        out = output
        for _ in range(random.integers(1, 7)):
            out = out / ("d" * int(random.integers(20, 200)))
        # Some systems refuse folders with such long paths.
        with contextlib.suppress(OSError):
            out.mkdir(parents=True)
        _write(folder, random, out / "out")


def _write_device_name(folder: Path, random: np.random.Generator) -> None:
    with _output_folder(folder) as output:
        status = _write(folder, random, output / str(random.choice(DEVICE_NAMES)))
        if sys.platform == "win32" and status != 1:
            raise CaseFailedError("the verb wrote to a device")


def _write_input(folder: Path, random: np.random.Generator) -> None:
    with _output_folder(folder) as output:
        copies = {name: shutil.copy(folder / name, output / name) for name in ("elbow.blend", "elbow.onnx")}
        before = {path: Path(path).read_bytes() for path in copies.values()}
        name = str(random.choice(list(copies)))
        out = output / (name.swapcase() if random.integers(2) else name)
        is_input = out.exists()
        status, _ = _run_verb("bind", copies["elbow.blend"], copies["elbow.onnx"], out)
        if is_input and status != 1:
            raise CaseFailedError(f"exit status {status} where the output is an input")
        if any(Path(path).read_bytes() != data for path, data in before.items()):
            raise CaseFailedError("an input was changed")


def _write_open_file(folder: Path, random: np.random.Generator) -> None:
    with _output_folder(folder) as output:
        out = output / "out"
        _write(folder, random, out)
        seconds = str(round(float(random.uniform(0.2, 3)), 2))
        holder = subprocess.Popen([sys.executable, "-c", OPEN_FILE_SCRIPT, str(out), seconds], stdout=subprocess.PIPE)
        try:
            holder.stdout.readline()
            if _write(folder, random, out) != 0:
                raise CaseFailedError(f"the verb did not wait for a file that was open for {seconds} s")
        finally:
            holder.kill()
            holder.communicate()


def _write(folder: Path, random: np.random.Generator, out: Path) -> int:
    """Let a random verb write to a path; check that the files match its exit status, and return the status."""
    verbs: dict[str, tuple[tuple, FileKind]] = {
        "check-recording": (("check-recording", folder / "short recording", "--json", out, "--overwrite"), WARNINGS),
        "bind": (("bind", folder / "elbow.blend", folder / "elbow.onnx", out, "--overwrite"), BLEND),
    }
    arguments, kind = verbs[str(random.choice(list(verbs)))]
    old_files = _read_files(folder / OUTPUT_FOLDER)
    status, message = _run_verb(*arguments)
    if status == 0:
        if not kind.matches(out):
            raise CaseFailedError(f"the verb succeeded, but '{out}' is not {kind.name}")
    elif _read_files(folder / OUTPUT_FOLDER) != old_files:
        raise CaseFailedError(f"the verb was refused ({message[:300]}) but changed files")
    return status


def _run_verb(*arguments: object) -> tuple[int, str]:
    """Run a verb; return its exit status and its error message."""
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        status = main(list(map(str, arguments)), "fdda")
    message = errors.getvalue().strip()
    if status not in EXIT_STATUSES or (status and not is_sentence(message.splitlines()[-1])):
        raise CaseFailedError(f"exit status {status}: {message[-300:]}")
    return status, message


def _read_files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@contextmanager
def _output_folder(folder: Path) -> Iterator[Path]:
    """Make the folder of the outputs, and remove it afterwards."""
    output = folder / OUTPUT_FOLDER
    output.mkdir(exist_ok=True)
    try:
        yield output
    finally:
        shutil.rmtree(output, ignore_errors=os.name == "nt")
