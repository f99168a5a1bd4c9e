# SPDX-License-Identifier: GPL-3.0-or-later
"""A model that is opened for a rig: its network, and the rig as the model sees it."""

from dataclasses import dataclass
from pathlib import Path

from ..core.model import ModelInfo, check_rig
from ..core.rig import Rig
from ..rig.reading import read_model_rig
from ..scene.scene_rig import SceneRig
from .network import Network


@dataclass(frozen=True)
class OpenedModel:
    """A model and a rig that fit each other.

    Attributes:
        network: of the model.
        rig: that of the scene, with joints, controls and unit of the model, and the skin weights that its mesh has.
    """

    network: Network
    rig: Rig

    @property
    def linear_rig(self) -> Rig:
        """The rig with the skin weights of the model's linear skinning."""
        return self.network.linear_rig(self.rig)


def open_model(scene_rig: SceneRig, model: Path | Network) -> OpenedModel:
    """Open a model for a rig.

    Args:
        scene_rig: the rig; all that deforms it as it was when it was recorded.
        model: the file, or what was loaded of it.

    Raises:
        ModelError: it cannot be read, or was trained for another rig.
        RigError: the rig cannot be read.
    """
    network = model if isinstance(model, Network) else Network(model)
    return OpenedModel(network, fitting_rig(scene_rig, network.path, network.info))


def fitting_rig(scene_rig: SceneRig, path: Path, info: ModelInfo) -> Rig:
    """Read a rig as a model sees it, which says so much of itself.

    Raises:
        ModelError: the model was trained for another rig.
        RigError: the rig cannot be read.
    """
    rig = read_model_rig(scene_rig, info)
    check_rig(path, info, rig)
    return rig
