"""A process that runs one small kernel, and prints its result."""

from __future__ import annotations

import sys

from scgs_warp.apps.cli import run


def main(args: list[str] | None) -> None:
    import torch

    from scgs_warp.ops.correctives import correct

    still = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    moved = correct(torch.ones(1, 3), torch.zeros(1, 27), still, still)
    print(f"sum {float(moved.sum()):g}")


if __name__ == "__main__":
    sys.exit(run(main))
