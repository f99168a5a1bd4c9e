# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs the zip of `make package` into a Blender with a window, and runs stories in it.

Blender uses a temporary folder for its preferences and extensions. The trainer runs in the Python of the environment
variable FDDA_TRAINER_PYTHON, or else in the Python that runs this script. FOLDER gets screenshots of all steps.
Exit status: 0 all steps succeeded; 1 a step failed; 3 this machine lacks a program, which a message names.
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
INSTALL_MAX_SECONDS, STORY_MAX_SECONDS, TERMINATE_MAX_SECONDS = 60, 1800, 5
MISSING_REQUIREMENT_STATUS = 3
MAX_BLANK_IMAGE_VALUES = 32
STORIES = ("path", "choices", "work", "shot", "session")
"""Names of the stories, in order. Each runs in a new Blender, and most use the files of the story `path`."""
LONG_STORIES = ("manual",)
"""Stories that run only by name, because they take minutes."""


def missing_requirement(blender: str) -> str:
    """Return a message about a program that this machine lacks; empty if it has all."""
    if shutil.which(blender) is None:
        return f"there is no Blender '{blender}'; name one that has a window with BLENDER=/path/to/blender"
    if not os.environ.get("DISPLAY") and shutil.which("xvfb-run") is None:
        return "there is no display, and no xvfb-run that makes one; install the package xvfb"
    for tool, package in (("xdotool", "xdotool"), ("import", "imagemagick")):
        if shutil.which(tool) is None:
            return f"there is no '{tool}' to press buttons and take pictures with; install the package {package}"
    return ""


def package_for(blender: str) -> Path:
    """Return the zip for the Python version of a Blender; Linux distributions build Blender with Python 3.14."""
    script = "import sys; print('Python {}.{}'.format(*sys.version_info))"
    command = [blender, "--background", "--factory-startup", "--python-expr", script]
    output = subprocess.run(command, capture_output=True, text=True, check=False, timeout=INSTALL_MAX_SECONDS).stdout
    system_package = PACKAGE.with_name(f"{PACKAGE.stem}-python3.14.zip")
    return system_package if "Python 3.14" in output.splitlines() else PACKAGE


def command_on_display(command: list[str]) -> list[str]:
    """Return a command that runs on the current display, or on a virtual one if there is none."""
    if os.environ.get("DISPLAY"):
        return command
    return ["xvfb-run", "-a", "-s", f"-screen 0 {WIDTH}x{HEIGHT}x24 +extension GLX", *command]


def end_process_group(process: subprocess.Popen) -> None:
    """End a process and its child processes."""
    for signal_number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, signal_number)
            process.wait(TERMINATE_MAX_SECONDS)
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue


def run_command(command: list[str], environment: dict[str, str], seconds: float, output: Path) -> int | None:
    """Run a command, and end its child processes with it; return its exit status, None after the time limit."""
    with output.open("wb") as file:
        process = subprocess.Popen(
            command, cwd=ROOT, env=environment, start_new_session=True, stdout=file, stderr=subprocess.STDOUT
        )
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None
        finally:
            end_process_group(process)


def is_one_color(picture: Path) -> bool:
    """Return whether a PNG file has a single color, as a screen on which nothing was drawn."""
    data, offset, compressed = picture.read_bytes(), 8, b""
    while offset < len(data):
        length, chunk_type = struct.unpack(">I4s", data[offset : offset + 8])
        if chunk_type == b"IDAT":
            compressed += data[offset + 8 : offset + 8 + length]
        offset += 12 + length
    # PNG stores differences between neighboring pixels, which have few values in an image of one color.
    return len(set(zlib.decompress(compressed))) < MAX_BLANK_IMAGE_VALUES


def install_and_run_stories(folder: Path, blender: str, stories: Sequence[str]) -> str:
    """Install the extension and run stories; return a message about the first problem, empty if all succeed."""
    user = folder / "user"
    environment = {"FDDA_TRAINER_PYTHON": sys.executable, **os.environ, "BLENDER_USER_RESOURCES": str(user)}
    package = package_for(blender)
    install = [blender, "--command", "extension", "install-file", "-r", "user_default", "-e", str(package)]
    status = run_command(install, environment, INSTALL_MAX_SECONDS, folder / "install.txt")
    if status != 0:
        return f"Blender did not install {package.name} ({describe_status(status)})"
    return next(filter(None, (run_story(folder, name, blender, environment) for name in stories)), "")


def run_story(folder: Path, name: str, blender: str, environment: dict[str, str]) -> str:
    """Run one story; return a message about its problem, empty if it succeeds."""
    window_options = ["--window-geometry", "0", "0", str(WIDTH), str(HEIGHT), "--no-window-focus"]
    script_options = ["--python", str(Path(__file__).with_name("drive.py")), "--", str(folder), name]
    output_path = folder / f"{name}.txt"
    (folder / "steps.json").unlink(missing_ok=True)
    command = command_on_display([blender, *window_options, *script_options])
    status = run_command(command, environment, STORY_MAX_SECONDS, output_path)
    steps_path = folder / "steps.json"
    finished_steps = json.loads(steps_path.read_text(encoding="utf-8")) if steps_path.is_file() else []
    if status != 0:
        return (
            f"after {len(finished_steps)} steps Blender ended ({describe_status(status)}); see failed.png and "
            f"{output_path.name} in {folder}"
        )
    # An exception while a panel is drawn does not end Blender; the rest of the panel stays empty.
    if b"Traceback" in output_path.read_bytes():
        return f"a Python exception was printed; see {output_path}"
    if not finished_steps or len(finished_steps) != finished_steps[-1]["of"]:
        return f"Blender ended after {len(finished_steps)} steps, before the last"
    print(f"{name}: {len(finished_steps)} steps succeeded", flush=True)
    for picture in {folder / step["picture"] for step in finished_steps} | set(folder.glob("*.png")):
        if not picture.is_file() or is_one_color(picture):
            return f"the screenshot {picture} is missing or blank"
    return ""


def describe_status(status: int | None) -> str:
    return "it took too long" if status is None else f"status {status}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder for screenshots; files of an earlier run in it are deleted")
    parser.add_argument("blender", nargs="?", default="blender", help="command that starts Blender")
    story_help = "run only these stories; most need the files of the story 'path' in FOLDER"
    parser.add_argument("--story", nargs="+", choices=(*STORIES, *LONG_STORIES), help=story_help)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # Exit by an exception, so that child processes are ended.
    folder = options.folder.resolve()
    if requirement := missing_requirement(options.blender):
        print(f"The window is not tested: {requirement}.", file=sys.stderr)
        return MISSING_REQUIREMENT_STATUS
    if not PACKAGE.is_file():
        print(f"There is no {PACKAGE}; build it with 'make package'.", file=sys.stderr)
        return 1
    stories = options.story or STORIES
    if STORIES[0] in stories:
        shutil.rmtree(folder, ignore_errors=True)
    for subfolder in ("work", "user"):
        (folder / subfolder).mkdir(parents=True, exist_ok=True)
    problem = install_and_run_stories(folder, options.blender, stories)
    if problem:
        print(f"The test of the window failed: {problem}.", file=sys.stderr)
        return 1
    shutil.rmtree(folder / "user")
    print(f"All steps succeeded: {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
