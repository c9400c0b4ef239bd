"""Scripts outside of the package, as modules."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

from helpers.paths import ROOT


def benchmark_script(name: str) -> ModuleType:
    """Import ``benchmarks/NAME.py``, whose folder stands in ``sys.path`` as when the script is run."""
    folder = str(ROOT / "benchmarks")
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module(name)
