# SPDX-License-Identifier: GPL-3.0-or-later
"""Creation of a virtual environment with the pinned requirements, for the running Python.

On Windows `py -3.13 setup\\environment.py make .venv everything` starts it, elsewhere `setup/environment`, which finds
the Python.

An environment is complete when its stamp is there, and the stamp is written last: whatever was interrupted, or made
from other requirements or by another Python, is made anew.
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
PYTHONS = ("3.13", "3.11")
SYSTEM_LIBRARIES = ROOT / "setup" / "system-libraries.txt"

# The dependency groups of pyproject.toml that an environment holds, and the imports that prove that it works.
CONTENTS = {
    "everything": (("setup", "blender", "trainer", "test", "lint"), ("bpy", "onnxruntime", "torch")),
    "farm": (("setup", "blender", "trainer", "test", "farm"), ("bpy", "onnxruntime", "torch", "distributed")),
    "blender": (("setup", "blender", "test"), ("bpy", "onnxruntime")),
}

# pip's settings, as `pip config list` names them, and what uv calls them: whoever taught pip about a mirror or a
# certificate need not teach uv as well.
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


def program(folder: Path, name: str) -> Path:
    """Return the path of a program in the virtual environment `folder`."""
    return folder / "Scripts" / f"{name}.exe" if os.name == "nt" else folder / "bin" / name


def pins() -> Path:
    """Return the file with pinned versions for the running Python."""
    return ROOT / "requirements" / "python-{}.{}.txt".format(*sys.version_info)


def check_python() -> None:
    """Check that a Blender LTS line has the version of the running Python.

    Raises:
        SetupError: naming the versions to start this with.
    """
    version = "{}.{}".format(*sys.version_info)
    if version not in PYTHONS:
        raise SetupError(
            f"FDDA needs Python {' or '.join(PYTHONS)} and this is {version}; on Windows 'py -{PYTHONS[0]}' starts the "
            "right one, elsewhere setup/environment finds it."
        )


def fingerprint(contents: str) -> str:
    """Compute the fingerprint of an environment; when it changes, the environment is created again."""
    digest = hashlib.sha256(repr((contents, CONTENTS[contents], sys.version, sys.base_prefix)).encode())
    digest.update(pins().read_bytes())
    return digest.hexdigest()


def is_current(folder: Path, contents: str, python: str = "") -> bool:
    """Return whether `folder` is complete and was created by the running Python, or by `python` where given."""
    if not program(folder, "python").exists() or (python and os.path.realpath(sys.executable) != python):
        return False
    stamp = folder / STAMP
    return stamp.is_file() and stamp.read_text() == fingerprint(contents)


def check_own(folder: Path) -> None:
    """Check that an environment is no link, because `venv --clear` would empty the linked folder.

    Raises:
        SetupError: the folder is a link or a junction, as in a second working tree that shares an environment.
    """
    try:
        target = os.readlink(folder)
    except OSError:  # not a link
        return
    raise SetupError(
        f"{folder.name} is a link to '{target}' and is not up to date; make it anew there, or remove the link to have "
        "one here."
    )


def check_system_libraries(listing: Path = SYSTEM_LIBRARIES) -> None:
    """Check for system libraries before the download; wheels for other systems than Linux include them.

    Raises:
        SetupError: naming the Debian packages of all the libraries that cannot be loaded.
    """
    if sys.platform != "linux":
        return
    missing = []
    for line in listing.read_text().splitlines():
        if line.startswith("#"):
            continue
        library, package = line.split()
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    if missing:
        packages = " ".join(missing)
        raise SetupError(f"Blender needs system libraries that are missing; as root: apt-get install {packages}")


def uv_environment(python: Path) -> dict[str, str]:
    """Return the environment variables for uv, with pip's settings where uv has none."""
    environment = {"UV_PYTHON_DOWNLOADS": "never"}
    listing = subprocess.run([python, "-m", "pip", "config", "list"], capture_output=True, text=True, check=False)
    for line in listing.stdout.splitlines():
        key, _, value = line.partition("=")
        name = UV_SETTINGS.get(key.rpartition(".")[2])
        if name:
            values = str(ast.literal_eval(value)).split()
            environment[name] = ("," if name == "UV_FIND_LINKS" else " ").join(values)
    if "UV_INDEX" in environment:  # pip looks into all its indexes, uv only into the first that knows the name
        environment["UV_INDEX_STRATEGY"] = "unsafe-best-match"
    return environment | os.environ


def run(*command: str | Path, why: str, env: dict[str, str] | None = None) -> None:
    """Run one step with its output on the terminal.

    Raises:
        SetupError: with `why`, when the step fails.
    """
    if subprocess.run(command, cwd=ROOT, env=env, check=False).returncode:
        raise SetupError(why)


def lock(file: IO[str]) -> None:
    """Wait for the lock of `file`, and hold it until the file is closed."""
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
            if error.errno != errno.EDEADLOCK:  # it tries for ten seconds
                raise


def make(folder: Path, contents: str) -> None:
    """Create a complete environment in `folder` for the running Python.

    Raises:
        SetupError: a library is missing or a step failed; `folder` then has no stamp.
    """
    groups, imports = CONTENTS[contents]
    check_own(folder)
    check_system_libraries()
    print(f"Setting up {folder.name} with Python {sys.version.split()[0]}: {', '.join(groups)} …", flush=True)
    python = program(folder, "python")
    why = "The Python packages could not be installed (see above): is the package index reachable, the disk full?"
    (folder / STAMP).unlink(missing_ok=True)  # first: --clear may be interrupted half-way too
    run(sys.executable, "-m", "venv", "--clear", folder, why=f"{folder.name} could not be made a virtual environment.")
    run(python, "-m", "pip", "install", "--quiet", "--constraint", pins(), "uv", why=why)
    options = [f"--group=pyproject.toml:{group}" for group in groups]
    uv = [program(folder, "uv"), "pip", "install", "--python", python, "--constraint", pins()]
    run(*uv, *options, why=why, env=uv_environment(python))
    run(python, "-c", f"import {', '.join(imports)}", why="The packages are installed but do not import (see above).")
    (folder / STAMP).write_text(fingerprint(contents))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("action", choices=("is-current", "make"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("contents", choices=CONTENTS)
    parser.add_argument("python", nargs="?", default="", help="is-current: the Python it must have been made by")
    arguments = parser.parse_args()
    folder = ROOT / arguments.folder
    if arguments.action == "is-current":
        return 0 if is_current(folder, arguments.contents, arguments.python) else 1
    try:
        check_python()
        with open(f"{folder}.lock", "w") as file:
            lock(file)  # two makes in one tree take turns
            if not is_current(folder, arguments.contents):
                make(folder, arguments.contents)
    except SetupError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("Interrupted; the next run starts the set-up anew.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
