# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a virtual environment with the pinned requirements; started by `setup/environment`, which finds the Python.

An environment is complete when its stamp is there, and the stamp is written last: whatever was interrupted, or made
from other requirements or by another Python, is made anew.
"""

import argparse
import ast
import ctypes
import fcntl
import hashlib
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
STAMP = "fdda-complete"
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
    """The environment cannot be made; the text says what to do about it."""


def pins() -> Path:
    """The file that pins every package for the Python that runs this."""
    return ROOT / "requirements" / "python-{}.{}.txt".format(*sys.version_info)


def fingerprint(contents: str) -> str:
    """What an environment depends on: when any of it changes, the environment is made anew."""
    digest = hashlib.sha256(repr((contents, CONTENTS[contents], sys.version, sys.base_prefix)).encode())
    digest.update(pins().read_bytes())
    return digest.hexdigest()


def is_current(folder: Path, contents: str, python: str) -> bool:
    """Whether `folder`, whose Python runs this, is complete and made by `python`, where one was asked for."""
    if python and os.path.realpath(sys.executable) != python:
        return False
    stamp = folder / STAMP
    return stamp.is_file() and stamp.read_text() == fingerprint(contents)


def check_own(folder: Path) -> None:
    """Refuse to make an environment anew that lies elsewhere: `venv --clear` empties what a link leads to.

    Raises:
        SetupError: the folder is a link, as in a second working tree that shares an environment.
    """
    if folder.is_symlink():
        raise SetupError(
            f"{folder.name} is a link to '{os.readlink(folder)}' and is not up to date; make it anew there, or remove "
            "the link to have one here."
        )


def check_system_libraries(listing: Path = SYSTEM_LIBRARIES) -> None:
    """Ask before hundreds of megabytes are fetched, not after.

    Raises:
        SetupError: naming the Debian packages of all the libraries that cannot be loaded.
    """
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
    """The environment for uv: the settings of pip where uv has none of its own."""
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
    """Run one step; its own output stays on the terminal.

    Raises:
        SetupError: with `why`, when the step fails.
    """
    if subprocess.run(command, cwd=ROOT, env=env, check=False).returncode:
        raise SetupError(why)


def make(folder: Path, contents: str) -> None:
    """Make `folder` a complete environment for the Python that runs this.

    Raises:
        SetupError: a library is missing or a step failed; `folder` then has no stamp.
    """
    groups, imports = CONTENTS[contents]
    check_own(folder)
    check_system_libraries()
    print(f"Setting up {folder.name} with Python {sys.version.split()[0]}: {', '.join(groups)} …", flush=True)
    python = folder / "bin" / "python"
    why = "The Python packages could not be installed (see above): is the package index reachable, the disk full?"
    (folder / STAMP).unlink(missing_ok=True)  # first: --clear may be interrupted half-way too
    run(sys.executable, "-m", "venv", "--clear", folder, why=f"{folder.name} could not be made a virtual environment.")
    run(python, "-m", "pip", "install", "--quiet", "--constraint", pins(), "uv", why=why)
    options = [f"--group=pyproject.toml:{group}" for group in groups]
    uv = [folder / "bin" / "uv", "pip", "install", "--python", python, "--constraint", pins()]
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
        with open(f"{folder}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # two makes in one tree take turns
            check = [folder / "bin" / "python", __file__, "is-current", folder, arguments.contents]
            if not check[0].exists() or subprocess.run(check, stderr=subprocess.DEVNULL, check=False).returncode:
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
