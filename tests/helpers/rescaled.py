"""The same scene in other units: scaled and shifted, in memory and as a data set on disk."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from scgs_warp.data.dataset import Dataset
from scgs_warp.types import Camera

VARIANTS = {"0.01": (0.01, (0.0, 0.0, 0.0)), "100": (100.0, (0.0, 0.0, 0.0)), "+50": (1.0, (50.0, 50.0, 50.0))}
"""Factor and shift of the un-normalised scenes that must train like the original."""


def rescale_camera(camera: Camera, scale: float, shift: Sequence[float]) -> Camera:
    """The camera that sees the world ``scale x + shift`` as ``camera`` sees x; kept in float32, as cameras are."""
    viewmat = camera.viewmat.double()
    viewmat[:3, 3] = scale * viewmat[:3, 3] - viewmat[:3, :3] @ torch.tensor(shift, dtype=torch.float64)
    return Camera(viewmat.float(), camera.K, camera.width, camera.height)


def rescale_dataset(data: Dataset, scale: float, shift: Sequence[float]) -> Dataset:
    """``data`` with its cameras and points in the other units."""
    frames = [dataclasses.replace(frame, camera=rescale_camera(frame.camera, scale, shift)) for frame in data]
    points = None if data.points is None else data.points * scale + torch.tensor(shift)
    return Dataset(frames, folder=data.folder, split=data.split, background=data.background, points=points)


def rescale_folder(folder: Path, output: Path, scale: float, shift: Sequence[float]) -> Path:
    """A copy of a data set in D-NeRF layout in the other units; images are linked, the true motion follows."""
    output.mkdir(parents=True)
    for split in ("train", "test"):
        os.symlink((folder / split).resolve(), output / split)
        content = json.loads((folder / f"transforms_{split}.json").read_text())
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"], np.float64)
            matrix[:3, 3] = scale * matrix[:3, 3] + np.array(shift)
            frame["transform_matrix"] = matrix.tolist()
        (output / f"transforms_{split}.json").write_text(json.dumps(content))
    truth = folder / "ground_truth.npz"
    if truth.is_file():
        with np.load(truth) as archive:
            content = dict(archive)
        content["points"] = (scale * content["points"].astype(np.float64) + np.array(shift)).astype(np.float32)
        content["height"] = np.float32(scale * content["height"])
        np.savez(output / truth.name, **content)
    return output
