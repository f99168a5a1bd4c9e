# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters with one model that move in the same frames: their poses are executed in one call.

While they do, the drivers of their position buffers wait for one hub, an object whose driver reads all that they read;
its getter plays them all. A hub makes Blender evaluate all of them when one is posed, so it is there only while frames
change: it comes with the second frame in which the same ones moved, and goes with the first pose that few of them took.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from itertools import islice

import bpy

from ..core.errors import FDDAError
from . import driver
from .live_binding import LiveBinding
from .network import Execution, Network

FEWEST = 4
"""Members of a crowd; below, one call each costs less than waiting for all."""
KEPT_EXECUTIONS = 4
HUB_KEY = "fdda_hub"
"""Custom property of a hub."""


def is_hub(scene_object: bpy.types.Object) -> bool:
    """Whether an object is a hub of this session."""
    return scene_object.is_runtime_data and HUB_KEY in scene_object


class Crowd:
    """Live bindings that wait for one hub.

    Attributes:
        network: their model.
        members: by the session ids of their position buffers.
    """

    def __init__(self, network: Network, members: Mapping[int, LiveBinding]):
        self.network, self.members = network, dict(members)
        self._executions: list[Execution] = []

    def gather(self) -> bpy.types.Object:
        """Make the hub."""
        known = {o.session_uid: o for o in bpy.data.objects}
        hub = bpy.data.objects.new("FDDA crowd", None)
        # Nothing uses it, and it must stay when the user purges what nothing uses.
        hub.is_runtime_data, hub.use_fake_user, hub[HUB_KEY] = True, True, True
        found = [(live, live.find(), known[uid]) for uid, live in self.members.items()]
        sources = [source for live, mesh_object, buffer in found for source in live.sources(mesh_object, buffer)]
        inputs = [variable for live, mesh_object, _ in found for variable in live.inputs(mesh_object)]
        driver.set_driver_inputs(hub, [driver.playback_input(hub), *sources, *inputs])
        for uid in self.members:
            driver.set_driver_inputs(known[uid], [("SINGLE_PROP", hub, "location[0]")])
        return hub

    def scatter(self) -> None:
        """Let each member play by itself again."""
        known = {o.session_uid: o for o in bpy.data.objects}
        for uid, live in self.members.items():
            mesh_object = live.find()
            if mesh_object is not None and uid in known:
                try:
                    live.connect(mesh_object, known[uid])
                except FDDAError as error:
                    live.error = error

    def play(self, hub: bpy.types.Object) -> None:
        """Give all evaluated position buffers their positions; errors are noted with the members."""
        with ExitStack() as stack:
            shown = []
            sources = iter(driver.evaluated_inputs(hub, sum(live.source_count for live in self.members.values())))
            for live in self.members.values():
                stack.enter_context(live.lock)
                buffer, mesh_object, armature_object, *owners = islice(sources, live.source_count)
                with live.noting_errors():
                    if buffer is not None and live.read(mesh_object, armature_object, owners):
                        shown.append((live, buffer, mesh_object))
            moved = [live for live, _, _ in shown if live.job is not None]
            self._execute(moved)
            for live, buffer, mesh_object in shown:
                with live.noting_errors():
                    live.write(buffer, mesh_object)

    def _execute(self, moved: list[LiveBinding]) -> None:
        together = [live for live in moved if live.job.strength > 0]
        if len(together) > 1:
            execution = self._free_execution(len(together))
            for place, live in enumerate(together):
                execution.poses[place], execution.controls[place] = live.job.pose, live.job.controls
            try:
                execution.run()
            except FDDAError:
                # Each says it for itself.
                together = []
            for place, live in enumerate(together):
                with live.noting_errors():
                    live.accept(execution, place)
        else:
            together = []
        for live in moved:
            if live not in together:
                with live.noting_errors():
                    live.execute()

    def _free_execution(self, count: int) -> Execution:
        """One for so many poses in which no positions lie that are still shown."""
        in_use = {id(live.execution) for live in self.members.values()}
        for execution in self._executions:
            if len(execution.poses) == count and id(execution) not in in_use:
                return execution
        self._executions = [e for e in self._executions if id(e) in in_use][-KEPT_EXECUTIONS:]
        self._executions.append(Execution(self.network, count))
        return self._executions[-1]


class Crowds:
    """The crowds of the open file.

    Attributes:
        by_hub: each by the session id of its hub.
    """

    def __init__(self) -> None:
        self.by_hub: dict[int, Crowd] = {}
        self._moved: dict[Network, set[int]] = {}

    def forget(self) -> None:
        """There is none any more."""
        self.by_hub.clear()
        self._moved.clear()

    def follow(self, lives: Mapping[int, LiveBinding], frame_changed: bool) -> int:
        """After an evaluation: let those play together that moved in this frame and the one before, and no others.

        Args:
            lives: all live bindings, by the session ids of their position buffers.
            frame_changed: whether another frame was evaluated.

        Returns:
            How many objects there are more.
        """
        before = len(self.by_hub)
        moved: dict[Network, dict[int, LiveBinding]] = {}
        for uid, live in lives.items():
            if live.was_executed:
                live.was_executed = False
                moved.setdefault(live.network, {})[uid] = live
        for hub, crowd in list(self.by_hub.items()):
            own = moved.get(crowd.network, {})
            if own and not (frame_changed and own.keys() == crowd.members.keys()):
                self._scatter(hub)
        for network, members in moved.items():
            if not frame_changed or len(members) < FEWEST:
                self._moved.pop(network, None)
            elif self._moved.get(network) != members.keys():
                self._moved[network] = set(members)
            elif not any(crowd.network is network for crowd in self.by_hub.values()):
                crowd = Crowd(network, members)
                self.by_hub[crowd.gather().session_uid] = crowd
        return len(self.by_hub) - before

    def scatter(self, member: int) -> None:
        """Let a member's crowd play one by one again."""
        for hub in [hub for hub, crowd in self.by_hub.items() if member in crowd.members]:
            self._scatter(hub)

    def _scatter(self, hub: int) -> None:
        self.by_hub.pop(hub).scatter()
        for scene_object in [o for o in bpy.data.objects if o.session_uid == hub]:
            bpy.data.objects.remove(scene_object)
