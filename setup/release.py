# SPDX-License-Identifier: GPL-3.0-or-later
"""Build dist/repository, a folder that any web server can offer as an extension repository of Blender.

It holds the zips of one version for all platforms, Blender's list of them (`index.json`), and a page (`index.html`)
with links to drag into Blender. `make release VERSION=0.2.0` runs this script; docs/release.md describes a release.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from package import ALL_PLATFORMS, DIST_FOLDER, ROOT, PackageError, build_packages, read_version, run_extension_tool

REPOSITORY_FOLDER = DIST_FOLDER / "repository"
PAGE_TEMPLATE = Path(__file__).with_name("repository.html")


class ReleaseError(Exception):
    """The repository cannot be built; the message says what to do."""


def check_version(version: str) -> None:
    """Check that the manifest has this version, and that the changelog has a chapter about it.

    Raises:
        ReleaseError: one of them does not.
    """
    if version != (manifest_version := read_version()):
        raise ReleaseError(
            f"blender_manifest.toml has the version {manifest_version}, not {version}; change one of the two."
        )
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    if not re.search(rf"^## {re.escape(version)}( |$)", changelog, re.MULTILINE):
        raise ReleaseError(f"CHANGELOG.md has no chapter '## {version}'; write what is new in this version.")


def check_website(website: str) -> None:
    """Check an address for the manifest.

    Raises:
        ReleaseError: it is neither empty nor an address of a web page.
    """
    if website and not re.fullmatch(r"https?://[^\s\"\\]+", website):
        raise ReleaseError(f"'{website}' is no address of a web page; set WEBSITE to https://… or leave it out.")


def make_repository(packages: list[Path], folder: Path) -> None:
    """Make a repository of zips, and replace the folder of an earlier one when it is complete.

    Args:
        packages: paths of the zips. Together they hold one version, and at most one zip for each system.
        folder: folder of the repository.

    Raises:
        ReleaseError: Blender's list does not have all zips, or `folder` is something else than a repository.
        CalledProcessError: the extension tool failed.
    """
    if folder.exists() and not (folder / "index.json").is_file():
        raise ReleaseError(f"'{folder}' is no repository and would be replaced; move it away.")
    with tempfile.TemporaryDirectory(prefix=".repository-", dir=folder.parent) as temporary_folder:
        new_folder = Path(temporary_folder) / "new"
        new_folder.mkdir()
        for package in packages:
            shutil.copy(package, new_folder)
        run_extension_tool("server-generate", "--repo-dir", new_folder, "--html", "--html-template", PAGE_TEMPLATE)
        check_repository(new_folder, packages)
        if folder.exists():
            folder.rename(Path(temporary_folder) / "old")
        os.replace(new_folder, folder)


def check_repository(folder: Path, packages: list[Path]) -> None:
    """Check that Blender's list of a repository has exactly these zips, with their sizes and hashes, in one version.

    The extension tool leaves out a zip that it cannot read, and still succeeds.

    Raises:
        ReleaseError: a zip is missing in the list, differs, or has another version.
    """
    entries = json.loads((folder / "index.json").read_text(encoding="utf-8"))["data"]
    listed = {entry["archive_url"].removeprefix("./"): entry for entry in entries}
    for package in packages:
        content = (folder / package.name).read_bytes()
        expected = {"archive_size": len(content), "archive_hash": f"sha256:{hashlib.sha256(content).hexdigest()}"}
        entry = listed.pop(package.name, {})
        if {key: entry.get(key) for key in expected} != expected:
            raise ReleaseError(f"Blender's list of the repository lacks {package.name}; see the messages above.")
    if listed:
        raise ReleaseError(f"Blender's list of the repository has {min(listed)}, which was not built.")
    if len(versions := sorted({entry["version"] for entry in entries})) > 1:
        raise ReleaseError(f"The zips have the versions {' and '.join(versions)}; build all of them again.")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("version", help="version to release, as in blender_manifest.toml and CHANGELOG.md")
    parser.add_argument("--website", default="", help="address that Blender opens with Visit Website")
    parser.add_argument("--platforms", nargs="+", default=[ALL_PLATFORMS], help="as for package.py; by default all")
    options = parser.parse_args()
    try:
        check_version(options.version)
        check_website(options.website)
        make_repository(build_packages(options.platforms, options.website), REPOSITORY_FOLDER)
    except (PackageError, ReleaseError) as error:
        print(error, file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as error:
        print(f"Nothing was released: '{Path(error.cmd[1]).name}' failed (see above).", file=sys.stderr)
        return 1
    print(f"{REPOSITORY_FOLDER.relative_to(ROOT)} is complete; docs/release.md has the next steps.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
