# SPDX-License-Identifier: GPL-3.0-or-later
"""The web example in headless Chromium shows the positions that Python computes, and fetches only its own files."""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import matplotlib.image
import numpy as np
import pytest

from fdda_addon.core.formats.model import read_model_info

from .conftest import ROOT, Character, Rotations, expected_positions

WEB = ROOT / "examples" / "web"
DRIVER = Path(__file__).parent / "drive_page.mjs"
MIN_NODE_VERSION = int(re.search(r">=(\d+)", json.loads((WEB / "package.json").read_text())["engines"]["node"])[1])
PANEL_WIDTH = 300
"""Width of the panel at the left of the screenshot, pixels."""
ROTATIONS = {"bone_0": (-15.0, 60.0, 5.0), "bone_1": (40.0, 25.0, -30.0), "bone_3": (0.0, -20.0, 50.0)}


@dataclass(frozen=True)
class PageState:
    """The page after the last step.

    Attributes:
        state: "ready" or "failed".
        status: the sentence in the panel.
        positions: (V, 3) float32 vertex positions, meters; empty if the model has not run.
        joints: names in the list of joints.
        controls: labels of the sliders of controls.
        requests: addresses that were fetched.
        errors: errors in the browser's console.
        view: (H, W, 3) float32 pixels of the screenshot beside the panel, 0 to 1.
    """

    state: str
    status: str
    positions: np.ndarray
    joints: list[str]
    controls: list[str]
    requests: list[str]
    errors: list[str]
    view: np.ndarray


def run(*command: object, **options) -> str:
    result = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="session")
def chromium() -> str:
    names = [os.environ.get("CHROMIUM", ""), "chromium", "chromium-browser", "google-chrome"]
    path = next(filter(None, map(shutil.which, filter(None, names))), None)
    if not path:
        pytest.skip("There is no Chromium; install the package chromium, or name the program in CHROMIUM.")
    return path


@pytest.fixture(scope="session")
def built_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the page without a model and return its folder; install packages only if the lock file is newer."""
    if missing := [name for name in ("node", "npm") if not shutil.which(name)]:
        pytest.skip(f"There is no {' and no '.join(missing)}; install Node.js {MIN_NODE_VERSION} or later with npm.")
    if int(re.match(r"v(\d+)", version := run("node", "--version").strip())[1]) < MIN_NODE_VERSION:
        pytest.skip(f"This is Node.js {version}; install {MIN_NODE_VERSION} or later.")
    installed_marker = WEB / "node_modules" / ".package-lock.json"
    if not installed_marker.is_file() or installed_marker.stat().st_mtime < (WEB / "package-lock.json").stat().st_mtime:
        run("npm", "ci", cwd=WEB)
    folder = tmp_path_factory.mktemp("page")
    run("npm", "run", "build", "--", f"--outdir={folder}", cwd=WEB)
    return folder


@pytest.fixture(scope="session")
def open_page(built_page: Path, chromium: str, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., PageState]:
    """Return a function that opens a page with the model of a character, or without a model, and runs steps in it."""

    def open_character(character: Character | None, *steps: str) -> PageState:
        folder = tmp_path_factory.mktemp("opened")
        shutil.copytree(built_page, folder, dirs_exist_ok=True)
        if character:
            run(sys.executable, "-I", WEB / "prepare.py", character.model, character.recording, folder)
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(SilentRequestHandler, directory=str(folder)))
        Thread(target=server.serve_forever, daemon=True).start()
        try:
            url = f"http://127.0.0.1:{server.server_port}/"
            picture = folder / "page.png"
            page_state = json.loads(run("node", DRIVER, chromium, url, picture, *steps, timeout=90))
        finally:
            server.shutdown()
            server.server_close()
        page_state["positions"] = np.float32(page_state["positions"]).reshape(-1, 3)
        page_state["requests"] = [address.replace(url, "/") for address in page_state["requests"]]
        return PageState(**page_state, view=matplotlib.image.imread(picture)[:, PANEL_WIDTH + 1 :, :3])

    return open_character


@pytest.fixture(scope="session")
def rest_page(open_page: Callable[..., PageState], chain: Character) -> PageState:
    return open_page(chain)


@pytest.fixture(scope="session")
def posed_page(open_page: Callable[..., PageState], chain: Character) -> PageState:
    return open_page(chain, *slider_steps(ROTATIONS))


class SilentRequestHandler(SimpleHTTPRequestHandler):
    """Serves files without a log."""

    def log_message(self, *_: object) -> None:
        pass


def slider_steps(rotations: Rotations) -> list[str]:
    """Return steps that rotate joints with the sliders."""
    steps = []
    for name, angles in rotations.items():
        steps.append(f"#joint={name}")
        steps += [f"#angle-{axis}={angle}" for axis, angle in zip("xyz", angles, strict=True)]
    return steps


def mesh_mask(view: np.ndarray) -> np.ndarray:
    """Return the (H, W) mask of the mesh, which is light and gray; the floor is dark and the axes have colors."""
    return (view.min(axis=-1) > 0.3) & (np.ptp(view, axis=-1) < 0.08)


def test_the_page_computes_the_same_positions_as_python(rest_page: PageState, posed_page: PageState, chain: Character):
    for page, rotations in (rest_page, {}), (posed_page, ROTATIONS):
        assert (page.state, page.errors) == ("ready", [])
        assert re.fullmatch(r"Confidence \d+ %, \d+\.\d ms", page.status)
        assert page.joints == ["bone_0", "bone_1", "bone_2", "bone_3"]
        assert np.abs(page.positions - expected_positions(chain.model, rotations)).max() < 1e-5
    assert np.abs(posed_page.positions - rest_page.positions).max() > 0.1


def test_the_page_fetches_only_its_own_files(rest_page: PageState):
    assert {"/", "/main.js", "/style.css", "/model.onnx", "/triangles.bin"} <= set(rest_page.requests)
    assert len([address for address in rest_page.requests if address.endswith(".wasm")]) == 1
    assert [address for address in rest_page.requests if not address.startswith("/")] == []


def test_the_mesh_is_visible_and_follows_the_sliders(rest_page: PageState, posed_page: PageState):
    for page in (rest_page, posed_page):
        mask = mesh_mask(page.view)
        assert 0.01 < mask.mean() < 0.5
        assert len(np.unique((page.view[mask][:, 0] * 255).astype(int))) > 30, "the mesh is not shaded"
    assert (mesh_mask(rest_page.view) != mesh_mask(posed_page.view)).mean() > 0.01


def test_the_button_resets_to_the_rest_pose(
    open_page: Callable[..., PageState], rest_page: PageState, chain: Character
):
    reset_page = open_page(chain, *slider_steps(ROTATIONS), "#joint=bone_0", "#rest")
    assert np.array_equal(reset_page.positions, rest_page.positions)
    assert np.array_equal(mesh_mask(reset_page.view), mesh_mask(rest_page.view))


def test_shape_keys_have_sliders_and_static_joints_have_none(
    open_page: Callable[..., PageState], controlled_chain: Character
):
    low = read_model_info(controlled_chain.model).controls[0].low
    for steps, value in ([], low), (["#control-0=0.9"], 0.9):
        page = open_page(controlled_chain, *slider_steps(ROTATIONS), *steps)
        assert (page.state, page.errors, page.controls) == ("ready", [], ["bulge"])
        assert page.joints == ["bone_0", "bone_1", "bone_2", "bone_3"]
        assert np.abs(page.positions - expected_positions(controlled_chain.model, ROTATIONS, (value,))).max() < 1e-5


def test_meshes_can_be_hidden(open_page: Callable[..., PageState], controlled_chain: Character):
    both, hose, pipe, none = (
        mesh_mask(open_page(controlled_chain, *steps).view).mean()
        for steps in ([], ["#mesh-0"], ["#mesh-1"], ["#mesh-0", "#mesh-1"])
    )
    assert none == 0 < min(hose, pipe) < both and both == pytest.approx(hose + pipe, rel=0.2)


def test_a_page_without_a_model_shows_an_error(open_page: Callable[..., PageState]):
    page = open_page(None)
    assert page.state == "failed"
    assert page.status == "There is no model.onnx beside this page; write it with prepare.py."


def test_a_recording_of_a_different_mesh_is_refused(chain: Character, tmp_path: Path):
    def run_prepare() -> str:
        command = [sys.executable, "-I", str(WEB / "prepare.py"), str(chain.model), str(tmp_path), str(tmp_path / "to")]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (result.returncode, (tmp_path / "to").exists()) == (1, False)
        return result.stderr

    assert run_prepare() == f"{tmp_path} is not a recording with faces; record the rig again.\n"
    (tmp_path / "face_starts.npy").symlink_to(chain.recording / "face_starts.npy")
    text = (chain.recording / "recording.json").read_text()
    (tmp_path / "recording.json").write_text(text.replace('"chain"', '"tube"'))
    assert (
        run_prepare()
        == f"{tmp_path} is a recording of a different mesh; choose the one that the model was trained on.\n"
    )


def test_faces_are_split_into_fans_of_triangles():
    spec = importlib.util.spec_from_file_location("prepare", WEB / "prepare.py")
    prepare = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(prepare)
    faces = prepare.triangulate(np.int32([0, 3, 8, 12]), np.int32([5, 6, 7, 0, 1, 2, 3, 4, 9, 8, 7, 6, 1, 2, 3]))
    expected = [(5, 6, 7), (0, 1, 2), (0, 2, 3), (0, 3, 4), (9, 8, 7), (9, 7, 6), (1, 2, 3)]
    assert faces.dtype == np.dtype("<u4") and [tuple(face) for face in faces.tolist()] == expected
