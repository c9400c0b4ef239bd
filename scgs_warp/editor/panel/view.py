"""Controls for the picture's content: edited, original or both, and overlays."""

from __future__ import annotations

from typing import get_args

from ..model import Show
from .host import Host


class ViewSection:
    """Content of the picture and its overlays."""

    def __init__(self, host: Host) -> None:
        self.host, self.model = host, host.model
        gui, on, unit = host.server.gui, host.on_value, host.node_size
        self.picture = on(gui.add_dropdown("Show", get_args(Show)), lambda show: self.model.set(show=show))
        self.nodes = on(gui.add_checkbox("Control points", True), self._overlays)
        self.graph = on(gui.add_checkbox("Graph", False), self._overlays)
        self.size = on(gui.add_slider("Their size", 0.1 * unit, 4 * unit, 0.05 * unit, unit), self._overlays)
        self.through = on(
            gui.add_checkbox("Seen through the surface", self.model.through, hint="Overlays in front of everything"),
            lambda through: self.model.set(through=through),
        )

    def _overlays(self, value: object) -> None:
        self.show()

    def show(self) -> None:
        self.picture.value, self.through.value = self.model.show, self.model.through
        # The browser draws overlays from one camera, for the edited scene; they would not fit other pictures.
        alone = self.model.show in ("edited", "split")
        self.host.overlays.show(alone and self.nodes.value, alone and self.graph.value, self.size.value)
