"""A CUDA device that is pretended: torch, Warp and the project see ``cuda:0``, whose memory is the host's.

``python -m pytest -p pretended_cuda.plugin -k cuda`` runs the half of the tests that needs a GPU. ``device.cpp`` makes
torch believe in the device, ``torch_device`` and ``warp_device`` replace what is left of their Python interface,
``device`` loads all this, and ``ledger`` counts what the host does. docs/trust.md says what it cannot show.
"""
