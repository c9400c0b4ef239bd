"""``.4dgs`` files, read back by the format's own reference implementation (package fourdgs)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene, tinted_scene
from scgs_warp.edit import EditSession
from scgs_warp.errors import UserError
from scgs_warp.export import segments as parts
from scgs_warp.export.moments import even_moments
from scgs_warp.export.moving import export_fourdgs
from scgs_warp.export.segments import Course, segments
from scgs_warp.export.skeleton import extent_of
from scgs_warp.gaussians import SH_C0
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Gaussians

FPS = 20.0


def everything(scene: Scene) -> np.ndarray:
    return np.ones(len(scene.gaussians), bool)


def written(path: Path, scene: Scene, frames: int, usable: np.ndarray | None = None) -> Any:
    """The file as the reference implementation decodes it, after its validator found no fault."""
    file = pytest.importorskip("fourdgs.keyframe_delta_file", reason="the package fourdgs is not installed")
    from fourdgs.validate import validate

    usable = everything(scene) if usable is None else usable
    export_fourdgs(path, scene, None, even_moments(frames, FPS), usable)
    data = path.read_bytes()
    assert validate(data).findings == []
    return file, file.decode_streamed(data)


def matched(found: dict, truth: Gaussians) -> np.ndarray:
    """Rows of the truth for the decoded Gaussians, whose order is the file's own."""
    away = np.linalg.norm(found["centers"][:, None] - truth.means.detach().double().numpy()[None], axis=2)
    rows = away.argmin(1)
    assert sorted(rows) == list(range(len(rows)))
    return rows


def test_the_reference_implementation_sees_the_scene(tmp_path):
    scene, frames = bar_scene(nodes=24, gaussians=200), 41
    with torch.no_grad():
        scene.gaussians.log_scales += torch.tensor([0.6, 0.0, -0.8])
    file, decoded = written(tmp_path / "a.4dgs", scene, frames)
    assert decoded.header.duration_sec == pytest.approx(2.0) and decoded.header.sh_degree == 3
    start = scene.gaussians_at(0.0)
    extent = extent_of(start.means.numpy())
    rows = matched(file.render_at(decoded, 0.0), start)
    for frame in (0, 7, 31, 32, 39):
        truth = scene.gaussians_at(frame / (frames - 1))
        found = file.render_at(decoded, frame / FPS + 1e-9)
        np.testing.assert_array_equal(found["ids"], np.arange(200))
        off = np.abs(found["centers"] - truth.means.double().numpy()[rows]).max()
        assert off < 1.8 * parts.POSITION * extent
        rgb = 0.5 + SH_C0 * truth.sh_dc.detach().numpy()[rows]
        assert np.abs(found["rgb"] - rgb.clip(0, 1)).max() < 0.6 / 255
        assert np.abs(found["opacity"] - truth.opacities.detach().numpy()[rows]).max() < 0.6 / 255
        assert np.abs(np.log(found["scales"] / truth.scales.detach().numpy()[rows])).max() < 0.011
        quats = truth.quats.detach().double().numpy()[rows][:, [1, 2, 3, 0]]
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        degrees = 2 * np.degrees(np.arccos(np.abs((quats * found["rotations"]).sum(1)).clip(0, 1)))
        spread = truth.scales.detach().double().numpy()[rows]
        longer = (spread.max(1) - spread.min(1)) / extent
        rounding = 0.0036 * longer  # three components, each half a step of 2 / 1023 off, twice as an angle
        assert (np.radians(degrees) * longer - rounding).max() < 1.1 * parts.TURN
    between = file.render_at(decoded, 10.5 / FPS)["centers"]
    truth = scene.gaussians_at(10.5 / (frames - 1)).means.double().numpy()[rows]
    assert np.abs(between - truth).max() < 2.5 * parts.POSITION * extent


def test_harmonics_are_kept(tmp_path):
    scene = bar_scene(nodes=12, gaussians=60)
    file, decoded = written(tmp_path / "a.4dgs", scene, 3)
    rows = matched(file.render_at(decoded, 0.0), scene.gaussians_at(0.0))
    from fourdgs import opcode, serialization

    bands = {}
    for record in serialization.iter_records((tmp_path / "a.4dgs").read_bytes(), 8):
        if record.opcode == opcode.SH_BAND_STREAM:
            cursor = serialization.Cursor(record.content)
            band = cursor.u8()
            bands[band] = serialization.decode_stream(cursor)[1]
    codes = [bands[b].reshape(60, 3, 2 * b + 1).transpose(0, 2, 1) for b in (1, 2, 3)]
    found = -4 + np.concatenate(codes, 1) * 8 / 255
    truth = scene.gaussians.sh_rest.detach().numpy()[rows]
    assert np.abs(found - truth).max() < 0.51 * 8 / 255


def test_colours_that_change_are_followed(tmp_path):
    scene = tinted_scene(nodes=12, gaussians=60)
    file, decoded = written(tmp_path / "a.4dgs", scene, 9)
    rows = matched(file.render_at(decoded, 0.0), scene.gaussians_at(0.0))
    for frame in (0, 4, 7):
        truth = 0.5 + SH_C0 * scene.gaussians_at(frame / 8).sh_dc.detach().numpy()[rows]
        found = file.render_at(decoded, frame / FPS + 1e-9)["rgb"]
        assert np.abs(found - truth.clip(0, 1)).max() < 1.5 * 2 * parts.COLOR


def test_what_stands_still_costs_one_segment_a_keyframe():
    seconds = np.arange(9) / FPS
    means = np.zeros((9, 3, 3), np.float32)
    means[:, 1, 0] = seconds  # a straight line
    means[:, 2, 0] = np.sin(4 * seconds)
    quats = np.tile([1.0, 0, 0, 0], (9, 3, 1))
    course = Course(seconds, means, quats, np.ones((9, 3, 3)), np.ones((9, 3, 3)), 1.0)
    counts = np.zeros(3, int)
    for piece in segments(course, 4):
        counts[piece.rows] += 1
        line = piece.starts + piece.velocities / FPS
        assert np.abs(line - means[piece.frame + 1, piece.rows]).max() <= parts.POSITION + 1e-7
    assert counts[0] == counts[1] == 2 and 2 < counts[2] <= 8


def test_the_same_scene_gives_the_same_bytes_and_faults_are_told(tmp_path):
    scene = bar_scene(nodes=12, gaussians=60)
    usable = everything(scene)
    usable[5] = False
    for name in ("a", "b"):
        said = export_fourdgs(tmp_path / f"{name}.4dgs", scene, None, even_moments(4, FPS), usable)
        assert said.startswith("59 Gaussians in ")
    assert (tmp_path / "a.4dgs").read_bytes() == (tmp_path / "b.4dgs").read_bytes()
    with pytest.raises(UserError, match="--frames 2"):
        export_fourdgs(tmp_path / "c.4dgs", scene, None, even_moments(1, FPS), usable)


def test_what_is_clipped_is_counted(tmp_path):
    scene = bar_scene(nodes=12, gaussians=60)
    with torch.no_grad():
        scene.gaussians.sh_dc.clamp_(-1.0, 1.0)
    arguments = scene, None, even_moments(3, FPS), everything(scene)
    assert "clipped" not in export_fourdgs(tmp_path / "a.4dgs", *arguments)
    with torch.no_grad():
        scene.gaussians.sh_dc[7] = torch.tensor([2.0, 0.0, -2.0])
        scene.gaussians.sh_rest[9, 4, 1] = 4.5
    assert "(3 values clipped to what .4dgs can hold)" in export_fourdgs(tmp_path / "a.4dgs", *arguments)


def test_a_gaussian_that_an_edit_moved_too_far_asks_for_less_of_the_edit(tmp_path):
    session = EditSession(bar_scene(nodes=12, gaussians=60))
    session.add_handle([0, 1, 2], time=0.0, name="end")
    session.pin_rest(1)
    session.move("end", translation=(1e8, 0.0, 0.0))
    with pytest.raises(UserError, match="too far away for the format; move it less far if an edit put it there"):
        export_fourdgs(tmp_path / "a.4dgs", session.scene, session, even_moments(2, FPS), everything(session.scene))


def test_scales_that_have_vanished_are_written(tmp_path):
    scene = bar_scene(nodes=12, gaussians=60)
    with torch.no_grad():
        scene.gaussians.log_scales[:20, 0] = -200.0
    assert (scene.gaussians_at(0.0).scales == 0.0).sum() == 20
    file, decoded = written(tmp_path / "a.4dgs", scene, 3)
    assert len(file.render_at(decoded, 0.0)["centers"]) == 60
