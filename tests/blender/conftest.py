# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures of the Blender tests, above all the elbow's files; and functions that read and compare positions."""

import hashlib
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np
import pytest
from filelock import FileLock

import fdda_addon
from blend_fixtures.characters import base
from blend_fixtures.characters.training import Trainings
from fdda_addon.cli.main import main
from fdda_addon.core.formats.model import METADATA_KEY
from fdda_addon.runtime.network import Network
from fdda_addon.scene.scene_rig import SceneRig, armature_of, find_rig

ELBOW = "elbow"
ELBOW_RIG = "elbow_rig"


@dataclass(frozen=True)
class ElbowFiles:
    """Paths of the elbow's files, all in one folder."""

    rig: Path
    recording: Path
    model: Path
    bound: Path


class Trained(NamedTuple):
    """Paths of a character's files, all in one folder."""

    rig: Path
    recording: Path
    model: Path

    def open(self, name: str = "") -> SceneRig:
        """Open the file of the rig, and return its rig."""
        bpy.ops.wm.open_mainfile(filepath=str(self.rig))
        return find_rig(name)


ADDED = {"FDDA": (False, False), "FDDA Undeformed": (False, False)}
"""The modifiers that a binding adds, with their visibility in viewport and render while the rig is shown."""


def run(*arguments: object) -> int:
    """Run a verb of the command line, and return its exit status."""
    return main([str(argument) for argument in arguments], "fdda")


@dataclass(frozen=True)
class CommandOutput:
    """Lines that a command printed to stdout and to stderr."""

    out: list[str]
    err: list[str]


def output_of(*arguments: object, status: int = 0) -> CommandOutput:
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert run(*arguments) == status, err.getvalue()
    return CommandOutput(out.getvalue().splitlines(), err.getvalue().splitlines())


@cache
def _shared_trainings() -> Trainings:
    return Trainings()


def train(recording: Path, model: Path, *options: object) -> None:
    """Train a model like the verb `train`, but in a process that all tests share: PyTorch takes seconds to start."""
    trainings = _shared_trainings()
    try:
        trainings.add(recording, model, *options)
        trainings.wait()
    except (RuntimeError, OSError):
        # The process may have ended. The next training starts another one.
        _shared_trainings.cache_clear()
        trainings.close()
        raise


def build_and_train(folder: Path, build: Callable, *options: object, training: tuple = ("--passes", 40)) -> Trained:
    """Build a character in an empty file, save and record it, and train a model.

    Args:
        folder: an existing folder for the files.
        build: function that builds the character in the current scene.
        options, training: options of `record` and `train`.
    """
    from fdda_addon.scene.blend_file import save_copy

    files = Trained(*(folder / name for name in ("rig.blend", "recording", "model.onnx")))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build()
    save_copy(files.rig)
    assert run("record", files.rig, files.recording, *options) == 0
    train(files.recording, files.model, *training)
    return files


def pytest_sessionfinish() -> None:
    if _shared_trainings.cache_info().currsize:
        _shared_trainings().close()


@pytest.fixture(scope="session")
def elbow_files(tmp_path_factory: pytest.TempPathFactory) -> ElbowFiles:
    """Make the elbow's files in the first test process that needs them; the processes share the folder.

    No test may change these files. A test that writes another file beside them puts its process ID into the name.
    """
    from blend_fixtures.elbow import build_elbow
    from fdda_addon.scene.blend_file import save_copy

    temporary = tmp_path_factory.getbasetemp()
    folder = (temporary.parent if "PYTEST_XDIST_WORKER" in os.environ else temporary) / "elbow"
    files = ElbowFiles(*(folder / name for name in ("elbow.blend", "recording", "elbow.onnx", "bound.blend")))
    with FileLock(folder.with_suffix(".lock")):
        if not files.bound.exists():
            # Remove the files that another process left when it failed here.
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            bpy.ops.wm.read_factory_settings(use_empty=True)
            build_elbow()
            save_copy(files.rig)
            assert run("record", files.rig, files.recording, "--poses", 150) == 0
            train(files.recording, files.model, "--passes", 40)
            assert run("bind", files.rig, files.model, files.bound) == 0
    return files


@pytest.fixture(autouse=True)
def _addon() -> Iterator[None]:
    """Register the add-on in an empty file. Preferences are not reset between tests."""
    fdda_addon.register()
    # This is several times faster than `read_factory_settings`.
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    fdda_addon.register()
    yield
    fdda_addon.unregister()


def without_deformation(model: Path) -> Path:
    """Write a copy of a model without requirements for modifiers and shape keys, in the same folder."""
    return with_deformation(model, {})


def with_deformation(model: Path, deformation: dict) -> Path:
    """Write a copy of a model that requires other modifiers, shape keys and drivers, in the same folder."""

    def edit(info: dict) -> None:
        info["meshes"][0]["fingerprint"]["deformation"] = deformation

    # Test processes share the folder.
    return write_edited(model, model.with_name(f"other_{os.getpid()}_{model.name}"), edit_metadata(edit))


def edit_metadata(edit: Callable[[dict], object]) -> Callable:
    """Return a function for `write_edited` that changes the metadata of a model."""

    def change(proto) -> None:
        (prop,) = (prop for prop in proto.metadata_props if prop.key == METADATA_KEY)
        info = json.loads(prop.value)
        edit(info)
        prop.value = json.dumps(info)

    return change


def write_edited(model: Path, path: Path, edit: Callable) -> Path:
    """Write a copy of a model that `edit` changes, with a matching checksum, and return its path."""
    import onnx

    from fdda_addon.core.formats.model import CHECKSUM_KEY

    proto = onnx.load(model)
    edit(proto)
    for checksum in (prop for prop in proto.metadata_props if prop.key == CHECKSUM_KEY):
        checksum.value = hashlib.sha256(proto.graph.SerializeToString()).hexdigest()
    path.write_bytes(proto.SerializeToString())
    return path


@pytest.fixture
def refusal(tmp_path: Path, capfd: pytest.CaptureFixture):
    """Return a function that runs a verb which must fail, and returns its error message."""
    from .refusals import Refusal

    return Refusal(tmp_path, capfd)


@pytest.fixture
def refusal_on_a_full_disk(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Like `refusal`, but captures output in memory: a full disk takes no file."""
    from .refusals import Refusal

    return Refusal(tmp_path, capsys)


@pytest.fixture
def preferences() -> Iterator[bpy.types.AddonPreferences]:
    """The preferences of the add-on. Without installation, tests add them."""
    addon = bpy.context.preferences.addons.new()
    addon.module = "fdda_addon"
    yield addon.preferences
    bpy.context.preferences.addons.remove(addon)


@pytest.fixture
def loose_model(elbow_files: ElbowFiles) -> Path:
    """Return a copy of the elbow's model that plays with any modifiers."""
    return without_deformation(elbow_files.model)


@pytest.fixture
def rig(elbow_files: ElbowFiles) -> SceneRig:
    """Open the elbow's file, and return its rig."""
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    return find_rig()


@pytest.fixture
def saved(rig: SceneRig, tmp_path: Path) -> SceneRig:
    """The elbow, active, in a .blend file of its own."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "elbow.blend"))
    bpy.context.view_layer.objects.active = rig.mesh_object
    return rig


@pytest.fixture
def bound_elbow(elbow_files: ElbowFiles) -> bpy.types.Object:
    """Open the file of the bound elbow, and return its mesh object."""
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.bound))
    return bpy.data.objects[ELBOW]


@pytest.fixture
def active(bound_elbow: bpy.types.Object) -> bpy.types.Object:
    """The mesh object of the bound elbow, which is active."""
    bpy.context.view_layer.objects.active = bound_elbow
    return bound_elbow


@pytest.fixture
def library(elbow_files: ElbowFiles, tmp_path: Path):
    """Make a library with the bound elbow (`linked.Library`), and leave an empty shot open."""
    from .linked import make_library

    return make_library(elbow_files, tmp_path)


@pytest.fixture
def pair(library) -> list[bpy.types.Object]:
    """Make two library overrides of the elbow, each in another pose."""
    from .linked import ANGLES, link_character, override_character

    collection = link_character(library.path)
    return [override_character(collection, angle) for angle in ANGLES]


def rig_positions(mesh_object: bpy.types.Object) -> np.ndarray:
    """Return the positions (V, 3) that a playing character has in mode RIG; the mode is FDDA afterwards."""
    mesh_object.fdda.mode = "RIG"
    positions = evaluated_positions(mesh_object)
    mesh_object.fdda.mode = "FDDA"
    return positions


def pose(armature_name: str = ELBOW_RIG, angle: float = 1.0, bone: str = "lower") -> None:
    """Rotate a bone to an angle about X, in radians, and update the view layer."""
    bpy.data.objects[armature_name].pose.bones[bone].rotation_euler[0] = angle
    bpy.context.view_layer.update()


def evaluated_positions(mesh_object: bpy.types.Object) -> np.ndarray:
    """Return the positions (V, 3) of the evaluated mesh, read as a user's script reads them."""
    mesh_object = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = mesh_object.to_mesh()
    positions = np.array([vertex.co[:] for vertex in mesh.vertices], np.float32)
    mesh_object.to_mesh_clear()
    return positions


def predicted_positions(mesh_object: bpy.types.Object, model: Path) -> np.ndarray:
    """Return the model's positions (V, 3) for the evaluated pose, computed without the code for playback."""
    network = Network(model).of_mesh(mesh_object.fdda.model_mesh)
    return base.predicted_positions(SceneRig(mesh_object, armature_of(mesh_object)), network)


def assert_plays(mesh_object: bpy.types.Object, model: Path) -> np.ndarray:
    """Assert that the evaluated mesh equals the model's output within 1e-5 m, and return its positions (V, 3)."""
    positions = evaluated_positions(mesh_object)
    assert not mesh_object.fdda.status
    assert np.abs(positions - predicted_positions(mesh_object, model)).max() < 1e-5
    return positions
