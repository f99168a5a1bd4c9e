# SPDX-License-Identifier: GPL-3.0-or-later
"""The live bindings of the open file.

A model runs inside Blender's evaluation, on whatever thread evaluates (`play`); what changes data waits until the
evaluation is over (`follow`). Live bindings hold names and session ids, never RNA references: those do not survive an
undo or the load of a file. They are found anew from the properties of the objects whenever something may have changed.
"""

from collections.abc import Container, Iterator
from contextlib import contextmanager

import bpy

from ..core.errors import FDDAError, ModelError
from . import nodes, position_buffer, rig_check, switch
from .changed import Changed, changed_meshes
from .crowd import Crowds, is_hub
from .evaluation_threads import keep_thread
from .live_binding import VIEWPORT_KEY, LiveBinding
from .model_files import network_of

_bound: dict[int, frozenset[str]] = {}
"""What is animated or driven of what switches a bound object (`switch.animated_switches`), by its session id."""
_live: dict[int, LiveBinding] = {}
"""Those that play, by the session id of their position buffer."""
_crowds = Crowds()
_edited: set[int] = set()
"""Session ids of the bound objects whose meshes are being changed, in edit mode or another."""
_object_count = -1
_is_following = False
_is_given_back = False


def play(driven: bpy.types.Object) -> None:
    """Give an evaluated position buffer, or all of a hub, the positions of the pose. Nothing is raised."""
    keep_thread()
    uid = driven.original.session_uid
    player = _live.get(uid) or _crowds.by_hub.get(uid)
    if player is not None:
        player.play(driven)


def gather(*, frame_changed: bool) -> None:
    """After an evaluation: let those play together that move together while frames change, and no others."""
    global _object_count
    # A hub that comes or goes is no reason to scan.
    _object_count += _crowds.follow(_live, frame_changed)


def follow(depsgraph: bpy.types.Depsgraph) -> None:
    """After an evaluation: find what has come or gone, and give back to its rig what cannot play."""
    for uid, live in list(_live.items()):
        if live.is_outdated:
            _drop(uid)
    scan()
    _greet(depsgraph)
    _know_viewport(depsgraph)
    for live in list(_live.values()):
        mesh_object = live.find() if live.error or live.has_news else None
        if mesh_object is None:
            continue
        with _isolated(mesh_object):
            if live.error:
                raise live.error
            mesh_object.fdda.status = live.take_news()
    if any(_bound.values()) and not _is_following:
        for mesh_object in [o for o in bpy.data.objects if _bound.get(o.session_uid)]:
            with _isolated(mesh_object):
                _follow_mode(mesh_object, depsgraph)


@contextmanager
def _isolated(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Show the rig of a character for which the block fails; the other characters play on."""
    try:
        yield
    except FDDAError as error:
        fail(mesh_object, error)
    except Exception as error:
        # What a character can be is not known, and what leaves a handler stops all characters.
        fail(mesh_object, ModelError(f"The model of '{mesh_object.name}' cannot be played ({error!r}); bind it again."))


def _greet(depsgraph: bpy.types.Depsgraph) -> None:
    """Have the position buffers of new live bindings evaluated once more in a dependency graph.

    What a graph did not need before, while its modifier was off, it leaves out of the first evaluation with it.
    """
    # Not by its address, which Blender gives to another graph when this one is gone.
    key = depsgraph.mode, depsgraph.scene.session_uid, depsgraph.view_layer.name
    new = {uid for uid, live in _live.items() if key not in live.graphs}
    if new:
        for buffer in [o for o in bpy.data.objects if o.session_uid in new]:
            _live[buffer.session_uid].graphs.add(key)
            buffer.data.update_tag()


def _know_viewport(depsgraph: bpy.types.Depsgraph) -> None:
    """Tell the live bindings that have shape keys what evaluates for a viewport: a getter does not learn for whom."""
    if depsgraph.mode != "VIEWPORT":
        return
    for live in [live for live in _live.values() if live.is_unmarked]:
        mesh_object = live.find()
        if mesh_object is not None and (evaluated := mesh_object.evaluated_get(depsgraph)).is_evaluated:
            evaluated[VIEWPORT_KEY], live.is_unmarked = True, False


def _follow_mode(mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> None:
    """Switch the modifiers where a mode that is animated or driven has come to, or left, the rig."""
    global _is_following
    evaluated, binding = mesh_object.evaluated_get(depsgraph), mesh_object.fdda
    switch.disconnect_visible(mesh_object, _bound[mesh_object.session_uid])
    if not evaluated.is_evaluated or (depsgraph.mode == "RENDER" and not binding.use_in_render):
        return
    if switch.held_mode_of(mesh_object.session_uid):
        return
    wants_model = switch.evaluated_wants_model(evaluated, depsgraph, _bound[mesh_object.session_uid])
    # What cannot play waits for the user: its status says what to do.
    if wants_model != binding.is_playing and not (wants_model and binding.status):
        switch.switch_modifiers(mesh_object, wants_model)
        binding.status = ""
        make_anew(mesh_object)
        # In one evaluation Blender learns that the position buffer is needed; it evaluates the buffer in the next one.
        _is_following = True
        try:
            depsgraph.update()
        finally:
            _is_following = False
        make_anew(mesh_object)
        scan()


def note_changes(depsgraph: bpy.types.Depsgraph) -> None:
    """Look anew at the bound objects, and at the rigs, that an evaluation has changed."""
    changed = Changed.by(depsgraph)
    for mesh_object, is_mesh, is_whole in changed.mesh_objects:
        if mesh_object.fdda.is_bound:
            with _isolated(mesh_object):
                _note_object(mesh_object, is_mesh, is_whole)
    _follow_weights(changed.meshes)
    # A render's own graph takes everything for new.
    if depsgraph.mode != "RENDER":
        _note_rigs(changed)


def _note_object(mesh_object: bpy.types.Object, is_mesh: bool, is_whole: bool) -> None:
    """Look anew at a bound object that an evaluation has changed (`Changed.mesh_objects`)."""
    follow_mask(mesh_object)
    if mesh_object.session_uid not in _bound:
        look_again()
        return
    _bound[mesh_object.session_uid] = animated = switch.animated_switches(mesh_object)
    if is_mesh:
        switch.follow_visibility(mesh_object, animated)
        switch.disconnect_visible(mesh_object, animated)
    uid, live = _of(mesh_object)
    if live is None:
        return
    if (is_mesh and not (live.fits(mesh_object) and _reads(mesh_object, uid))) or (
        is_whole and not live.has_skin(mesh_object)
    ):
        _drop(uid)
    elif mesh_object.mode not in rig_check.SETTLED_MODES:
        _edited.add(mesh_object.session_uid)


def note_data(depsgraph: bpy.types.Depsgraph) -> None:
    """As `note_changes`, with a frame; one in which nothing has changed but poses and shape keys costs nothing."""
    updated = depsgraph.id_type_updated
    if updated("ARMATURE") or updated("SCENE") or (updated("MESH") and changed_meshes(depsgraph)):
        note_changes(depsgraph)


def _note_rigs(changed: Changed) -> None:
    for mesh, is_whole in changed.meshes.items():
        if is_whole:
            rig_check.doubt(mesh)
    for uid, live in list(_live.items()):
        is_other = changed.armatures.get(live.form.armature)
        mesh_is_other = changed.meshes.get(live.form.mesh)
        if is_other is None and mesh_is_other is None and live.uid not in _edited:
            continue
        mesh_object = live.find()
        if mesh_object is None:
            continue
        with _isolated(mesh_object):
            if is_other is not None and not live.has_bones(mesh_object, also_parents=is_other):
                _drop(uid)
            elif mesh_object.mode not in rig_check.SETTLED_MODES:
                _edited.add(live.uid)
            elif mesh_is_other or live.uid in _edited or (mesh_is_other is False and not live.has_rest(mesh_object)):
                if live.uid in _edited:
                    _edited.discard(live.uid)
                    rig_check.doubt(live.form.mesh)
                live.form = rig_check.Form.of(live.scene_rig(mesh_object))
                live.check_rig(mesh_object)


def follow_mask(mesh_object: bpy.types.Object, *, weights_changed: bool = False) -> None:
    """Play the pose again with the mask that a bound object has now, if it is another."""
    uid, live = _of(mesh_object)
    if live is not None and live.follow_mask(mesh_object, weights_changed):
        for buffer in [o for o in bpy.data.objects if o.session_uid == uid]:
            buffer.data.update_tag()


def _follow_weights(meshes: Container[int]) -> None:
    """The weights of meshes, by their session ids, may have been painted; those of masks are read anew."""
    for live in [live for live in _live.values() if live.has_mask and live.form.mesh in meshes]:
        mesh_object = live.find()
        if mesh_object is not None:
            with _isolated(mesh_object):
                follow_mask(mesh_object, weights_changed=True)


def _reads(mesh_object: bpy.types.Object, uid: int) -> bool:
    """Whether the modifier of a mesh object reads a position buffer."""
    modifier = nodes.find_modifier(mesh_object)
    buffer = modifier and nodes.buffer_of(modifier)
    return buffer is not None and buffer.session_uid == uid


def is_outdated(mesh_object: bpy.types.Object) -> bool:
    """Whether an object plays a model whose file has been replaced since it was loaded."""
    live = _of(mesh_object)[1]
    return live is not None and live.network is not network_of(mesh_object)


def _of(mesh_object: bpy.types.Object) -> tuple[int, LiveBinding | None]:
    return next(((uid, live) for uid, live in _live.items() if live.uid == mesh_object.session_uid), (0, None))


def _drop(uid: int) -> None:
    _crowds.scatter(uid)
    del _live[uid]
    look_again()


def forget() -> None:
    """Make all live bindings anew after the next evaluation."""
    _live.clear()
    _crowds.forget()
    _bound.clear()
    _edited.clear()
    look_again()


def forget_rigs() -> None:
    """As `forget`, and read all rigs anew: other datablocks may stand under the same names."""
    rig_check.forget()
    forget()


def make_anew(mesh_object: bpy.types.Object) -> None:
    """Make the live binding of an object anew after the next evaluation; what it shows is evaluated then once more."""
    uid, live = _of(mesh_object)
    if live is not None:
        _drop(uid)
    look_again()


def look_again() -> None:
    """Look for bound objects after the next evaluation, also when none has come or gone."""
    global _object_count
    _object_count = -1


def playing_objects() -> list[bpy.types.Object]:
    """The objects of the file that a model deforms."""
    return [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_playing]


def give_back_rigs() -> None:
    """Let the rigs of the open file show as if no model played; `resume` lets the models play on."""
    for mesh_object in playing_objects():
        # Linked ones too, which are not saved: of a library override Blender saves how it differs from them.
        switch.give_back(mesh_object)


def resume() -> None:
    """Let the models of the open file play, whatever came or went."""
    forget()
    scan()


@contextmanager
def rigs_given_back() -> Iterator[None]:
    """Borrow the open file as it is without models, to write parts of it: nothing of ours comes along."""
    global _is_given_back
    give_back_rigs()
    remove_buffers()
    # Operators evaluate before they begin.
    _is_given_back = True
    try:
        yield
    finally:
        _is_given_back = False
        resume()


def remove_buffers() -> None:
    """Remove all position buffers, and forget what plays; `resume` makes them anew.

    Blender's undo keeps datablocks that are the same in two steps as they are in memory: one that points to an object
    which was made without a step of its own would then point to memory that is free.
    """
    forget()
    for mesh_object in [o for o in bpy.data.objects if o.type == "MESH"]:
        modifier = nodes.find_modifier(mesh_object)
        if modifier is not None:
            nodes.set_buffer(modifier, None)
    _remove_unused()


@contextmanager
def constant_positions() -> Iterator[None]:
    """Play without executing models, to measure what the rest of a frame costs: positions stay as they are first."""
    LiveBinding.is_constant = True
    try:
        yield
    finally:
        LiveBinding.is_constant = False


def fail(mesh_object: bpy.types.Object, error: FDDAError) -> None:
    """Give a mesh back to its rig because its model cannot play, and say why, once."""
    uid, live = _of(mesh_object)
    if live is not None:
        _drop(uid)
    mesh_object.fdda.mode = "RIG"
    if mesh_object.fdda.is_playing:
        # Its mode is animated.
        switch.switch_modifiers(mesh_object, False)
    mesh_object.fdda.status = str(error)
    print(f"FDDA is switched off for '{mesh_object.name}': {error}")


def scan() -> None:
    """Find the bound objects when objects have come or gone; each that plays has its own position buffer."""
    global _object_count
    if _is_given_back or _object_count == len(bpy.data.objects):
        return
    _crowds.forget()
    taken: set[int] = set()
    for mesh_object in [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]:
        with _isolated(mesh_object):
            _find(mesh_object, taken)
    _remove_unused()
    _object_count = len(bpy.data.objects)


def _find(mesh_object: bpy.types.Object, taken: set[int]) -> None:
    """Make the live binding of a bound object that plays and has none.

    Args:
        mesh_object: the object.
        taken: session ids of the position buffers that others use; its own is added.
    """
    _bound[mesh_object.session_uid] = animated = switch.animated_switches(mesh_object)
    switch.follow_visibility(mesh_object, animated)
    if not animated and mesh_object.fdda.is_playing != switch.wants_model(mesh_object):
        # Linked or appended from a file, which holds the true rig; or a library was reloaded.
        switch.switch_modifiers(mesh_object)
    if not mesh_object.fdda.is_playing:
        switch.disconnect_visible(mesh_object, animated)
        return
    buffer = _ensure_buffer(mesh_object, taken)
    live = _live.get(buffer.session_uid)
    if live is None or live.uid != mesh_object.session_uid:
        _live[buffer.session_uid] = LiveBinding(mesh_object, buffer)
        if mesh_object.mode not in rig_check.SETTLED_MODES:
            _edited.add(mesh_object.session_uid)
    else:
        # Blender hands a driver on to the override of what it reads.
        live.connect(mesh_object, buffer)


def _ensure_buffer(mesh_object: bpy.types.Object, taken: set[int]) -> bpy.types.Object:
    """The position buffer of a mesh object: a new one where it has none, or one that is in another's use."""
    modifier = nodes.find_modifier(mesh_object)
    if modifier is None:
        raise ModelError(f"The FDDA modifier of '{mesh_object.name}' was removed; bind the model again.")
    buffer = nodes.buffer_of(modifier)
    is_own = buffer is not None and position_buffer.is_buffer(buffer) and buffer.session_uid not in taken
    if not is_own or len(buffer.data.vertices) != len(mesh_object.data.vertices):
        # A duplicate still points to the positions of its original, an override to those of the linked object.
        buffer = position_buffer.create_buffer(mesh_object)
        nodes.set_buffer(modifier, buffer)
    taken.add(buffer.session_uid)
    return buffer


def _remove_unused() -> None:
    """Remove the position buffers of what was deleted."""
    used = nodes.used_buffers()
    for buffer in [o for o in bpy.data.objects if position_buffer.is_buffer(o) and o not in used]:
        _live.pop(buffer.session_uid, None)
        position_buffer.remove_buffer(buffer)
    for hub in [o for o in bpy.data.objects if is_hub(o) and o.session_uid not in _crowds.by_hub]:
        bpy.data.objects.remove(hub)
