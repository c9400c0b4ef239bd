"""Rods that are broken, transparent or swollen are found; what hides a rod does not count."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.fake_scene import FakeScene
from scgs_warp.data import Dataset, load
from scgs_warp.data.synthetic.from_mesh import SynthesisRequest, plan_synthesis, synthesize
from scgs_warp.data.synthetic.orbit_cameras import FilmingSettings
from scgs_warp.errors import UserError
from scgs_warp.evaluation.evaluate import metrics_of
from scgs_warp.evaluation.thin_structures import RodCheck, Rods, Segment, load_rods, measure
from scgs_warp.geometry.cameras import look_at
from scgs_warp.types import Camera, Frame, Image

SIZE, FOCAL, SAMPLES = 120, 130.0, 4
CAMERA = Camera(
    look_at([0, -4, 0], [0, 0, 0], [0, 0, 1]),
    torch.tensor([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]]),
    SIZE,
    SIZE,
)
ENDS = np.array(
    [
        [[-1.0, 0.0, 0.5], [1.0, 0.0, 0.9]],  # across the image
        [[-0.8, -1.2, -0.4], [0.9, 2.0, -0.6]],  # away from the camera
        [[-0.5, 0.0, -1.0], [0.2, 0.0, -1.2]],
    ]
)
RADII = np.array([0.02, 0.03, 0.015])
KNOWN = np.ones((SIZE, SIZE), bool)

Keep = Callable[[int, np.ndarray], np.ndarray]


def draw(ends: np.ndarray = ENDS, keep: Keep = lambda rod, share: share >= 0, shift: float = 0.0) -> np.ndarray:
    """Cast rays at the rods: alpha [H, W] of the parts that ``keep`` chooses by rod and share of the length."""
    fine = (np.arange(SIZE * SAMPLES) + 0.5) / SAMPLES
    x, y = np.meshgrid(fine - shift, fine - shift)
    rays = np.stack([(x - SIZE / 2) / FOCAL, (y - SIZE / 2) / FOCAL, np.ones_like(x)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    viewmat = CAMERA.viewmat.double().numpy()
    hit = np.zeros(x.shape, bool)
    for rod, (start, end) in enumerate(ends @ viewmat[:3, :3].T + viewmat[:3, 3]):
        axis = end - start
        # The point of the axis nearest to the ray, for a ray through the origin.
        across = (rays @ axis)[..., None] * rays
        flat, from_start = axis - across, start - (rays @ start)[..., None] * rays
        share = (-(from_start * flat).sum(-1) / (flat * flat).sum(-1)).clip(0.0, 1.0)
        near = np.linalg.norm(from_start + share[..., None] * flat, axis=-1) <= RADII[rod]
        hit |= near & keep(rod, share)
    return hit.reshape(SIZE, SAMPLES, SIZE, SAMPLES).mean((1, 3))


def sections(rendered: np.ndarray, truth: np.ndarray, ends: np.ndarray = ENDS, known: np.ndarray = KNOWN):
    return measure(rendered, truth, known, CAMERA, ends, RADII)


def test_the_truth_is_sound_everywhere() -> None:
    found = sections(draw(), draw())
    assert [(s.rod, s.tenth) for s in found] == [(rod, tenth) for rod in range(3) for tenth in range(10)]
    assert {s.ratio for s in found} == {1.0}


def test_a_rod_that_is_a_pixel_off_keeps_its_sums() -> None:
    assert max(abs(s.ratio - 1) for s in sections(draw(shift=0.8), draw()) if 0 < s.tenth < 9) < 0.1


@pytest.mark.parametrize("tenth", [2, 5, 8])
def test_a_gap_is_found_in_its_tenth(tenth: int) -> None:
    """On the rod that leads away from the camera: equal shares of its length are unequal in the image. Masks of
    neighbouring tenths overlap at its far end."""
    rendered = draw(keep=lambda rod, share: (rod != 1) | (share < tenth / 10) | (share > (tenth + 1) / 10))
    found = sections(rendered, draw())
    worst = min(found, key=lambda s: s.ratio)
    assert worst.rod == 1 and abs(worst.tenth - tenth) <= (tenth == 8) and worst.ratio < 0.7
    assert {s.rod for s in found if s.ratio < 0.9} == {1}
    assert all(abs(s.tenth - tenth) <= 1 for s in found if s.ratio < 0.9 and s.tenth < 6)


def test_half_transparent_and_swollen_rods() -> None:
    truth = draw()
    assert {round(s.ratio, 6) for s in sections(0.5 * truth, truth)} == {0.5}
    swollen = np.maximum(truth, np.roll(truth, 1, 0))
    assert min(s.ratio for s in sections(swollen, truth)) > 1.1


def test_tenths_behind_another_part_do_not_count() -> None:
    truth, y = draw(), np.arange(SIZE)[:, None] + 0.5
    x = y.T
    disc = np.hypot(x - 60, y - 38) < 10
    hidden = np.maximum(truth, disc)
    found = sections(hidden, hidden)
    assert {s.tenth for s in found if s.rod == 0} == {0, 1, 2, 3, 6, 7, 8, 9}
    assert len([s for s in found if s.rod != 0]) == 20


def test_tenths_outside_the_image_or_the_mask_do_not_count() -> None:
    ends = ENDS.copy()
    ends[0, 1, 0] = 4.0
    ends[2, 0, 1] = -4.5  # begins behind the camera
    found = sections(draw(ends), draw(ends), ends)
    assert {s.rod for s in found} == {0, 1} and 3 < len([s for s in found if s.rod == 0]) < 8
    known = KNOWN.copy()
    known[:, :60] = False
    assert {s.tenth for s in sections(draw(), draw(), known=known) if s.rod == 0} < {5, 6, 7, 8, 9}


def write_rods(folder: Path, count: int = 3, **changes: np.ndarray) -> None:
    arrays = {"names": np.array(["arm", "leg", "tail"]), "radii": RADII, "test_ends": np.stack([ENDS] * count)}
    np.savez(folder / "rods.npz", **{**arrays, **changes})


class RodScene(FakeScene):
    """Rods whose second one loses its middle at t = 0.5."""

    def render(self, camera: Camera, time: float, background: object = None) -> Image:
        broken = time == 0.5
        alpha = draw(keep=lambda rod, share: (rod != 1) | (abs(share - 0.55) > 0.05) | (not broken))
        tensor = torch.from_numpy(alpha).float()
        return Image(tensor.expand(3, SIZE, SIZE).permute(1, 2, 0), tensor, tensor)


def test_metrics_name_the_worst_tenth(tmp_path: Path) -> None:
    sound = torch.from_numpy(draw()).float()
    frames = [
        Frame(CAMERA, index / 2, sound.expand(3, SIZE, SIZE).permute(1, 2, 0), sound, name=f"r_{index:03d}")
        for index in range(3)
    ]
    data = Dataset(frames, folder=tmp_path, split="test")
    assert "rods_within" not in metrics_of(RodScene(), data)
    write_rods(tmp_path)
    metrics = metrics_of(RodScene(), data)
    assert metrics["rods_segments"] == 90 and 0.95 < metrics["rods_within"] < 1
    worst = metrics["rods_worst"]
    assert (worst["rod"], worst["tenth"], worst["name"], worst["time"]) == ("leg", 6, "r_001", 0.5)
    assert worst["ratio"] < 0.7


def test_no_tenth_gives_no_share() -> None:
    check = RodCheck(Rods(("arm",), RADII[:1], ENDS[None, :1]))
    frame = Frame(CAMERA, 0.0, torch.zeros(SIZE, SIZE, 3), torch.zeros(SIZE, SIZE))
    check.add(0, frame, torch.zeros(SIZE, SIZE))
    assert check.summary() == {"rods_within": None, "rods_segments": 0, "rods_worst": None}
    check.rows.append(("a", 0.0, Segment(0, 3, 1.05)))
    check.rows.append(("b", 1.0, Segment(0, 4, 1.2)))
    assert check.summary()["rods_within"] == 0.5 and check.summary()["rods_worst"]["tenth"] == 5


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"radii": np.array([0.1, 0.1])}, "must be"),
        ({"radii": np.array([0.1, 0.1, -1.0])}, "positive"),
        ({"test_ends": np.zeros((2, 3, 2, 3))}, "must be"),
        ({"test_ends": np.full((3, 3, 2, 3), np.nan)}, "finite"),
        ({"names": np.arange(3)}, "no sound numpy file"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, changes: dict[str, np.ndarray], named: str) -> None:
    write_rods(tmp_path, **changes)
    with pytest.raises(UserError, match=named):
        load_rods(tmp_path, "test", 3)


def test_a_split_without_rods(tmp_path: Path) -> None:
    assert load_rods(tmp_path, "test", 3) is None
    write_rods(tmp_path)
    rods = load_rods(tmp_path, "test", 3)
    assert rods is not None and rods.names == ("arm", "leg", "tail")
    with pytest.raises(UserError, match="val_ends"):
        load_rods(tmp_path, "val", 3)


def test_a_limb_of_the_built_in_skeleton(tmp_path: Path) -> None:
    """On real pictures: most tenths count, and an erased shin is found, nothing far from it."""
    filming = FilmingSettings(width=400, height=400, train=2, test=2, val=0)
    folder = synthesize(plan_synthesis(tmp_path / "rods", SynthesisRequest(subject="rods", filming=filming)))
    data = load(folder, "test")
    rods = load_rods(folder, "test", len(data))
    assert rods is not None
    frame, ends = data[1], rods.ends[1]
    assert frame.alpha is not None
    truth, known = frame.alpha.double().numpy(), np.ones((400, 400), bool)
    whole = measure(truth, truth, known, frame.camera, ends, rods.radii)
    assert len(whole) > 0.8 * 10 * len(rods.names)
    shin = rods.names.index("shin_left")
    viewmat = frame.camera.viewmat.double().numpy()
    places = (ends[shin] @ viewmat[:3, :3].T + viewmat[:3, 3]) @ frame.camera.K.double().numpy().T
    start, end = (places[:, :2] / places[:, 2:] - 0.5).round().astype(int)
    erased = truth.copy()
    cv2.line(erased, start.tolist(), end.tolist(), 0.0, 3)
    found = measure(erased, truth, known, frame.camera, ends, rods.radii)
    assert len(found) == len(whole)
    lost = [segment.ratio for segment in found if segment.rod == shin]
    assert len(lost) == 10 and max(lost) < 0.75
    beside = {"shin", "fibula", "thigh", "heel", "foot"}
    assert {rods.names[segment.rod].split("_")[0] for segment in found if segment.ratio < 0.5} <= beside
    assert np.mean([segment.ratio > 0.99 for segment in found]) > 0.95
