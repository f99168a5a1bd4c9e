# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs the zip that `make package` built into a Blender with a window, and drives it.

Blender gets a scratch folder for its preferences and extensions, and the trainer the Python that FDDA_TRAINER_PYTHON
names, else the one that runs this. The pictures of all steps are in FOLDER afterwards.
Exit status: 0 all steps went well, 1 one did not, 3 this machine lacks what it takes; one sentence says which.
"""

import argparse
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import tomllib
import zlib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VERSION = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
PACKAGE = ROOT / "dist" / f"fdda_addon-{VERSION}.zip"
WIDTH, HEIGHT = 1600, 1200
INSTALL_SECONDS, SECONDS, END_SECONDS = 60, 600, 5
LACKING = 3
FEW_VALUES = 32
STORIES = ("path", "work", "shot", "cast", "ranges", "flesh", "session", "leave", "back")
"""Each in a Blender of its own, with the files of those before: the path of a first model, the work with it, what a
shot takes, several characters, ranges of motion, a simulation that is learned, what a long session must not spoil, a
Blender that is closed while it trains, and the next one."""
LONG = ("endure",)
"""Run by name alone: five minutes of work with one character."""


def lacking(blender: str) -> str:
    """What is not there, a sentence; empty when nothing is."""
    if shutil.which(blender) is None:
        return f"there is no Blender '{blender}'; name one that has a window with BLENDER=/path/to/blender"
    if not os.environ.get("DISPLAY") and shutil.which("xvfb-run") is None:
        return "there is no display, and no xvfb-run that makes one; install the package xvfb"
    for tool, package in (("xdotool", "xdotool"), ("import", "imagemagick")):
        if shutil.which(tool) is None:
            return f"there is no '{tool}' to press buttons and take pictures with; install the package {package}"
    return ""


def package_for(blender: str) -> Path:
    """The zip for the Python of a Blender: that of distributions where it runs on the system's."""
    question = "import sys; print('Python {}.{}'.format(*sys.version_info))"
    command = [blender, "--background", "--factory-startup", "--python-expr", question]
    said = subprocess.run(command, capture_output=True, text=True, check=False, timeout=INSTALL_SECONDS).stdout
    own = PACKAGE.with_name(f"{PACKAGE.stem}-python3.14.zip")
    return own if "Python 3.14" in said.splitlines() else PACKAGE


def on_display(command: list[str]) -> list[str]:
    """The command on the display that there is, else on a virtual one."""
    if os.environ.get("DISPLAY"):
        return command
    return ["xvfb-run", "-a", "-s", f"-screen 0 {WIDTH}x{HEIGHT}x24 +extension GLX", *command]


def end(process: subprocess.Popen) -> None:
    """End a process and all that it has started."""
    for how in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, how)
            process.wait(END_SECONDS)
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue


def run(command: list[str], environment: dict[str, str], seconds: float, output: Path) -> int | None:
    """Exit status of a command, None when it took longer; nothing that it started is left. What it says is kept."""
    with output.open("wb") as file:
        process = subprocess.Popen(
            command, cwd=ROOT, env=environment, start_new_session=True, stdout=file, stderr=subprocess.STDOUT
        )
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        finally:
            end(process)


def is_one_color(picture: Path) -> bool:
    """Whether a PNG file is a single color, as of a screen on which nothing was drawn."""
    data, place, packed = picture.read_bytes(), 8, b""
    while place < len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        if kind == b"IDAT":
            packed += data[place + 8 : place + 8 + length]
        place += 12 + length
    # Stored are differences of neighbors: of a single color there are but a few.
    return len(set(zlib.decompress(packed))) < FEW_VALUES


def drive(folder: Path, blender: str, stories: Sequence[str]) -> str:
    """Install and go through stories; returns what is wrong with the outcome, empty when all is well."""
    user = folder / "user"
    environment = {"FDDA_TRAINER_PYTHON": sys.executable, **os.environ, "BLENDER_USER_RESOURCES": str(user)}
    package = package_for(blender)
    install = [blender, "--command", "extension", "install-file", "-r", "user_default", "-e", str(package)]
    status = run(install, environment, INSTALL_SECONDS, folder / "install.txt")
    if status != 0:
        return f"Blender did not install {package.name} ({status_name(status)})"
    return next(filter(None, (_tell(folder, name, blender, environment) for name in stories)), "")


def _tell(folder: Path, name: str, blender: str, environment: dict[str, str]) -> str:
    """Go through one story; returns as `drive`."""
    window = ["--window-geometry", "0", "0", str(WIDTH), str(HEIGHT), "--no-window-focus"]
    script = ["--python", str(Path(__file__).with_name("drive.py")), "--", str(folder), name]
    said = folder / f"{name}.txt"
    (folder / "steps.json").unlink(missing_ok=True)
    status = run(on_display([blender, *window, *script]), environment, SECONDS, said)
    steps = folder / "steps.json"
    done = json.loads(steps.read_text(encoding="utf-8")) if steps.is_file() else []
    if status != 0:
        return (
            f"after {len(done)} steps Blender ended ({status_name(status)}); see failed.png and {said.name} in {folder}"
        )
    # An error while a panel is drawn ends nothing: the panel is empty from there on.
    if b"Traceback" in said.read_bytes():
        return f"Python failed meanwhile; see {said}"
    if not done or len(done) != done[-1]["of"]:
        return f"Blender ended after {len(done)} steps, before the last"
    print(f"{name}: {len(done)} steps went well", flush=True)
    for picture in {folder / step["picture"] for step in done} | set(folder.glob("*.png")):
        if not picture.is_file() or is_one_color(picture):
            return f"there is nothing to see in {picture}"
    return ""


def status_name(status: int | None) -> str:
    return "it took too long" if status is None else f"status {status}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="for pictures; what an earlier run left there is removed")
    parser.add_argument("blender", nargs="?", default="blender", help="command that starts Blender")
    help_of_story = "these alone; all need what 'path' has left in FOLDER"
    parser.add_argument("--story", nargs="+", choices=(*STORIES, *LONG), help=help_of_story)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # What was started is ended on the way out.
    folder = options.folder.resolve()
    if lack := lacking(options.blender):
        print(f"The window is not tested: {lack}.", file=sys.stderr)
        return LACKING
    if not PACKAGE.is_file():
        print(f"There is no {PACKAGE}; build it with 'make package'.", file=sys.stderr)
        return 1
    stories = options.story or STORIES
    if STORIES[0] in stories:
        shutil.rmtree(folder, ignore_errors=True)
    for part in ("work", "user"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    wrong = drive(folder, options.blender, stories)
    if wrong:
        print(f"The test of the window failed: {wrong}.", file=sys.stderr)
        return 1
    shutil.rmtree(folder / "user")
    print(f"All steps went well: {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
