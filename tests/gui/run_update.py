# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs the extension from a repository in a Blender with a window, offers the next version, and updates.

The repositories are on a web server of this script, on the loopback interface. The next version is the zip of
`make package`. The version before is a zip from --old, or that zip with another version in its manifest. FOLDER gets
screenshots of all steps. Exit status: as for run.py.
"""

import argparse
import functools
import http.server
import os
import shutil
import sys
import threading
import zipfile
from pathlib import Path

import run

sys.path.append(str(run.ROOT / "setup"))
OLD_VERSION = "0.0.1"


def with_version(package: Path, path: Path, version: str) -> Path:
    """Copy a zip to a path, with another version in its manifest."""
    with zipfile.ZipFile(package) as source, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in source.namelist():
            content = source.read(name)
            if name == "blender_manifest.toml":
                content = content.replace(f'version = "{run.VERSION}"'.encode(), f'version = "{version}"'.encode())
            archive.writestr(name, content)
    return path


def make_folder(folder: Path, blender: str, bound: Path, old: Path | None) -> None:
    """Fill the folder of the story `update`: two repositories, and a file with a bound arm."""
    import release

    shutil.rmtree(folder, ignore_errors=True)
    for name in ("bound", "user"):
        (folder / name).mkdir(parents=True)
    for path in (bound, *bound.parent.glob("*.onnx")):
        shutil.copy(path, folder / "bound")
    package = run.package_for(blender)
    old_package = old or with_version(package, folder / f"fdda_addon-{OLD_VERSION}.zip", OLD_VERSION)
    release.make_repository([old_package], folder / "site")
    release.make_repository([package], folder / "next")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder for screenshots; it is deleted first")
    parser.add_argument("bound", type=Path, help="a .blend file with the bound sample arm, beside its model")
    parser.add_argument("blender", nargs="?", default="blender", help="command that starts Blender")
    parser.add_argument("--old", type=Path, help="zip of the version before, for the Python of this Blender")
    options = parser.parse_args()
    if requirement := run.missing_requirement(options.blender):
        print(f"The window is not tested: {requirement}.", file=sys.stderr)
        return run.MISSING_REQUIREMENT_STATUS
    folder = options.folder.resolve()
    make_folder(folder, options.blender, options.bound.resolve(), options.old)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder / "site"))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    (folder / "address.txt").write_text(f"http://127.0.0.1:{server.server_port}", encoding="utf-8")
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "user")}
    try:
        problem = run.run_story(folder, "update", options.blender, environment)
    finally:
        server.shutdown()
    if problem:
        print(f"The test of the update failed: {problem}.", file=sys.stderr)
        return 1
    shutil.rmtree(folder / "user")
    print(f"All steps succeeded: {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
