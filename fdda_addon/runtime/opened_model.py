# SPDX-License-Identifier: GPL-3.0-or-later
"""Opens a model for a rig and checks that they fit."""

from dataclasses import dataclass
from pathlib import Path

from ..core.formats.model import check_rig
from ..core.formats.model_info import ModelInfo
from ..core.rig import Rig
from ..rig.reading import read_model_rig
from ..scene.scene_rig import SceneRig
from .model_meshes import find_mesh, info_of_mesh
from .network import Network


@dataclass(frozen=True)
class OpenedModel:
    """A model and the rig that it fits.

    Attributes:
        network: the loaded model, or its view for the mesh.
        rig: the rig of the scene, with the joints, controls and unit of the model, and the skin weights of the mesh.
    """

    network: Network
    rig: Rig

    @property
    def linear_rig(self) -> Rig:
        """Return the rig with the skin weights of the model's linear skinning."""
        return self.network.linear_rig(self.rig)


def open_model(scene_rig: SceneRig, model: Path | Network) -> OpenedModel:
    """Open a model for a rig.

    Args:
        scene_rig: the rig; its modifiers are on, as they were while it was recorded. Of a model of several meshes, a
            rig of one mesh has a view for this mesh.
        model: path of the model, or the loaded model.

    Raises:
        ModelError: the model cannot be read, or was trained for another rig.
        RigError: the rig cannot be read.
    """
    network = model if isinstance(model, Network) else Network(model)
    if not scene_rig.other_meshes:
        network = network.of_mesh(find_mesh(network.path, network.info, scene_rig.mesh_object))
    return OpenedModel(network, read_matching_rig(scene_rig, network.path, network.info))


def read_matching_rig(scene_rig: SceneRig, path: Path, info: ModelInfo) -> Rig:
    """Read a rig with the joints and controls of a model, and check that the model was trained for this rig.

    Args:
        path: path of the model, for error messages.
        info: metadata of the model, or of the model for the mesh.

    Raises:
        ModelError: the model was trained for another rig.
        RigError: the rig cannot be read.
    """
    if not scene_rig.other_meshes:
        info = info_of_mesh(path, info, scene_rig.mesh_object)
    rig = read_model_rig(scene_rig, info)
    check_rig(path, info, rig)
    return rig
