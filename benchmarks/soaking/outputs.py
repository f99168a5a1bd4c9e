# SPDX-License-Identifier: GPL-3.0-or-later
"""Outputs at odd places: what is read, what is open, what Windows or Blender would take for another file."""

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

from .cases import ShortfallError, attempt, is_sentence, say

KINDS = ("long", "device", "input", "open")
DEVICES = ("con", "NUL", "aux.json", "com1.blend", "lpt9 .x", "ends.", "blank ", "a:b", "what?")
PLACE = "odd outputs"
HOLDER = "import sys, time; file = open(sys.argv[1], 'rb'); print('open', flush=True); time.sleep(float(sys.argv[2]))"
ENDS = (0, 1, 75)


def run(folder: Path, seed: int, first: int, end: int) -> None:
    """Let verbs write to odd places."""
    for number in range(first, end):
        random, kind = np.random.default_rng((seed, number)), KINDS[number % len(KINDS)]
        action = {"long": _long, "device": _device, "input": _input, "open": _open}[kind]
        say(attempt("odd outputs", f"output {seed}/{number} ({kind})", lambda a=action, r=random: a(folder, r)))


def _long(folder: Path, random: np.random.Generator) -> None:
    with _place(folder) as place:
        out = place
        for _ in range(random.integers(1, 7)):
            out = out / ("d" * int(random.integers(20, 200)))
        # Some systems make no folder of such a path.
        with contextlib.suppress(OSError):
            out.mkdir(parents=True)
        _write(folder, random, out / "out")


def _device(folder: Path, random: np.random.Generator) -> None:
    with _place(folder) as place:
        status = _write(folder, random, place / str(random.choice(DEVICES)))
        if sys.platform == "win32" and status != 1:
            raise ShortfallError("it wrote to a device")


def _input(folder: Path, random: np.random.Generator) -> None:
    with _place(folder) as place:
        copies = {name: shutil.copy(folder / name, place / name) for name in ("elbow.blend", "elbow.onnx")}
        before = {path: Path(path).read_bytes() for path in copies.values()}
        name = str(random.choice(list(copies)))
        out = place / (name.swapcase() if random.integers(2) else name)
        is_one = out.exists()
        ended, _ = _run("bind", copies["elbow.blend"], copies["elbow.onnx"], out)
        if is_one and ended != 1:
            raise ShortfallError(f"exit status {ended} where the output is an input")
        if any(Path(path).read_bytes() != data for path, data in before.items()):
            raise ShortfallError("an input was changed")


def _open(folder: Path, random: np.random.Generator) -> None:
    with _place(folder) as place:
        out = place / "out"
        _write(folder, random, out)
        seconds = str(round(float(random.uniform(0.2, 3)), 2))
        holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(out), seconds], stdout=subprocess.PIPE)
        try:
            holder.stdout.readline()
            if _write(folder, random, out) != 0:
                raise ShortfallError(f"it was not waited for what was open for {seconds} s")
        finally:
            holder.kill()
            holder.communicate()


def _write(folder: Path, random: np.random.Generator, out: Path) -> int:
    """Let a verb write; gives its exit status, once what it left is what that says."""
    verbs: dict[str, tuple[tuple, FileKind]] = {
        "check-recording": (("check-recording", folder / "short recording", "--json", out, "--overwrite"), WARNINGS),
        "bind": (("bind", folder / "elbow.blend", folder / "elbow.onnx", out, "--overwrite"), BLEND),
    }
    arguments, kind = verbs[str(random.choice(list(verbs)))]
    files = _files(folder / PLACE)
    ended, said = _run(*arguments)
    if ended == 0:
        if not kind.matches(out):
            raise ShortfallError(f"it is done, and '{out}' is not {kind.name}")
    elif _files(folder / PLACE) != files:
        raise ShortfallError(f"it is refused ({said[:300]}) and leaves something")
    return ended


def _run(*arguments: object) -> tuple[int, str]:
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        ended = main(list(map(str, arguments)), "fdda")
    said = errors.getvalue().strip()
    if ended not in ENDS or (ended and not is_sentence(said.splitlines()[-1])):
        raise ShortfallError(f"exit status {ended}: {said[-300:]}")
    return ended, said


def _files(place: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in place.rglob("*") if path.is_file()}


@contextmanager
def _place(folder: Path) -> Iterator[Path]:
    place = folder / PLACE
    place.mkdir(exist_ok=True)
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=os.name == "nt")
