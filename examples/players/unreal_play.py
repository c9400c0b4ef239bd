"""Play a skinned .glb in the Unreal Editor (5.3 or newer, plugins Python Editor Script and Niagara).

Unreal's glTF importer takes triangles only, so this script poses the Gaussians itself and hands them to a Niagara
component in every frame, as arrays of its user parameters. The system needs, as user parameters, the arrays `Positions`
(position), `Rotations` (quaternion), `Scales` (vector) and `Colors` (colour), and an emitter of as many particles as
there are Gaussians that reads element `Execution Index` of each, drawn by the Splat Renderer where the editor has it,
or else by a mesh renderer with a sphere. Select its actor, then, in the Python console (with NumPy installed there):

    import sys; sys.path.append("examples/players")
    import unreal_play; player = unreal_play.Player("scene.glb")   # player.stop() ends
"""

from __future__ import annotations

import numpy as np
import unreal
from skinned_splats import SkinnedSplats

CENTIMETRES = 100.0


def to_unreal(means: np.ndarray, quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert from glTF (y up, right-handed, metres) to Unreal (z up, left-handed, centimetres): y and z change places,
    and rotations w, x, y, z change their sense. Rotations are returned as x, y, z, w."""
    w, x, y, z = quats.T
    return CENTIMETRES * means[:, [0, 2, 1]], np.stack([-x, -z, -y, w], 1)


class Player:
    """Player of one file on the Niagara component of the selected actor."""

    def __init__(self, path: str, speed: float = 1.0, scale: float = 1.0) -> None:
        self.splats, self.speed, self.scale, self.seconds = SkinnedSplats(path), speed, scale, 0.0
        actors = unreal.get_editor_subsystem(unreal.EditorActorSubsystem).get_selected_level_actors()
        found = [actor.get_component_by_class(unreal.NiagaraComponent) for actor in actors]
        if not any(found):
            raise RuntimeError("select an actor with a Niagara component first")
        self.component = next(component for component in found if component)
        self.arrays = unreal.NiagaraDataInterfaceArrayFunctionLibrary
        sizes = CENTIMETRES * scale * self.splats.scales[:, [0, 2, 1]]  # as the axes
        colors = zip(self.splats.colors.tolist(), self.splats.opacities.tolist())
        self.arrays.set_niagara_array_vector(
            self.component, "Scales", [unreal.Vector(*size) for size in sizes.tolist()]
        )
        self.arrays.set_niagara_array_color(
            self.component, "Colors", [unreal.LinearColor(*rgb, alpha) for rgb, alpha in colors]
        )
        self.show(0.0)
        self.ticking = unreal.register_slate_post_tick_callback(self.tick)

    def tick(self, elapsed: float) -> None:
        length = float(self.splats.seconds[-1])
        self.seconds = (self.seconds + self.speed * elapsed) % length if length > 0.0 else 0.0
        self.show(self.seconds)

    def show(self, seconds: float) -> None:
        means, quats = to_unreal(*self.splats.at(seconds))
        means = self.scale * means
        self.arrays.set_niagara_array_position(
            self.component, "Positions", [unreal.Vector(*mean) for mean in means.tolist()]
        )
        self.arrays.set_niagara_array_quat(self.component, "Rotations", [unreal.Quat(*quat) for quat in quats.tolist()])

    def stop(self) -> None:
        unreal.unregister_slate_post_tick_callback(self.ticking)
