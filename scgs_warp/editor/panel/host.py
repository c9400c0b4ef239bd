"""Interface of the editor for the sections of its panel."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from ...edit import Target
from ..frame_image import Picture
from ..model import EditorModel, Moment
from ..overlays import Overlays
from ..parts_tool import PartsTool
from ..views import ClientCamera
from ..worker import Worker


class Host(Protocol):
    """Part of the editor that the panel's sections use: the page, the model, and actions on both."""

    server: Any
    """viser's server."""
    model: EditorModel
    parts: PartsTool
    worker: Worker
    overlays: Overlays
    folder: Path
    """Folder of saved edits, films and exports."""
    edge_length: float
    """Median edge of the control graph, world units."""
    node_size: float
    """Size of a drawn control point, browser units."""

    def guarded(self, action: Callable[..., Any]) -> Callable[[Any], None]: ...
    def on_value(self, handle: Any, action: Callable[[Any], Any]) -> Any: ...
    def say(self, client: Any, title: str, text: str, color: str = "red") -> None: ...
    def put(self, target: Target) -> None: ...
    def color_overlays(self) -> None: ...
    def camera(self, client: Any) -> ClientCamera: ...
    def take_picture(self, moment: Moment, camera: ClientCamera) -> Picture: ...
