"""A process that imports pycolmap as the package does, and then gets SIGTERM."""

from __future__ import annotations

import os
import signal

from scgs_warp.runtime.pycolmap_import import import_pycolmap

if __name__ == "__main__":
    import_pycolmap()
    os.kill(os.getpid(), signal.SIGTERM)
