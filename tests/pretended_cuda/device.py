"""Load the device, before anybody imports torch, and let the processes that are started from here load it, too."""

from __future__ import annotations

import atexit
import os
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
PLACES = [str(HERE.parent), str(HERE / "site")]
sys.path[:0] = PLACES[:1]  # as pytest's pythonpath does, but early enough

import scgs_warp  # noqa: E402, F401  (sets the environment before torch is loaded)
from pretended_cuda import build, ledger  # noqa: E402

_library = build.load()
ledger.attach(_library)

from pretended_cuda import torch_device, warp_device  # noqa: E402

torch_device.install(_library)
_folder = tempfile.TemporaryDirectory(prefix="scgs-native-")
warp_device.install(Path(_folder.name))

os.environ["SCGS_PRETENDED_CUDA"] = "1"
inherited = [place for place in os.environ.get("PYTHONPATH", "").split(os.pathsep) if place and place not in PLACES]
os.environ["PYTHONPATH"] = os.pathsep.join([*PLACES, *inherited])
# Autograd's thread for the device ends while it still holds Python objects; give it the time to let go of them.
atexit.register(time.sleep, 0.1)
