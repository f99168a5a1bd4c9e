# SPDX-License-Identifier: GPL-3.0-or-later
"""A program that runs pip with only those of the user's settings that a download needs.

Others, such as `user`, `prefix`, `root` or `require-hashes`, would install the packages elsewhere or not at all. The
Python of the training environment runs this file, so it imports nothing of the add-on. With `--no-index` it uses no
setting. Its log names settings without their values, which may hold passwords.
"""

import os
import runpy
import sys

USED_SETTINGS = {
    *("index-url", "extra-index-url", "find-links", "no-index"),
    *("proxy", "cert", "client-cert", "trusted-host", "keyring-provider", "use-deprecated"),
    *("timeout", "default-timeout", "retries", "resume-retries"),
}
LEGACY_CERTIFICATES = "legacy-certs"
"""The only value of `use-deprecated` that matters for a download."""
MIN_VERSION_WITH_RAW_PROGRESS = (24, 1)


def _settings() -> dict[str, str]:
    """Return pip's settings by name, from its files and from environment variables."""
    from pip._internal.configuration import Configuration
    from pip._internal.exceptions import PipError

    configuration = Configuration(isolated=False)
    try:
        configuration.load()
    except PipError as error:
        print("ERROR:", " ".join(str(error).split()))
        sys.exit(78)  # `creation.UNREADABLE_SETTINGS_STATUS`
    # Since pip 25 the values are grouped by file.
    groups = [value if isinstance(value, dict) else {key: value} for key, value in configuration.items()]
    items = [(*key.rpartition(".")[::2], str(value)) for group in groups for key, value in group.items()]
    sections = ("global", "install", ":env:")  # later sections override former ones
    return {name: value for section in sections for key, name, value in items if key == section and value}


def _main() -> None:
    import pip

    settings = {} if "--no-index" in sys.argv else _settings()
    used = {name: value for name, value in settings.items() if name in USED_SETTINGS}
    if LEGACY_CERTIFICATES in used.pop("use-deprecated", "").split():
        used["use-deprecated"] = LEGACY_CERTIFICATES
    print("Settings of pip that are used:", ", ".join(used) or "none", flush=True)
    for name in [name for name in os.environ if name.upper().startswith("PIP_")]:
        del os.environ[name]
    os.environ.update({f"PIP_{name.upper().replace('-', '_')}": value for name, value in used.items()})
    version = tuple(int(number) for number in pip.__version__.split(".")[:2])
    progress = "raw" if version >= MIN_VERSION_WITH_RAW_PROGRESS else "off"
    os.environ.update({"PIP_CONFIG_FILE": os.devnull, "PIP_PROGRESS_BAR": progress})
    sys.argv[0] = "pip"
    runpy.run_module("pip", run_name="__main__")


if __name__ == "__main__":
    _main()
