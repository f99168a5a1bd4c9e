# SPDX-License-Identifier: GPL-3.0-or-later
"""The folder of the add-on's training environment, and its state.

A completion marker is written last, so that an interrupted installation is recognized. Blender keeps the folder when it
updates the extension, and removes it when it uninstalls the extension.
"""

import enum
import hashlib
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ...core.errors import TrainerEnvironmentError, os_error_text
from ...core.files.file_lock import NoLocksError, try_lock

EXTENSION = __package__.rpartition(".fdda_addon")[0]
"""Module name of the installed extension, "bl_ext.REPOSITORY.fdda"; empty if the add-on is not installed."""
PACKAGES = ("torch", "onnx", "onnxruntime", "numpy", "scipy", "jinja2")
"""Packages that the trainer imports."""
COMPLETION_MARKER = "fdda-complete"
ROOT = Path(__file__).parents[3]
"""Folder with the packages `fdda_addon` and `trainer`: the checkout, or the installed extension."""
REQUIREMENTS = ROOT / "requirements"
PINNED_REQUIREMENTS = {(3, 11): "python-3.11.txt", (3, 12): "python-3.11.txt", (3, 13): "python-3.13.txt"}
"""Versions of Python that an environment may have, each with the name of its file of pinned package versions."""
OFFLINE = (
    "Blender's online access is off: allow it in Preferences > System > Network, choose a folder under Offline "
    "Packages, or choose an existing Python that has torch"
)


class FolderState(enum.Enum):
    """State of the environment."""

    MISSING = "missing"
    INCOMPLETE = "incomplete"
    """Its installation was interrupted."""
    BROKEN = "broken"
    """Its Python, or the Python that it was created from, is missing."""
    OUTDATED = "outdated"
    """It can train, but has other package versions than this add-on requires."""
    READY = "ready"


def user_folder() -> Path:
    """Return the folder of the add-on's files for this user."""
    import bpy

    if EXTENSION.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(EXTENSION))
    return Path(bpy.utils.user_resource("DATAFILES", path="fdda"))


def environment_folder() -> Path:
    """Return the folder of the environment, in the folder that Blender removes with the extension.

    On Windows the path has 91 characters besides the user name, so that names of up to 33 fit with those of the wheels.
    """
    return user_folder() / "trainer"


def log_path() -> Path:
    """Return the path of the log of the last installation."""
    return user_folder() / "trainer.log"


def interpreter_path(folder: Path) -> Path:
    """Return the interpreter of a virtual environment or of a conda environment."""
    if os.name != "nt":
        return folder / "bin/python"
    conda_python, python = folder / "python.exe", folder / "Scripts/python.exe"
    return conda_python if conda_python.is_file() and not python.is_file() else python


def site_packages(folder: Path, version: tuple[int, int]) -> Path:
    """Return the site-packages folder of a virtual environment for a version of Python."""
    return folder / ("Lib" if os.name == "nt" else f"lib/python{version[0]}.{version[1]}") / "site-packages"


def requirements_file(version: tuple[int, int]) -> Path:
    """Return the file of pinned package versions for a version of Python in `PINNED_REQUIREMENTS`."""
    return REQUIREMENTS / PINNED_REQUIREMENTS[version]


def creation_obstacle(wheels: str) -> str:
    """Return why the environment cannot be installed now; empty if it can. `wheels` is the folder of packages."""
    import bpy

    return "" if wheels or bpy.app.online_access else OFFLINE


def folder_state(folder: Path) -> FolderState:
    """Read the state of an environment from its files."""
    if not folder.is_dir():
        return FolderState.MISSING
    try:
        marker = (folder / COMPLETION_MARKER).read_text(encoding="utf-8").split()
    except (OSError, UnicodeDecodeError):
        return FolderState.INCOMPLETE
    if not interpreter_path(folder).is_file():
        return FolderState.BROKEN
    current_fingerprints = {
        _requirements_fingerprint(path) for path in set(map(requirements_file, PINNED_REQUIREMENTS)) if path.is_file()
    }
    return FolderState.READY if marker and marker[0] in current_fingerprints else FolderState.OUTDATED


def environment_python() -> str | None:
    """Return the Python of the add-on's environment; None if the environment is missing or incomplete."""
    folder = environment_folder()
    is_complete = folder_state(folder) not in (FolderState.MISSING, FolderState.INCOMPLETE)
    return str(interpreter_path(folder)) if is_complete else None


def write_completion_marker(folder: Path, version: tuple[int, int]) -> None:
    """Mark an environment as complete."""
    (folder / COMPLETION_MARKER).write_text(
        _requirements_fingerprint(requirements_file(version)) + "\n", encoding="utf-8"
    )


def remove_environment(folder: Path) -> None:
    """Remove an environment. The marker is removed first, so that an interrupted removal leaves it incomplete.

    Raises:
        TrainerEnvironmentError: a file cannot be removed.
    """
    try:
        (folder / COMPLETION_MARKER).unlink(missing_ok=True)
        # On Windows a virus scanner may have new files open.
        for pause in (0.2, 1, 3) if os.name == "nt" else ():
            shutil.rmtree(folder, ignore_errors=True)
            if not folder.is_dir():
                return
            time.sleep(pause)
        if folder.is_dir():
            shutil.rmtree(folder)
    except OSError as error:
        raise TrainerEnvironmentError(
            f"The training environment cannot be removed ({os_error_text(error)}: '{error.filename}'); end what uses "
            f"it, a training perhaps, or remove the folder '{folder}' yourself."
        ) from error


@contextmanager
def creation_lock(folder: Path) -> Iterator[None]:
    """Lock the environment against installation and removal by other processes; the lock ends with the process.

    Raises:
        TrainerEnvironmentError: another process holds the lock, or the folder cannot be written.
    """
    path = folder.with_name(folder.name + ".lock")
    with ExitStack() as stack:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            is_locked = try_lock(stack.enter_context(path.open("a+b")).fileno())
        except NoLocksError:
            is_locked = True  # the folder is the user's own, so another process is unlikely
        except OSError as error:
            raise TrainerEnvironmentError(
                f"The folder '{folder.parent}' cannot be written ({os_error_text(error)}); see to its permissions, or "
                "choose an existing Python that has torch."
            ) from error
        if not is_locked:
            raise TrainerEnvironmentError(
                "Another Blender is installing or removing the training environment; wait until it is done."
            )
        yield


def _requirements_fingerprint(requirements: Path) -> str:
    text = requirements.read_text(encoding="utf-8") + repr(PACKAGES)
    return hashlib.sha256(text.encode()).hexdigest()
