# SPDX-License-Identifier: GPL-3.0-or-later
"""The web example, built and opened in Chromium without a window: it shows what Python computes, and fetches nothing
from elsewhere."""

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

from fdda_addon.core.model import read_model_info

from .conftest import ROOT, Character, Turns, expected_positions

WEB = ROOT / "examples" / "web"
DRIVER = Path(__file__).parent / "drive_page.mjs"
NODE = int(re.search(r">=(\d+)", json.loads((WEB / "package.json").read_text())["engines"]["node"])[1])
PANEL = 300
"""Pixels at the left of the picture that are not the view."""
TURNS = {"bone_0": (-15.0, 60.0, 5.0), "bone_1": (40.0, 25.0, -30.0), "bone_3": (0.0, -20.0, 50.0)}


@dataclass(frozen=True)
class Shown:
    """What the page showed after the last step.

    Attributes:
        state, status: "ready" or "failed", and the sentence.
        positions: (V, 3) float32, meters; empty before the first.
        joints: names to choose from.
        sliders: how many there are.
        requests: addresses that were fetched.
        errors: of the page, as in the browser's console.
        view: (H, W, 3) float32, the picture beside the panel, 0 to 1.
    """

    state: str
    status: str
    positions: np.ndarray
    joints: list[str]
    sliders: int
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
    found = next(filter(None, map(shutil.which, filter(None, names))), None)
    if not found:
        pytest.skip("There is no Chromium; install the package chromium, or name the program in CHROMIUM.")
    return found


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the page, without a model; read only. Its packages stay installed until the lock file is newer."""
    if missing := [name for name in ("node", "npm") if not shutil.which(name)]:
        pytest.skip(f"There is no {' and no '.join(missing)}; install Node.js {NODE} or later with npm.")
    if int(re.match(r"v(\d+)", version := run("node", "--version").strip())[1]) < NODE:
        pytest.skip(f"This is Node.js {version}; install {NODE} or later.")
    installed = WEB / "node_modules" / ".package-lock.json"
    if not installed.is_file() or installed.stat().st_mtime < (WEB / "package-lock.json").stat().st_mtime:
        run("npm", "ci", cwd=WEB)
    folder = tmp_path_factory.mktemp("page")
    run("npm", "run", "build", "--", f"--outdir={folder}", cwd=WEB)
    return folder


@pytest.fixture(scope="session")
def open_page(built: Path, chromium: str, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Shown]:
    """Call with a character, or None, and steps for the driver: opens a page with the model and says what it shows."""

    def open_(character: Character | None, *steps: str) -> Shown:
        folder = tmp_path_factory.mktemp("opened")
        shutil.copytree(built, folder, dirs_exist_ok=True)
        if character:
            run(sys.executable, "-I", WEB / "prepare.py", character.model, character.recording, folder)
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
        Thread(target=server.serve_forever, daemon=True).start()
        try:
            url = f"http://127.0.0.1:{server.server_port}/"
            picture = folder / "page.png"
            answer = json.loads(run("node", DRIVER, chromium, url, picture, *steps, timeout=90))
        finally:
            server.shutdown()
            server.server_close()
        answer["positions"] = np.float32(answer["positions"]).reshape(-1, 3)
        answer["requests"] = [address.replace(url, "/") for address in answer["requests"]]
        return Shown(**answer, view=matplotlib.image.imread(picture)[:, PANEL + 1 :, :3])

    return open_


@pytest.fixture(scope="session")
def at_rest(open_page: Callable[..., Shown], chain: Character) -> Shown:
    return open_page(chain)


@pytest.fixture(scope="session")
def posed(open_page: Callable[..., Shown], chain: Character) -> Shown:
    return open_page(chain, *sliders(TURNS))


class Quiet(SimpleHTTPRequestHandler):
    """Serves files and logs nothing."""

    def log_message(self, *_: object) -> None:
        pass


def sliders(turns: Turns) -> list[str]:
    """Steps that turn joints."""
    steps = []
    for name, angles in turns.items():
        steps.append(f"#joint={name}")
        steps += [f"#angle-{axis}={angle}" for axis, angle in zip("xyz", angles, strict=True)]
    return steps


def mesh_part(view: np.ndarray) -> np.ndarray:
    """(H, W), where the mesh is: it is light and gray, the ground is dark and the axes are colorful."""
    return (view.min(axis=-1) > 0.3) & (np.ptp(view, axis=-1) < 0.08)


def test_it_shows_what_python_computes(at_rest: Shown, posed: Shown, chain: Character):
    for shown, turns in (at_rest, {}), (posed, TURNS):
        assert (shown.state, shown.errors) == ("ready", [])
        assert re.fullmatch(r"Confidence \d+ %, \d+\.\d ms", shown.status)
        assert shown.joints == ["bone_0", "bone_1", "bone_2", "bone_3"]
        assert np.abs(shown.positions - expected_positions(chain.model, turns)).max() < 1e-5
    assert np.abs(posed.positions - at_rest.positions).max() > 0.1


def test_everything_comes_from_beside_the_page(at_rest: Shown):
    assert {"/", "/main.js", "/style.css", "/model.onnx", "/triangles.bin"} <= set(at_rest.requests)
    assert len([address for address in at_rest.requests if address.endswith(".wasm")]) == 1
    assert [address for address in at_rest.requests if not address.startswith("/")] == []


def test_the_mesh_is_seen_and_follows_the_sliders(at_rest: Shown, posed: Shown):
    for shown in (at_rest, posed):
        part = mesh_part(shown.view)
        assert 0.01 < part.mean() < 0.5
        assert len(np.unique((shown.view[part][:, 0] * 255).astype(int))) > 30, "it is not shaded"
    assert (mesh_part(at_rest.view) != mesh_part(posed.view)).mean() > 0.01


def test_a_button_leads_back_to_the_rest_pose(open_page: Callable[..., Shown], at_rest: Shown, chain: Character):
    back = open_page(chain, *sliders(TURNS), "#joint=bone_0", "#rest")
    assert np.array_equal(back.positions, at_rest.positions)
    assert np.array_equal(mesh_part(back.view), mesh_part(at_rest.view))


def test_controls_have_sliders_and_what_never_moves_has_none(open_page: Callable[..., Shown], controlled: Character):
    low = read_model_info(controlled.model).controls[0].low
    for steps, value in ([], low), (["#control-0=0.9"], 0.9):
        shown = open_page(controlled, *sliders(TURNS), *steps)
        assert (shown.state, shown.errors, shown.sliders) == ("ready", [], 4)
        assert shown.joints == ["bone_0", "bone_1", "bone_2", "bone_3"]
        assert np.abs(shown.positions - expected_positions(controlled.model, TURNS, (value,))).max() < 1e-5


def test_a_page_without_a_model_says_so(open_page: Callable[..., Shown]):
    shown = open_page(None)
    assert shown.state == "failed"
    assert shown.status == "There is no model.onnx beside this page; write it with prepare.py."


def test_a_recording_of_another_mesh_is_refused(chain: Character, tmp_path: Path):
    def prepare() -> str:
        command = [sys.executable, "-I", str(WEB / "prepare.py"), str(chain.model), str(tmp_path), str(tmp_path / "to")]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (result.returncode, (tmp_path / "to").exists()) == (1, False)
        return result.stderr

    assert prepare() == f"{tmp_path} is no recording with faces; record the rig again.\n"
    (tmp_path / "face_starts.npy").symlink_to(chain.recording / "face_starts.npy")
    text = (chain.recording / "recording.json").read_text()
    (tmp_path / "recording.json").write_text(text.replace('"chain"', '"tube"'))
    assert prepare() == f"{tmp_path} is a recording of another mesh; name the one that the model was trained on.\n"


def test_faces_become_fans_of_triangles():
    spec = importlib.util.spec_from_file_location("prepare", WEB / "prepare.py")
    prepare = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(prepare)
    faces = prepare.triangulate(np.int32([0, 3, 8, 12]), np.int32([5, 6, 7, 0, 1, 2, 3, 4, 9, 8, 7, 6, 1, 2, 3]))
    expected = [(5, 6, 7), (0, 1, 2), (0, 2, 3), (0, 3, 4), (9, 8, 7), (9, 7, 6), (1, 2, 3)]
    assert faces.dtype == np.dtype("<u4") and [tuple(face) for face in faces.tolist()] == expected


def test_the_lock_file_names_no_host():
    text = (WEB / "package-lock.json").read_text()
    assert "http" not in text and '"integrity"' in text


def test_the_page_of_the_documents_has_the_commands_that_are_tested():
    page = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    for command in ("npm ci", "npm run build", "python prepare.py ../../out/demo/arm.onnx ../../out/demo/recording"):
        assert f"    {command}\n" in page
