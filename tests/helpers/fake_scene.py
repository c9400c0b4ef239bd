"""A scene whose render is known exactly: two shaded balls, ray traced; one circles the z axis, one rests."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from scgs_warp.data import Dataset
from scgs_warp.geometry.cameras import Overview, look_at
from scgs_warp.types import Camera, Frame, Gaussians, Image


class FakeScene:
    """The part of ``scgs_warp.scene.scene.Scene`` that apps use."""

    overview = Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0, 40.0, 20.0)
    background_color = (0.0, 0.0, 0.0)
    step = 1234
    unfinished: str | None = None
    motion_name = "control-points"
    gaussian_count = 2
    control_point_count = 32

    def __init__(self, control_points: int = 32, folder: str = "somewhere") -> None:
        self.control_point_count = control_points
        self.settings = {
            "seed": 7,
            "data": {"folder": folder, "downscale": 2, "resample": "area", "background": "black"},
        }

    @staticmethod
    def centre(time: float) -> np.ndarray:
        angle = math.pi * time
        return np.array([math.cos(angle), math.sin(angle), 0.2])

    def render(self, camera: Camera, time: float, background: object = None) -> Image:
        viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
        v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
        rgb, depth = np.zeros(rays.shape), np.full(u.shape, np.inf)
        for centre, radius, color in ((self.centre(time), 0.35, (0.9, 0.5, 0.2)), (np.zeros(3), 0.4, (0.3, 0.6, 0.9))):
            middle = viewmat[:3, :3] @ centre + viewmat[:3, 3]
            a, b = (rays**2).sum(-1), rays @ middle
            inside = b**2 - a * (middle @ middle - radius**2)
            distance = np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0.0))) / a, np.inf)
            nearer = distance < depth
            depth = np.where(nearer, distance, depth)
            points = rays * np.where(np.isfinite(distance), distance, 0.0)[..., None]
            shade = -((points - middle) / radius)[..., 2].clip(-1.0, -0.2)
            rgb[nearer] = (np.array(color) * shade[..., None])[nearer]
        alpha = np.isfinite(depth)
        planes = torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1))).float()
        found = torch.from_numpy(np.where(alpha, depth, 0.0)).float()
        return Image(planes.permute(1, 2, 0), torch.from_numpy(alpha).float(), found)

    def control_points_at(self, time: float) -> Tensor:
        index = np.arange(self.control_point_count)
        z = 1 - 2 * (index + 0.5) / max(self.control_point_count, 1)
        turn = index * 2.399963  # golden angle: even over the ball
        ring = np.sqrt(1 - z**2)
        ball = 0.3 * np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)
        return torch.from_numpy(ball + self.centre(time)).float()

    def gaussians_at(self, time: float) -> Gaussians:
        means = torch.from_numpy(np.stack([self.centre(time), np.zeros(3)])).float()
        one = torch.ones(2)
        quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4)
        return Gaussians(means, quats, 0.3 * torch.ones(2, 3), one, torch.zeros(2, 3), torch.zeros(2, 0, 3))


def fake_dataset(
    scene: FakeScene, count: int = 3, *, error: float = 0.0, size: int = 40, split: str = "test"
) -> Dataset:
    """Frames that the scene renders exactly, but for a constant ``error`` added to every pixel of the truth."""
    K = torch.tensor([[50.0, 0.0, size / 2], [0.0, 50.0, size / 2], [0.0, 0.0, 1.0]])
    frames = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        camera = Camera(look_at([4 * math.cos(angle), 4 * math.sin(angle), 1], [0, 0, 0], [0, 0, 1]), K, size, size)
        time = index / max(count - 1, 1)
        image = scene.render(camera, time)
        frames.append(Frame(camera, time, image.rgb + error, image.alpha, name=f"r_{index:03d}"))
    return Dataset(frames, folder=Path("somewhere"), split="test")


def install(monkeypatch: pytest.MonkeyPatch, scene: FakeScene) -> None:
    """Have ``Scene.load`` return this scene, or refuse a missing run."""
    from scgs_warp.errors import UserError
    from scgs_warp.scene.scene import Scene

    def load(run: str | Path, device: str = "cpu") -> FakeScene:
        if not Path(run).is_dir():
            raise UserError(f"{run}: no such run; give the folder that apps/train.py wrote")
        return scene

    monkeypatch.setattr(Scene, "load", staticmethod(load))  # on the class, which other modules have imported already
    monkeypatch.setattr("scgs_warp.scene.frame_colors.FrameColors.read", lambda folder: None)  # has no checkpoint
    monkeypatch.setattr("scgs_warp.storage.checkpoint.read", lambda folder, names: ({}, {}))
