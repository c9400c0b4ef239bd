"""A data set larger than memory trains: images stream from disk, and what is kept of them is bounded."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.tiny import blobs, tiny_camera
from scgs_warp.rendering.render import render

FRAMES, SIZE, STEPS = 5_000, 800, 3_000
MEMORY_MIB = 4096

MEASURED = """
import resource, sys
from scgs_warp.apps import train
status = train.cli(sys.argv[1:])
print("peak MiB", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
sys.exit(status)
"""


def write_frames(folder: Path, split: str, count: int) -> None:
    """Distinct RGBA images of the tiny scene, rendered at a quarter of their size and enlarged."""
    (folder / split).mkdir(parents=True)
    small, entries = SIZE // 4, []
    for index in range(count):
        camera, time = tiny_camera(index + (100 if split == "test" else 0), count, small), index / (count - 1)
        with torch.no_grad():
            image = render(blobs(time), camera, torch.zeros(3))
        color = image.rgb / image.alpha.clamp_min(1e-3)[..., None]
        rgba = torch.cat([color.flip(-1), image.alpha[..., None]], -1).clamp(0, 1) * 255
        pixels = cv2.resize(rgba.byte().numpy(), (SIZE, SIZE))
        assert cv2.imwrite(str(folder / split / f"{index:05d}.png"), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        pose = np.linalg.inv(camera.viewmat.double().numpy()) @ np.diag([1.0, -1, -1, 1])
        entries.append({"file_path": f"{split}/{index:05d}", "time": time, "transform_matrix": pose.tolist()})
    text = {"camera_angle_x": 2 * float(np.arctan(0.5 / 1.4)), "frames": entries}
    (folder / f"transforms_{split}.json").write_text(json.dumps(text))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="peak memory as Linux counts it")
def test_five_thousand_frames_within_four_gibibytes(tmp_path):
    """More pictures are seen than the cache holds, so memory would grow on if it could."""
    data = tmp_path / "many"
    write_frames(data, "train", FRAMES)
    write_frames(data, "test", 4)
    options = ["--data", str(data), "--output", str(tmp_path / "run"), "--preset", "quick", "--steps", str(STEPS)]
    command = [sys.executable, "-c", MEASURED, *options, "--device", "cpu", "--max-gaussians", "5000"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    peak = int(done.stdout.rsplit("peak MiB", 1)[1])
    print(f"peak {peak} MiB for {FRAMES} frames of {SIZE} x {SIZE}, {STEPS} steps")
    assert json.loads((tmp_path / "run/metrics.json").read_text())["psnr"] > 25.0
    assert peak < MEMORY_MIB
