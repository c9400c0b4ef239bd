"""Node hierarchy of a glTF file, and the nodes' world transforms at an instant of a clip. All values are float64."""

from __future__ import annotations

from typing import Any

import numpy as np

from .animation import Clip, interpolate
from .file import GltfFile


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """Convert a unit quaternion xyzw (glTF's order, not this package's) to a rotation [3, 3]."""
    x, y, z, w = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def compose(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Compose translation, rotation and scale to the matrix [4, 4], T R S."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(rotation) * scale
    matrix[:3, 3] = translation
    return matrix


class Nodes:
    """Parents and local transforms of all nodes."""

    def __init__(self, file: GltfFile) -> None:
        """
        Raises:
            UserError: a node has two parents or is its own ancestor, or a transform is malformed.
        """
        self.file = file
        self.nodes = file.document.nodes or []
        self.parent = self._parents()
        self.order = self._order()
        self.local = [self._local(index, node) for index, node in enumerate(self.nodes)]

    def _parents(self) -> list[int]:
        parent = [-1] * len(self.nodes)
        for index, node in enumerate(self.nodes):
            for child in node.children or []:
                self.file.item("nodes", child, f"nodes[{index}].children")
                if parent[child] >= 0:
                    raise self.file.error(f"nodes[{child}]", "has two parents; export the file again")
                parent[child] = index
        return parent

    def _order(self) -> list[int]:
        """Sort the nodes so that parents precede children."""
        order = [index for index, parent in enumerate(self.parent) if parent < 0]
        for index in order:  # The list grows during the iteration.
            order.extend(self.nodes[index].children or [])
        if len(order) != len(self.nodes):
            missing = min(set(range(len(self.nodes))) - set(order))
            raise self.file.error(f"nodes[{missing}]", "is its own ancestor; export the file again")
        return order

    def _local(self, index: int, node: Any) -> dict[str, np.ndarray]:
        """Return the node's local transform, given either as ``matrix`` or as ``translation``, ``rotation`` and
        ``scale``."""

        def numbers(name: str, default: list[float]) -> np.ndarray:
            value = getattr(node, name)
            array = np.asarray(default if value is None else value, np.float64)
            if array.shape != (len(default),) or not np.isfinite(array).all():
                raise self.file.error(f"nodes[{index}].{name}", f"is not {len(default)} numbers; export the file again")
            return array

        if node.matrix is not None:
            return {"matrix": numbers("matrix", [0.0] * 16).reshape(4, 4).T}
        rotation = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
        length = float(np.linalg.norm(rotation))
        if length == 0.0:
            raise self.file.error(f"nodes[{index}].rotation", "is not a rotation (all zeros); export the file again")
        translation, scale = numbers("translation", [0.0] * 3), numbers("scale", [1.0] * 3)
        return {"translation": translation, "rotation": rotation / length, "scale": scale}

    def check_clip(self, clip: Clip) -> None:
        """Raise UserError if a clip animates a node given by a matrix, because the clip could not replace parts of the
        matrix."""
        for channel in clip.channels:
            if channel.path != "weights" and "matrix" in self.local[channel.node]:
                raise self.file.error(
                    f"nodes[{channel.node}].matrix",
                    f"belongs to a node that clip {clip.name} animates; export it with translation, rotation and scale",
                )

    def drawn(self) -> list[int]:
        """Return the nodes of the file's default scene, parents first; all nodes if it has no scenes."""
        scenes = self.file.document.scenes or []
        if not scenes:
            return self.order
        index = self.file.document.scene
        scene = self.file.item("scenes", 0 if index is None else index, "scene")
        nodes = list(scene.nodes or [])
        for number in nodes:
            self.file.item("nodes", number, "scenes[].nodes")
        for number in nodes:
            nodes.extend(self.nodes[number].children or [])
        return list(dict.fromkeys(nodes))

    def world(self, clip: Clip | None, seconds: float) -> np.ndarray:
        """Return node-to-world matrices [nodes, 4, 4] at an instant of a clip, or at rest without a clip."""
        moved: dict[int, dict[str, np.ndarray]] = {}
        for channel in clip.channels if clip else []:
            if channel.path != "weights":
                value = interpolate(channel.sampler, seconds, channel.path == "rotation")
                moved.setdefault(channel.node, {})[channel.path] = value
        world = np.empty((len(self.nodes), 4, 4))
        for index in self.order:
            local = {**self.local[index], **moved.get(index, {})}
            own = local["matrix"] if "matrix" in local else compose(**local)
            parent = self.parent[index]
            world[index] = own if parent < 0 else world[parent] @ own
        return world
