"""Points that come with the data: files of them read, and what training makes of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.nerfstudio_files import COLORS, POINTS, rewrite, save, write, write_ply
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.data import load
from scgs_warp.data.points import read_ply, unit_colors
from scgs_warp.errors import UserError
from scgs_warp.gaussians import SH_C0
from scgs_warp.training.frames import Frames
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step


def raw_ply(path: Path, rows: list[str], kinds: str, count: str | None = None, form: str = "ascii") -> Path:
    """``kinds``: the types of x, y, z and red, green, blue, as many as there are in a row."""
    names = ("x", "y", "z", "red", "green", "blue")
    lines = [f"property {kind} {name}" for kind, name in zip(kinds.split(), names)]
    head = ["ply", f"format {form} 1.0", f"element vertex {len(rows) if count is None else count}", *lines]
    path.write_text("\n".join([*head, "end_header", *rows]) + "\n")
    return path


def test_points_beyond_float32_are_left_out(tmp_path):
    path = raw_ply(tmp_path / "a.ply", ["1e300 0 0", "0 -1e39 0", "1 2 3", "inf 0 0"], "double double double")
    assert read_ply(path)[0].tolist() == [[1.0, 2.0, 3.0]]
    folder = tmp_path / "scene"
    content = write(folder)
    rows = [*(" ".join(map(str, [*point, *color])) for point, color in zip(POINTS, COLORS)), "3e38 0 0 9 9 9"]
    raw_ply(folder / "points.ply", rows, "double double double uchar uchar uchar")
    shift = np.array([[1.0, 0.0, 0.0, 3.0], [0.0, 1.0, 0.0, -5.0], [0.0, 0.0, 1.0, 2.0]])
    for entry in content["frames"]:
        pose = np.array(entry["transform_matrix"])
        pose[:3, 3] = 10.0 * (pose[:3, 3] + shift[:, 3])
        entry["transform_matrix"] = pose.tolist()
    save(folder, {**content, "applied_transform": shift.tolist(), "applied_scale": 10.0})
    data = load(folder)
    assert data.points.shape == data.colors.shape == (60, 3) and data.points.isfinite().all()


@pytest.mark.parametrize(
    ("kind", "rows", "expected"),
    [
        ("float", ["0 0 0 0.5 nan 1", "0 0 0 inf 0 0.25"], [[0.5, 0.5, 1.0], [0.5, 0.0, 0.25]]),
        ("float", ["0 0 0 51 nan 255", "0 0 0 0 -3 0.255"], [[0.2, 0.5, 1.0], [0.0, 0.0, 0.001]]),
        ("double", ["0 0 0 nan nan nan"], [[0.5, 0.5, 0.5]]),
        ("ushort", ["0 0 0 0 13107 65535"], [[0.0, 0.2, 1.0]]),
    ],
)
def test_colours_of_points_are_shares(tmp_path, kind, rows, expected):
    path = raw_ply(tmp_path / "a.ply", rows, f"float float float {kind} {kind} {kind}")
    np.testing.assert_allclose(read_ply(path)[1], expected, rtol=1e-6)


def test_colours_of_gaussians_are_those_of_degree_0():
    """c = 1/2 + f / (2 sqrt(pi)), and grey where f is none."""
    vertices = np.zeros(2, [(f"f_dc_{channel}", np.float32) for channel in range(3)])
    vertices[0], vertices[1] = (0.0, 1.0, -1.0), (np.nan, 9.0, -9.0)
    found = unit_colors(vertices)
    share = 0.5 / np.sqrt(np.pi)
    np.testing.assert_allclose(found, [[0.5, 0.5 + share, 0.5 - share], [0.5, 1.0, 0.0]], rtol=1e-6)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", ["1000000000000000", "1" + "0" * 30, "-3", "many", "9" * 5000])
def test_absurd_counts_of_points_are_told(tmp_path, count, form):
    path = raw_ply(tmp_path / "a.ply", ["1 2 3"], "float float float", count, form)
    with pytest.raises(UserError, match=r"a\.ply: .*; export the points again"):
        read_ply(path)


def test_points_without_colours_and_bad_ones(tmp_path):
    write_ply(tmp_path / "a.ply", np.array([[0.0, 1.0, 2.0], [np.nan, 0.0, 0.0]]), None)
    points, colors = read_ply(tmp_path / "a.ply")
    assert points.tolist() == [[0.0, 1.0, 2.0]] and colors is None
    (tmp_path / "b.ply").write_bytes(b"\x00\x01nothing")
    with pytest.raises(UserError, match="no PLY file"):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize(("count", "neighbors"), [(0, 4), (1, 4), (3, 4), (9, 4), (10, 4), (12, 12), (13, 12)])
def test_a_handful_of_points_is_none(tmp_path, count, neighbors):
    """A Gaussian needs as many control points as move it, and those begin as a sample of the points."""
    write(tmp_path)
    write_ply(tmp_path / "points.ply", POINTS[:count], COLORS[:count])
    data = load(tmp_path)
    config = tiny_config(20, motion={"neighbors": neighbors})
    state = TrainState.begin(config, data, "cpu")
    assert state.stage == ("main" if count in (10, 13) else "pretrain")
    frames = Frames(data, state.normalisation, state.config, "cpu")
    assert training_step(state, frames).failed is None
    if state.stage == "pretrain":
        state.begin_main()
        state.step = state.config.pretrain_steps
        assert training_step(state, frames).failed is None


@pytest.mark.parametrize(
    "changes",
    [{"pretrain": {"start_ratio": 80.0}}, {"densify": {"max_gaussians": 100}}, {"motion": {"model": "static"}}],
    ids=["spheres", "cap", "neither"],
)
def test_the_backdrop_is_seen_by_all_frames(tmp_path, changes):
    """Also where more points are drawn than Gaussians begin with."""
    write(tmp_path)
    rewrite(tmp_path, lambda index, image: np.full_like(image, 10 + 10 * index))
    data = load(tmp_path)
    config = tiny_config(20, **changes)
    count = min(config.init_points, config.densify.max_gaussians)
    gaussians = TrainState.begin(config, data, "cpu").gaussians
    assert len(gaussians) == count
    greys = (gaussians.sh_dc.detach()[len(data.points) :, 0] * SH_C0 + 0.5) * 255
    frames, own = greys.round().unique(return_counts=True)
    expected = {int(10 + 10 * int(frame.name[2:])) for frame in data}
    assert len(set(frames.int().tolist()) & expected) > 0.8 * len(expected)
    assert int(own.max()) < 5 * (count - len(data.points)) / len(data)


def test_what_the_data_offers_decides(tmp_path):
    """Points: no first stage, control points among them. No alpha: walls may be large, what rests is told apart."""
    write(tmp_path)
    data = load(tmp_path)
    config = tiny_config(20, flow_points=0, motion={"hyper_dim": 0})
    state = TrainState.begin(config, data, "cpu")
    assert state.stage == "main" and state.config.pretrain_steps == 0
    assert (state.config.densify.prune_large, state.config.motion.hyper_dim) == ("never", 1)
    rest, points = state.motion.positions.detach(), state.normalisation.apply(data.points)
    assert torch.cdist(rest, points).amin(1).max() < 5e-3
    assert torch.cdist(points, state.gaussians.means.detach()).amin(1).max() < 5e-3
    assert len(state.gaussians) == config.init_points > len(points)
    behind = state.gaussians.means.detach()[len(points) :]
    for frame in data:  # all but those at the rim lie where cameras look
        camera = state.normalisation.apply_camera(frame.camera)
        depths = behind @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        assert depths.min() > 0
    asked = dataclasses.replace(config, pretrain=dataclasses.replace(config.pretrain, with_points=True))
    assert TrainState.begin(asked, data, "cpu").stage == "pretrain"
    kept = TrainState.begin(config, tiny_dataset(4), "cpu").config
    assert kept.pretrain_steps > 0 and (kept.densify.prune_large, kept.motion.hyper_dim) == ("always", 0)
