"""Launches of kernels that exist on CUDA alone: the bodies of ``kernels/cuda``, one block of threads per grid index."""

from __future__ import annotations

from typing import Any

import torch

from ..kernels.cuda.compositing import BLOCK_DIM
from ..runtime.launch import launch_blocks


def launch_native(kernel: Any, blocks: int, *args: Any, begin: int = 0) -> None:
    """Launch a kernel that exists on CUDA alone.

    Raises:
        RuntimeError: the tensors are on a CPU, where the kernel's body is empty.
    """
    device: torch.device = args[0].device
    if device.type != "cuda":
        raise RuntimeError(f"form cuda needs a GPU, got tensors on {device}")
    launch_blocks(kernel, blocks, *args, block_dim=BLOCK_DIM, begin=begin)
