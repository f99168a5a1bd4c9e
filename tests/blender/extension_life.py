# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension in a Blender of its own: `python extension_life.py live|install|play|start|list [ZIP [BOUND]]`.

`live` installs the zip, enables, disables, installs again, uninstalls, and prints what Blender holds after each;
`install` installs and enables it; `play` then opens a bound file and poses it; `start` says what it costs
to enable it, once it is installed; `list` names the files of the user. The last line is JSON.
BLENDER_USER_RESOURCES names the folder for all that. Blender itself runs it too: `blender -b --python … -- live ZIP`.
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


def registered() -> dict:
    """What Blender holds that an add-on may have left."""
    owners = (bpy.types.Object, bpy.types.Scene, bpy.types.WindowManager, bpy.types.Armature, bpy.types.Mesh)
    handlers = {name: getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)}
    keymaps = bpy.context.window_manager.keyconfigs.addon
    return {
        "classes": sorted(cls.__name__ for cls in classes() if "fdda" in cls.__module__ and cls.is_registered),
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
            for cls in classes()
            for function in getattr(getattr(cls, "draw", None), "_draw_funcs", ())
            if "fdda" in function.__module__
        ),
        "commands": loaded_commands(),
        "preferences": MODULE in bpy.context.preferences.addons,
    }


def classes() -> list[type]:
    """The classes that Python code has made for Blender, registered or not."""
    kinds = ("AddonPreferences", "Gizmo", "GizmoGroup", "Header", "KeyingSetInfo", "Menu", "Operator", "Panel")
    kinds += ("PropertyGroup", "UIList")
    return [cls for kind in kinds for cls in getattr(bpy.types, kind).__subclasses__()]


def loaded_commands() -> list[str]:
    """Modules whose command is registered: Blender keeps no list of them for scripts, the add-on does."""
    return [
        name
        for name, module in sys.modules.items()
        if name.startswith(MODULE) and getattr(module, "_cli_command", None) is not None
    ]


def files(user: Path) -> list[str]:
    """What lies in the user's folder, but for caches of Blender's own and the list of extensions."""
    paths = (path.relative_to(user).as_posix() for path in user.rglob("*") if path.is_file())
    return sorted(path for path in paths if "__pycache__" not in path and "/.cache/" not in path)


def install(package: str, enable: bool) -> list[str]:
    """Install the zip, as Install from Disk does."""
    options = {"filepath": package, "repo": REPOSITORY, "enable_on_install": enable}
    return list(bpy.ops.extensions.package_install_files(**options))


def start() -> dict:
    """Enable the installed extension as Blender does when it starts, and play a frame with nothing bound."""
    import addon_utils

    # The bpy module imports numpy, Blender's program does not.
    for name in [name for name in sys.modules if name.partition(".")[0] == "numpy"]:
        del sys.modules[name]
    begin, begin_wall = time.process_time(), time.perf_counter()
    assert addon_utils.enable(MODULE, default_set=True, refresh_handled=True) is not None
    seconds, wall_seconds = time.process_time() - begin, time.perf_counter() - begin_wall
    bpy.context.scene.frame_set(2)
    modules = sorted({"numpy", "onnxruntime", "torch"} & set(sys.modules))
    return {"seconds": seconds, "wall_seconds": wall_seconds, "modules": modules}


def installed_onnxruntime() -> ModuleType:
    """Import what the zip brought, ahead of another one, which the bpy wheel's environment may have."""
    user = Path(os.environ["BLENDER_USER_RESOURCES"])
    sys.path.insert(0, str(next(user.glob("extensions/.local/lib/*/site-packages"))))
    import onnxruntime

    return onnxruntime


def play(package: str, bound: str) -> dict:
    """Install the zip and play a bound file: what the elbow shows when it is bent."""
    install(package, True)
    onnxruntime = installed_onnxruntime()
    bpy.ops.wm.open_mainfile(filepath=bound)
    bpy.data.objects["elbow_rig"].pose.bones["lower"].rotation_euler[0] = 1.0
    bpy.context.view_layer.update()
    elbow = bpy.data.objects["elbow"].evaluated_get(bpy.context.evaluated_depsgraph_get())
    return {
        "status": bpy.data.objects["elbow"].fdda.status,
        "onnxruntime": Path(onnxruntime.__file__).as_posix(),
        "positions": [vertex.co[:] for vertex in elbow.data.vertices],
    }


def live(package: str) -> dict[str, dict]:
    """The whole life: what Blender holds after each step."""
    user = Path(os.environ["BLENDER_USER_RESOURCES"])
    story: dict[str, dict] = {}

    def note(name: str, **values: object) -> None:
        story[name] = {**registered(), "files": files(user), **values}

    note("before")
    note("installed", result=install(package, False))
    bpy.ops.preferences.addon_enable(module=MODULE)
    note("enabled")
    bpy.ops.preferences.addon_disable(module=MODULE)
    note("disabled")
    bpy.ops.preferences.addon_enable(module=MODULE)
    own = Path(bpy.utils.extension_path_user(MODULE, create=True)) / "kept"
    own.write_text("what the user has made")
    onnxruntime = installed_onnxruntime()
    note("used", onnxruntime=onnxruntime.__file__, providers=onnxruntime.get_available_providers())
    note("updated", result=install(package, True), kept=own.is_file())
    repositories = bpy.context.preferences.extensions.repos
    index = next(i for i, repository in enumerate(repositories) if repository.module == REPOSITORY)
    result = bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id=IDENTIFIER)
    note("uninstalled", result=list(result), kept=own.exists())
    return story


def main(action: str, *paths: str) -> None:
    if action == "live":
        told = live(*paths)
    elif action == "install":
        told = {"result": install(*paths, True)}
    elif action == "list":
        told = {"files": files(Path(os.environ["BLENDER_USER_RESOURCES"]))}
    elif action == "play":
        told = play(*paths)
    else:
        told = start()
    print(json.dumps(told))


if __name__ == "__main__":
    main(*(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]))
