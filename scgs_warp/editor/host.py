"""Interface of the editor for what pages ask for (``actions``, ``exports``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from ..edit import EditSession
from .gizmo_pose import GizmoFrame
from .jobs import Jobs
from .model import EditorModel
from .parts_tool import PartsTool
from .worker import Worker


class Host(Protocol):
    """Part of the editor that requests use."""

    session: EditSession
    model: EditorModel
    parts: PartsTool
    worker: Worker
    jobs: Jobs
    folder: Path
    """Folder of saved edits, films and exports."""
    title: str
    held: tuple[GizmoFrame, tuple[Any, Any]] | None
    """Frame and pose of the handle that is dragged; None: a part is."""
