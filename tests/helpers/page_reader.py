"""Reader and player of a page's data in Python, as docs/page.md describes the format."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scgs_warp.export.page_data import unpack
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Pose


def read_page(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Facts and columns of a page's embedded data."""
    text = path.read_text(encoding="utf-8")
    found = re.findall(r'<script class="data" type="text/plain">([^<]*)</script>', text)
    assert found, "the page holds its data"
    return unpack(b"".join(map(base64.b64decode, found)))


def stack(columns: dict[str, np.ndarray], *names: str) -> torch.Tensor:
    return torch.from_numpy(np.stack([columns[name] for name in names], axis=1)).float()


def quaternions(columns: dict[str, np.ndarray]) -> torch.Tensor:
    others = np.stack([columns[f"quat{k}"] for k in range(3)], axis=1)
    largest = columns["quat_largest"].astype(int)
    quats = np.zeros((len(others), 4))
    rows = np.arange(len(others))
    quats[rows, largest] = np.sqrt(np.maximum(1.0 - (others**2).sum(axis=1), 0.0))
    for k in range(3):
        quats[rows, (largest + 1 + k) % 4] = others[:, k]
    return torch.from_numpy(quats).float()


def gaussians_of(facts: dict[str, Any], columns: dict[str, np.ndarray]) -> GaussianParameters:
    """The page's Gaussians as parameters, normalised units."""
    rest = (facts["sh_degree"] + 1) ** 2 - 1
    flags = int(facts["masked"]), facts["shaded"], facts.get("corrected", False)
    made = GaussianParameters.empty(facts["gaussians"], rest, *flags, "cpu", facts.get("sharpness", 0.0))
    with torch.no_grad():
        made.means.copy_(stack(columns, "mean0", "mean1", "mean2"))
        made.quats.copy_(quaternions(columns))
        made.log_scales.copy_(stack(columns, "scale0", "scale1", "scale2"))
        made.opacity_logits.copy_(torch.logit(stack(columns, "opacity")[:, 0], 1e-6))
        made.sh_dc.copy_(stack(columns, "dc0", "dc1", "dc2"))
        for k in range(rest):
            made.sh_rest[:, k] = stack(columns, *(f"sh{k}_{c}" for c in range(3)))
        if facts["shaded"]:
            made.shading.copy_(stack(columns, *(f"shading{k}" for k in range(10))))
        if facts.get("corrected"):
            made.correctives.copy_(stack(columns, *(f"corrective{k}" for k in range(27))))
        if facts["masked"]:
            made.hyper.copy_(torch.logit(stack(columns, "share"), 1e-6))
    return made


def binding_of(facts: dict[str, Any], columns: dict[str, np.ndarray]) -> tuple[torch.Tensor, torch.Tensor]:
    K = facts["neighbors"]
    indices = stack(columns, *(f"node{k}" for k in range(K))).int()
    others = torch.zeros(len(indices), 0) if K == 1 else stack(columns, *(f"weight{k}" for k in range(1, K)))
    return indices, torch.cat([1 - others.sum(1, keepdim=True), others], 1)


def pose_of(facts: dict[str, Any], columns: dict[str, np.ndarray], time: float) -> Pose:
    """Between two sampled times, in proportion; rotations are brought to unit length after that."""
    count, at = facts["samples"], time * (facts["samples"] - 1)
    first = min(int(at), count - 2)
    share = at - first

    def blend(name: str, width: int) -> torch.Tensor:
        table = stack(columns, *(f"{name}{a}" for a in range(width))).reshape(-1, count, width)
        return (1 - share) * table[:, first] + share * table[:, first + 1]

    unit = torch.nn.functional.normalize
    return Pose(
        blend("translation", 3),
        unit(blend("rotation", 4), dim=-1),
        unit(blend("shape", 4), dim=-1) if facts["shapes"] else None,
        blend("log_scale", 3) if facts["scaled"] else None,
        blend("tint", 3) if facts["tinted"] else None,
    )


class PagePlayer:
    """Renderer of a page's data by the project's own kernels."""

    def __init__(self, scene: Scene, facts: dict[str, Any], columns: dict[str, np.ndarray]) -> None:
        self.scene, self.facts, self.columns = scene, facts, columns
        self.gaussians = gaussians_of(facts, columns)

    @torch.no_grad()
    def render(self, camera: Any, time: float, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Any:
        from scgs_warp.rendering.render import render

        scene, posed = self.scene, self.gaussians.activate()
        if self.facts["nodes"]:
            pose, binding = pose_of(self.facts, self.columns, time), binding_of(self.facts, self.columns)
            posed = scene.motion.apply_pose(self.gaussians, pose, binding)  # type: ignore[operator]
        view = scene.normalisation.apply_camera(camera)
        return render(posed, view, torch.tensor(background), antialiased=scene.config.antialiased)
