# SPDX-License-Identifier: GPL-3.0-or-later
"""Program that installs and uses the extension: `python extension_life.py live|install|play|start|list [ZIP [BOUND]]`.

Its last line of output is JSON. The environment variable BLENDER_USER_RESOURCES names the user's folder. Blender can
run this file too: `blender -b --python … -- live ZIP`.

* `live` installs, enables, disables, updates and uninstalls the extension, and prints what is registered each time.
* `install` installs and enables the extension.
* `play` installs the extension, opens a bound file and poses the character.
* `start` enables the installed extension, and prints how long that takes.
* `list` prints the files in the user's folder.
"""

import json
import os
import sys
import time
from pathlib import Path
from types import ModuleType

import bpy

REPOSITORY, IDENTIFIER = "user_default", "fdda"
MODULE = f"bl_ext.{REPOSITORY}.{IDENTIFIER}"


def registered_items() -> dict:
    """Return everything that an add-on can register in Blender, by kind."""
    owners = (bpy.types.Object, bpy.types.Scene, bpy.types.WindowManager, bpy.types.Armature, bpy.types.Mesh)
    handlers = {name: getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)}
    keymaps = bpy.context.window_manager.keyconfigs.addon
    return {
        "classes": sorted(cls.__name__ for cls in blender_classes() if "fdda" in cls.__module__ and cls.is_registered),
        "operators": sorted(dir(bpy.ops.fdda)),
        "properties": sorted(f"{owner.__name__}.{name}" for owner in owners for name in dir(owner) if "fdda" in name),
        "handlers": sorted(
            f"{name}: {handler.__module__}.{handler.__name__}"
            for name, listed in handlers.items()
            if isinstance(listed, list)
            for handler in listed
            if "fdda" in handler.__module__
        ),
        "keymap_items": sum(len(keymap.keymap_items) for keymap in keymaps.keymaps) if keymaps else 0,
        "additions": sorted(
            f"{cls.__name__}: {function.__module__}"
            for cls in blender_classes()
            for function in getattr(getattr(cls, "draw", None), "_draw_funcs", ())
            if "fdda" in function.__module__
        ),
        "commands": loaded_commands(),
        "preferences": MODULE in bpy.context.preferences.addons,
    }


def blender_classes() -> list[type]:
    """Return the Python subclasses of Blender's types, registered or not."""
    kinds = ("AddonPreferences", "Gizmo", "GizmoGroup", "Header", "KeyingSetInfo", "Menu", "Operator", "Panel")
    kinds += ("PropertyGroup", "UIList")
    return [cls for kind in kinds for cls in getattr(bpy.types, kind).__subclasses__()]


def loaded_commands() -> list[str]:
    """Return the modules of the add-on that have registered a command: Blender offers no list of commands."""
    return [
        name
        for name, module in sys.modules.items()
        if name.startswith(MODULE) and getattr(module, "_cli_command", None) is not None
    ]


def user_files(user_folder: Path) -> list[str]:
    """Return the paths of all files in the user's folder, without caches."""
    paths = (path.relative_to(user_folder).as_posix() for path in user_folder.rglob("*") if path.is_file())
    return sorted(path for path in paths if "__pycache__" not in path and "/.cache/" not in path)


def install_zip(package: str, enable: bool) -> list[str]:
    """Install a zip with the operator of Install from Disk, and return its result."""
    options = {"filepath": package, "repo": REPOSITORY, "enable_on_install": enable}
    return list(bpy.ops.extensions.package_install_files(**options))


def enable_at_startup() -> dict:
    """Enable the installed extension as Blender does when it starts, and change the frame of a file without models.

    Returns:
        CPU time and wall-clock time in seconds, and the large libraries that were imported.
    """
    import addon_utils

    begin, begin_wall = time.process_time(), time.perf_counter()
    assert addon_utils.enable(MODULE, default_set=True, refresh_handled=True) is not None
    seconds, wall_seconds = time.process_time() - begin, time.perf_counter() - begin_wall
    bpy.context.scene.frame_set(2)
    modules = sorted({"onnxruntime", "torch"} & set(sys.modules))
    return {"seconds": seconds, "wall_seconds": wall_seconds, "modules": modules}


def installed_onnxruntime() -> ModuleType:
    """Import the ONNX Runtime that the zip has installed, although the environment may contain another one."""
    user_folder = Path(os.environ["BLENDER_USER_RESOURCES"])
    sys.path.insert(0, str(next(user_folder.glob("extensions/.local/lib/*/site-packages"))))
    import onnxruntime

    return onnxruntime


def play_bound_file(package: str, bound_elbow: str) -> dict:
    """Install a zip, open a bound file and bend the elbow; return the evaluated positions."""
    install_zip(package, True)
    onnxruntime = installed_onnxruntime()
    bpy.ops.wm.open_mainfile(filepath=bound_elbow)
    bpy.data.objects["elbow_rig"].pose.bones["lower"].rotation_euler[0] = 1.0
    bpy.context.view_layer.update()
    elbow = bpy.data.objects["elbow"].evaluated_get(bpy.context.evaluated_depsgraph_get())
    return {
        "status": bpy.data.objects["elbow"].fdda.status,
        "onnxruntime": Path(onnxruntime.__file__).as_posix(),
        "positions": [vertex.co[:] for vertex in elbow.data.vertices],
    }


def run_life_cycle(package: str) -> dict[str, dict]:
    """Install, enable, disable, update and uninstall the extension; return what is registered after each step."""
    user_folder = Path(os.environ["BLENDER_USER_RESOURCES"])
    states: dict[str, dict] = {}

    def add_state(name: str, **values: object) -> None:
        states[name] = {**registered_items(), "files": user_files(user_folder), **values}

    add_state("before")
    add_state("installed", result=install_zip(package, False))
    bpy.ops.preferences.addon_enable(module=MODULE)
    add_state("enabled")
    bpy.ops.preferences.addon_disable(module=MODULE)
    add_state("disabled")
    bpy.ops.preferences.addon_enable(module=MODULE)
    user_file = Path(bpy.utils.extension_path_user(MODULE, create=True)) / "kept"
    user_file.write_text("made by the user")
    onnxruntime = installed_onnxruntime()
    add_state("used", onnxruntime=onnxruntime.__file__, providers=onnxruntime.get_available_providers())
    add_state("updated", result=install_zip(package, True), kept=user_file.is_file())
    repositories = bpy.context.preferences.extensions.repos
    index = next(i for i, repository in enumerate(repositories) if repository.module == REPOSITORY)
    result = bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id=IDENTIFIER)
    add_state("uninstalled", result=list(result), kept=user_file.exists())
    return states


def main(action: str, *paths: str) -> None:
    if action == "live":
        result = run_life_cycle(*paths)
    elif action == "install":
        result = {"result": install_zip(*paths, True)}
    elif action == "list":
        result = {"files": user_files(Path(os.environ["BLENDER_USER_RESOURCES"]))}
    elif action == "play":
        result = play_bound_file(*paths)
    else:
        result = enable_at_startup()
    print(json.dumps(result))


if __name__ == "__main__":
    main(*(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]))
