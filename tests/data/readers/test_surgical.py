"""Films of operations in the layout of EndoNeRF: masks of tools, depth by stereo, axes that are not LLFF's."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.foreign_scenes import COUNT, HEIGHT, OPENGL, WIDTH, K, wall
from scgs_warp.data import load

UNIT = 20
"""Values of the maps per unit of the wall's world."""


def write(folder: Path, kind: type = np.uint8) -> None:
    made, rows = wall(), []
    for index, viewmat in enumerate(made.viewmats):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:12, :16] = 255 * (index > 0)
        depth = np.rint(made.depths[index] * UNIT).astype(kind)
        depth[-4:] = 0
        for place, end, image in (("images", "color", made.images[index][..., ::-1]), ("masks", "mask", mask),
                                  ("depth", "depth", depth)):  # fmt: skip
            (folder / place).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / place / f"frame-{index:06d}.{end}.png"), image)
        pose = np.linalg.inv(viewmat) @ OPENGL
        pose[:3, 3] *= UNIT
        size = np.array([[HEIGHT], [WIDTH], [K[0, 0]]])
        rows.append([*np.concatenate([pose[:3], size], axis=1).ravel(), 2.0 * UNIT, 5.0 * UNIT])
    np.save(folder / "poses_bounds.npy", rows)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_tools_are_masked_and_depth_is_read(tmp_path, kind):
    write(tmp_path, kind)
    made, data = wall(), load(tmp_path)
    assert len(data) == COUNT - 1 and data.with_depth == [*range(len(data))]
    for frame in data:
        index = int(frame.name[6:12])
        np.testing.assert_allclose(frame.camera.viewmat[:3, :3], made.viewmats[index][:3, :3], atol=1e-6)
        assert frame.mask is not None
        assert frame.mask[:12, :16].any() == (index == 0) and frame.mask[12:].all() and frame.mask[:, 16:].all()
        depth = data.depth([entry.name for entry in data.entries].index(frame.name))
        assert depth is not None and not depth[-4:].any()
        np.testing.assert_allclose(depth[:-4], made.depths[index][:-4] * UNIT, atol=0.5)
    assert data.points is not None
    assert float((data.points[:, 1] / UNIT - 3.0).abs().max()) < 0.1  # the wall


def test_masks_of_the_scene_instead_of_the_tools_are_noted(tmp_path):
    write(tmp_path)
    assert not load(tmp_path).notes
    for file in (tmp_path / "masks").iterdir():
        mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        cv2.imwrite(str(file), 255 - mask if mask.any() else mask)
    assert "invert them if white is the scene" in load(tmp_path).notes[0]


def test_without_depth_it_is_a_film_of_llff(tmp_path):
    write(tmp_path)
    for file in (tmp_path / "depth").iterdir():
        file.unlink()
    data = load(tmp_path)
    assert data[0].mask is None and not data.with_depth and data.points is None
