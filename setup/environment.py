# SPDX-License-Identifier: GPL-3.0-or-later
"""Create a virtual environment with the pinned requirements, for the running Python.

On Windows, start it with `py -3.13 setup\\environment.py make .venv everything`. On other systems `setup/environment`
finds a Python and starts it.

The last step writes the stamp of the environment, a file with a fingerprint. An environment without a stamp was
interrupted; one with another fingerprint has other requirements or another Python. Both are created again.
"""

import argparse
import ast
import ctypes
import errno
import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parent.parent
STAMP = "fdda-complete"
PYTHON_VERSIONS = ("3.13", "3.11")
SYSTEM_LIBRARIES = ROOT / "setup" / "system-libraries.txt"

# By name of the contents: dependency groups of pyproject.toml to install, and modules whose import checks the result.
CONTENTS = {
    "everything": (("setup", "blender", "trainer", "test", "lint"), ("bpy", "onnxruntime", "torch")),
    "core": (("setup", "core", "test", "lint"), ("numpy", "onnx")),
    "farm": (("setup", "test", "farm"), ("snakemake",)),
    "blender": (("setup", "blender", "test"), ("bpy", "onnxruntime")),
}

# Settings of pip, as `pip config list` names them, and the matching environment variables of uv. A mirror or
# certificate that is configured for pip thus applies to uv.
UV_SETTINGS = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "trusted-host": "UV_INSECURE_HOST",
    "cert": "SSL_CERT_FILE",
    "proxy": "ALL_PROXY",
    "timeout": "UV_HTTP_TIMEOUT",
    "default-timeout": "UV_HTTP_TIMEOUT",
}


class SetupError(Exception):
    """The environment cannot be created; the message says what to do."""


def program_path(folder: Path, name: str) -> Path:
    """Return the path of a program in the virtual environment `folder`."""
    return folder / "Scripts" / f"{name}.exe" if os.name == "nt" else folder / "bin" / name


def pins_path() -> Path:
    """Return the file with pinned versions for the running Python."""
    return ROOT / "requirements" / "python-{}.{}.txt".format(*sys.version_info)


def check_python() -> None:
    """Check that a Blender LTS line uses the version of the running Python.

    Raises:
        SetupError: no Blender LTS line uses this version; the message names the supported versions.
    """
    version = "{}.{}".format(*sys.version_info)
    if version not in PYTHON_VERSIONS:
        raise SetupError(
            f"FDDA needs Python {' or '.join(PYTHON_VERSIONS)} and this is {version}; on Windows "
            f"'py -{PYTHON_VERSIONS[0]}' starts a supported one; on other systems setup/environment finds it."
        )


def fingerprint(contents: str) -> str:
    """Compute the fingerprint of an environment. When it changes, the environment is created again."""
    digest = hashlib.sha256(repr((contents, CONTENTS[contents], sys.version, sys.base_prefix)).encode())
    digest.update(pins_path().read_bytes())
    return digest.hexdigest()


def is_current(folder: Path, contents: str, python: str = "") -> bool:
    """Return whether `folder` is complete and was created by the running Python.

    If `python` is not empty, the path of the running Python must be `python`.
    """
    if not program_path(folder, "python").exists() or (python and os.path.realpath(sys.executable) != python):
        return False
    stamp = folder / STAMP
    return stamp.is_file() and stamp.read_text() == fingerprint(contents)


def check_not_linked(folder: Path) -> None:
    """Check that the folder of an environment is not a link, because `venv --clear` would empty the linked folder.

    Raises:
        SetupError: the folder is a link or a junction, for example in a second working tree that shares an environment.
    """
    try:
        target = os.readlink(folder)
    except OSError:  # not a link
        return
    raise SetupError(
        f"{folder.name} is a link to '{target}' and is not up to date; create the environment again in that folder, or "
        "remove the link to create one here."
    )


def check_system_libraries(libraries_path: Path = SYSTEM_LIBRARIES) -> None:
    """Check before the download that all system libraries can be loaded; wheels for Windows and macOS include them.

    Raises:
        SetupError: some libraries cannot be loaded; the message names their Debian packages.
    """
    if sys.platform != "linux":
        return
    missing_packages = []
    for line in libraries_path.read_text().splitlines():
        if line.startswith("#"):
            continue
        library, package = line.split()
        try:
            ctypes.CDLL(library)
        except OSError:
            missing_packages.append(package)
    if missing_packages:
        packages = " ".join(missing_packages)
        raise SetupError(f"Blender needs system libraries that are missing; as root: apt-get install {packages}")


def uv_environment(python: Path) -> dict[str, str]:
    """Return the environment variables for uv; pip's settings apply unless a variable of uv is set."""
    environment = {"UV_PYTHON_DOWNLOADS": "never"}
    configuration = subprocess.run([python, "-m", "pip", "config", "list"], capture_output=True, text=True, check=False)
    for line in configuration.stdout.splitlines():
        key, _, value = line.partition("=")
        name = UV_SETTINGS.get(key.rpartition(".")[2])
        if name:
            values = str(ast.literal_eval(value)).split()
            environment[name] = ("," if name == "UV_FIND_LINKS" else " ").join(values)
    if "UV_INDEX" in environment:  # pip searches all its indexes, uv by default only the first that has the package
        environment["UV_INDEX_STRATEGY"] = "unsafe-best-match"
    return environment | os.environ


def run_step(*command: str | Path, error_message: str, env: dict[str, str] | None = None) -> None:
    """Run one step with its output on the terminal.

    Raises:
        SetupError: the step failed; the message is `error_message`.
    """
    if subprocess.run(command, cwd=ROOT, env=env, check=False).returncode:
        raise SetupError(error_message)


def lock(file: IO[str]) -> None:
    """Wait for the lock of a file; closing the file releases it."""
    if os.name != "nt":
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX)
        return
    import msvcrt

    while True:
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK, 1)
            return
        except OSError as error:
            if error.errno != errno.EDEADLOCK:  # LK_LOCK gives up after ten seconds
                raise


def make(folder: Path, contents: str) -> None:
    """Create a complete environment in `folder` for the running Python.

    Raises:
        SetupError: a library is missing or a step failed; `folder` then has no stamp.
    """
    groups, imports = CONTENTS[contents]
    check_not_linked(folder)
    check_system_libraries()
    print(f"Setting up {folder.name} with Python {sys.version.split()[0]}: {', '.join(groups)} …", flush=True)
    python = program_path(folder, "python")
    install_error = (
        "The Python packages could not be installed (see above): is the package index reachable, the disk full?"
    )
    (folder / STAMP).unlink(missing_ok=True)  # first, because --clear may be interrupted
    run_step(
        sys.executable,
        "-m",
        "venv",
        "--clear",
        folder,
        error_message=f"The virtual environment {folder.name} could not be created.",
    )
    run_step(python, "-m", "pip", "install", "--quiet", "--constraint", pins_path(), "uv", error_message=install_error)
    options = [f"--group=pyproject.toml:{group}" for group in groups]
    uv_install = [program_path(folder, "uv"), "pip", "install", "--python", python, "--constraint", pins_path()]
    run_step(*uv_install, *options, error_message=install_error, env=uv_environment(python))
    run_step(
        python,
        "-c",
        f"import {', '.join(imports)}",
        error_message="The packages are installed but do not import (see above).",
    )
    (folder / STAMP).write_text(fingerprint(contents))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("action", choices=("is-current", "make"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("contents", choices=CONTENTS)
    parser.add_argument(
        "python", nargs="?", default="", help="is-current: the Python that must have created the environment"
    )
    arguments = parser.parse_args()
    folder = ROOT / arguments.folder
    if arguments.action == "is-current":
        return 0 if is_current(folder, arguments.contents, arguments.python) else 1
    try:
        check_python()
        with open(f"{folder}.lock", "w") as file:
            lock(file)  # a second `make` in the same tree waits
            if not is_current(folder, arguments.contents):
                make(folder, arguments.contents)
    except SetupError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Interrupted; the next run creates the environment again.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
