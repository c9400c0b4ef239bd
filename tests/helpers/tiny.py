"""A tiny moving scene in memory: a swinging blob beside one at rest, seen from all around."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image as Picture

from helpers.scenes import look_at
from scgs_warp.config.presets import TrainConfig, from_dict, preset, with_steps
from scgs_warp.data.dataset import Dataset
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.motion.base import Motion, TrainingPose
from scgs_warp.rendering.render import render
from scgs_warp.types import Camera, Frame, Gaussians


def blobs(time: float) -> Gaussians:
    """Return 120 small Gaussians, half of which swing through a quarter turn."""
    generator = torch.Generator().manual_seed(7)
    means = 0.25 * torch.randn(120, 3, generator=generator)
    colors = torch.rand(120, 3, generator=generator)
    angle = 0.5 * math.pi * time
    means[:60] += 0.8 * torch.tensor([math.cos(angle), math.sin(angle), 0.3])
    means[60:] -= torch.tensor([0.3, 0.3, 0.2])
    quats = torch.zeros(120, 4)
    quats[:, 0] = 1.0
    return Gaussians(
        means,
        quats,
        torch.full((120, 3), 0.08),
        torch.full((120,), 0.9),
        (colors - 0.5) / 0.2821,
        torch.zeros(120, 0, 3),
    )


def tiny_camera(index: int, count: int, size: int) -> Camera:
    angle = 2.4 * index
    height = 1.0 + 0.5 * math.sin(1.7 * index)
    eye = torch.tensor([4 * math.cos(angle), 4 * math.sin(angle), height], dtype=torch.float64)
    viewmat = look_at(eye, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    K = torch.tensor([[1.4 * size, 0, size / 2], [0, 1.4 * size, size / 2], [0, 0, 1]])
    return Camera(viewmat.float(), K, size, size)


def tiny_dataset(count: int = 16, size: int = 48, split: str = "train") -> Dataset:
    """``count`` frames of size x size with alpha, on black."""
    frames = []
    for i in range(count):
        time = i / max(count - 1, 1)
        camera = tiny_camera(i if split == "train" else i + 100, count, size)
        with torch.no_grad():
            image = render(blobs(time), camera, torch.zeros(3))
        frames.append(Frame(camera, time, image.rgb.clamp(0, 1), image.alpha, None, f"{split}_{i:03d}"))
    return Dataset(frames, folder=Path("tiny"), split=split)


def tiny_config(steps: int = 60, **changes) -> TrainConfig:
    """The cpu preset compressed to a few steps, with a small network."""
    base = with_steps(preset("cpu"), steps)
    small = {
        "init_points": 300,
        "half_size": 0,
        "checkpoint_seconds": 1e9,
        "motion": {"nodes": 16, "layers": 3, "width": 32, "skip": 2},
        "densify": {"every": 10, "start": 10, "opacity_reset_every": 10_000, "sh_every": 20},
        "pretrain": {"densify_every": 3},
    }
    return from_dict(changes, "test", from_dict(small, "test", base))


def trained_pose(
    motion: Motion, gaussians: GaussianParameters, time: float, step: int, config: TrainConfig
) -> TrainingPose:
    """Pose the Gaussians as a training step does."""
    plan = motion.plan(gaussians, time, step, config)
    return motion.train_at(gaussians, plan, torch.tensor(plan.times), plan.weight, config)


def write_dnerf(folder: Path, size: int = 48) -> Path:
    """The tiny scene as a D-NeRF folder: 8 frames to train, 3 to test."""
    for split, count in (("train", 8), ("test", 3)):
        data = tiny_dataset(count, size, split)
        (folder / split).mkdir(parents=True)
        frames = []
        for frame in data:
            alpha = frame.alpha.numpy()[:, :, None]
            color = frame.image.numpy() / np.maximum(alpha, 1e-3)
            pixels = (np.concatenate([color, alpha], 2).clip(0, 1) * 255 + 0.5).astype(np.uint8)
            Picture.fromarray(pixels, "RGBA").save(folder / split / f"{frame.name}.png")
            pose = np.linalg.inv(frame.camera.viewmat.double().numpy()) @ np.diag([1.0, -1, -1, 1])
            frames.append(
                {"file_path": f"./{split}/{frame.name}", "time": frame.time, "transform_matrix": pose.tolist()}
            )
        focal = float(data[0].camera.K[0, 0])
        angle = 2 * np.arctan(0.5 * size / focal)
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text)
    return folder
