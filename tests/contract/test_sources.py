# SPDX-License-Identifier: GPL-3.0-or-later
"""What every source file keeps to: its licence, its first sentence, nothing that runs data as code, no host names."""

import ast
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (
    "fdda_addon",
    "trainer",
    "farm",
    "benchmarks",
    "tests",
    "blend_fixtures",
    "setup",
    "requirements",
    "docs",
    "examples",
    ".ci",
)
INSTALLED = {"node_modules", "dist"}
"""Folders of others, inside of ours."""
SPDX = "# SPDX-License-Identifier: GPL-3.0-or-later"

# Names that say nothing about what is inside: such a file grows without end.
EMPTY_NAMES = {"util", "utils", "helper", "helpers", "function", "functions", "misc", "common", "manager", "service"}

# Which mirror packages come from is up to the machine that installs them.
REGISTRY_HOST = re.compile(
    "|".join(
        "".join(parts)
        for parts in (("py", "pi"), ("python", "hosted"), ("npm", "js"), ("deb.", "debian"), ("load.", "pytorch"))
    )
)


def text_files() -> Iterator[tuple[Path, str]]:
    """Every text file of the project, with its text."""
    files = [file for file in ROOT.iterdir() if file.is_file() and not file.name.startswith(".venv")]
    for folder, inner, names in (step for top in FOLDERS for step in os.walk(ROOT / top)):
        inner[:] = sorted(set(inner) - INSTALLED)
        files += [Path(folder, name) for name in names]
    for file in files:
        try:
            yield file.relative_to(ROOT), file.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue


WEB_FILES = (".js", ".mjs", ".css", ".html")

PYTHON_FILES = {str(path): text for path, text in sorted(text_files()) if path.suffix == ".py"}


@pytest.fixture(params=PYTHON_FILES)
def source(request: pytest.FixtureRequest) -> str:
    return PYTHON_FILES[request.param]


def called_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield node.func.id


def test_it_names_its_licence(source: str):
    lines = source.splitlines()
    assert SPDX in lines[:2]


def test_files_of_web_pages_name_their_licence():
    texts = {str(path): text for path, text in text_files() if path.suffix in WEB_FILES}
    assert texts and [path for path, text in texts.items() if SPDX[2:] not in "".join(text.splitlines()[:2])] == []


def test_it_says_what_it_is_for(source: str):
    assert ast.get_docstring(ast.parse(source))


def test_it_runs_no_data_as_code(source: str):
    tree = ast.parse(source)
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    assert not imported & {"pickle", "cPickle", "shelve", "marshal", "dill", "joblib"}
    assert not set(called_names(tree)) & {"eval", "exec"}


def test_it_loads_no_pickled_arrays(source: str):
    unsafe = {"allow_pickle": True, "weights_only": False}  # of numpy.load and torch.load
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.keyword) and isinstance(node.value, ast.Constant) and node.arg in unsafe:
            assert node.value.value is not unsafe[node.arg], f"line {node.value.lineno}"


def test_it_catches_no_exception_blindly(source: str):
    bare = [n.lineno for n in ast.walk(ast.parse(source)) if isinstance(n, ast.ExceptHandler) and n.type is None]
    assert bare == []


def test_files_are_named_for_what_they_hold():
    assert [path for path in PYTHON_FILES if EMPTY_NAMES & set(Path(path).with_suffix("").parts)] == []


def test_no_file_names_a_package_registry():
    assert [str(path) for path, text in text_files() if REGISTRY_HOST.search(text)] == []
