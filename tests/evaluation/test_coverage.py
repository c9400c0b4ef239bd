"""A limb that is not rendered is reported with its place and time; sound images are not."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest
import torch
from torch import Tensor

from helpers.fake_scene import FakeScene, fake_dataset, install
from scgs_warp import data
from scgs_warp.apps import evaluate as app
from scgs_warp.data import Dataset
from scgs_warp.evaluation.coverage import Region, compare_alpha, coverage_line
from scgs_warp.evaluation.evaluate import evaluate, metrics_of, write_metrics
from scgs_warp.training.run import summary
from scgs_warp.types import Camera, Frame, Image


def body(size: int = 100) -> Tensor:
    """A block of 60 x 20 pixels with a soft edge."""
    alpha = torch.zeros(size, size)
    alpha[20:80, 40:60] = 1.0
    alpha[20:80, 60] = 0.5
    return alpha


def with_rod(alpha: Tensor, opacity: float = 1.0, width: int = 1) -> Tensor:
    """Add a horizontal rod of 30 x ``width`` pixels to the right of the body."""
    alpha = alpha.clone()
    alpha[40 : 40 + width, 65:95] = opacity
    return alpha


@pytest.mark.parametrize("width", [1, 2, 3])
@pytest.mark.parametrize("opacity", [0.0, 0.5])
def test_a_thin_structure_that_is_transparent(width: int, opacity: float) -> None:
    truth = with_rod(body(), 1.0, width)
    found = compare_alpha(with_rod(body(), opacity, width), truth)
    assert found is not None and found.missing_region is not None and found.missing_region.large
    lost, total = 30 * width * (1.0 - opacity), float(truth.sum())
    if opacity == 0:
        assert found.missing_region.pixels == pytest.approx(lost)
        assert found.missing == pytest.approx(lost / total) == found.missing_region.share
    else:  # Edges of the rendered half count as covering.
        assert 0.3 * lost < found.missing_region.pixels <= found.missing * total < lost
    assert (found.missing_region.x, found.missing_region.y) == pytest.approx((80.0, 40 + width / 2))
    assert found.extra == 0 and found.extra_region is None


@pytest.mark.parametrize(
    ("share", "pixels", "large"), [(0.005, 8.0, True), (0.5, 7.9, False), (0.0049, 800.0, False), (0.5, 800.0, True)]
)
def test_a_region_is_large_by_its_share_and_by_its_pixels(share: float, pixels: float, large: bool) -> None:
    """Half of a subject of a dozen pixels is no finding, nor is a speck on a large one."""
    assert Region(share, pixels, 1.0, 2.0).large == large


@pytest.mark.parametrize("shift", [(0, 1), (1, 0), (1, 1)])
def test_an_edge_that_is_shifted_by_a_pixel_is_covered(shift: tuple[int, int]) -> None:
    truth = with_rod(body(), 1.0, 2)
    found = compare_alpha(truth.roll(shift, (0, 1)), truth)
    assert found is not None
    assert (found.missing, found.extra) == (0, 0) and found.missing_region is None
    further = compare_alpha(truth.roll((0, 3), (0, 1)), truth)
    assert further is not None and further.missing_region is not None and further.extra_region is not None
    assert further.missing_region.x < 45 and further.extra_region.x > 60, "the limb stands beside its place"


@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_thin_structure_that_is_blurred_is_covered(width: int) -> None:
    """The renderer's low-pass filter has 0.55 pixels: it lowers the alpha of a line, but hides nothing."""
    truth = with_rod(body(), 1.0, width)
    blurred = torch.from_numpy(cv2.GaussianBlur(truth.numpy(), (0, 0), 0.55))
    found = compare_alpha(blurred, truth)
    assert found is not None and found.missing < 0.003 and found.missing_region is None
    wide = torch.from_numpy(cv2.GaussianBlur(truth.numpy(), (0, 0), 5.0))
    lost = compare_alpha(wide, truth)
    assert lost is not None and lost.missing_region is not None and lost.missing_region.large
    assert lost.extra_region is not None and lost.extra_region.large


def test_the_largest_of_several_regions() -> None:
    truth = with_rod(body())
    alpha = truth.clone()
    alpha[40, 85:95] = 0.0
    alpha[30:38, 45:53] = 0.3
    found = compare_alpha(alpha, truth)
    assert found is not None and found.missing_region is not None
    assert 16 * 0.7 < found.missing_region.pixels < 36 * 0.7, "the surroundings cover its rim"
    assert found.missing_region[2:] == pytest.approx((49, 34))
    assert 8 < found.missing * float(truth.sum()) - found.missing_region.pixels < 15


def test_nothing_is_known_outside_the_mask() -> None:
    truth, mask = with_rod(body()), torch.ones(100, 100, dtype=torch.bool)
    mask[:, 70:] = False
    found = compare_alpha(body(), truth, mask)
    total = float(body().sum())
    assert found is not None and 2 < found.missing * (total + 5) < 5
    specks = compare_alpha(with_rod(body()), body(), mask)
    assert specks is not None and 2 < specks.extra * total < 5
    assert compare_alpha(truth, truth.roll(1, 1), mask).missing == 0, "the edge of the mask is no edge of the subject"


def test_a_view_without_the_subject_has_no_share() -> None:
    assert compare_alpha(body(), torch.zeros(100, 100)) is None
    assert compare_alpha(body(), body(), torch.zeros(100, 100, dtype=torch.bool)) is None


class Forgetful(FakeScene):
    """The scene without its moving ball after t = 0.6."""

    def render(self, camera: Camera, time: float, background: object = None) -> Image:
        image = super().render(camera, time, background)
        if time < 0.6:
            return image
        kept = image.rgb[..., 2] >= image.rgb[..., 0]  # the resting ball is blue, the moving one orange
        return Image(image.rgb * kept[..., None], image.alpha * kept, image.depth)


def test_a_limb_that_is_gone_is_reported_where_and_when() -> None:
    truth = fake_dataset(FakeScene(), 5, size=80)
    sound = metrics_of(FakeScene(), truth)
    assert coverage_line(sound) is None and sound["missing"] == sound["extra"] == 0
    assert sound["missing_worst"] is None
    metrics = metrics_of(Forgetful(), truth)
    shares = [row["missing"] for row in metrics["per_image"]]
    assert shares[:3] == [0, 0, 0] and metrics["missing"] == pytest.approx(sum(shares) / 5)
    worst = metrics["missing_worst"]
    index = max(range(5), key=lambda i: shares[i])
    assert (worst["name"], worst["time"], worst["missing"]) == (f"r_{index:03d}", index / 4, shares[index])
    gone = truth[index].image[..., 0] > truth[index].image[..., 2]
    y, x = (places.float().mean() + 0.5 for places in torch.nonzero(gone, as_tuple=True))
    assert (worst["region"]["x"], worst["region"]["y"]) == pytest.approx((float(x), float(y)), abs=0.5)
    hidden = sum(share > 0 for share in shares)
    line = coverage_line(metrics)
    assert line is not None and "\n" not in line and worst["images"] == hidden
    assert line.startswith(f"not covered: test/r_{index:03d} (t = {index / 4:.2f}) misses {100 * shares[index]:.1f} % ")
    assert f"x {worst['region']['x']:.0f}, y {worst['region']['y']:.0f}" in line and "outside" not in line
    assert summary(metrics).endswith("\n" + line)


def test_alpha_outside_the_subject_is_reported() -> None:
    views = fake_dataset(FakeScene(), 5, size=80)
    less = [Frame(f.camera, f.time, f.image, Forgetful().render(f.camera, f.time).alpha, name=f.name) for f in views]
    metrics = metrics_of(FakeScene(), Dataset(less, folder=Path("x"), split="val"))
    line = coverage_line(metrics)
    assert line is not None and line.startswith("outside the subject: val/r_00") and "not covered" not in line
    assert metrics["missing"] == 0 and metrics["extra"] > 0.01


def test_images_without_alpha_have_no_coverage() -> None:
    views = fake_dataset(FakeScene(), 2)
    opaque = [Frame(f.camera, f.time, f.image, None, name=f.name) for f in views]
    metrics = evaluate(FakeScene(), Dataset(opaque, folder=Path("x"), split="test"))
    assert metrics["missing"] is None and metrics["missing_worst"] is None and coverage_line(metrics) is None
    assert "missing" not in metrics["per_image"][0]


def test_the_app_prints_one_line(monkeypatch, tmp_path, capsys) -> None:
    install(monkeypatch, Forgetful(folder=str(tmp_path)))
    monkeypatch.setattr(data, "load", lambda folder, split, **options: fake_dataset(FakeScene(), 3, size=80))
    assert app.cli(["--run", str(tmp_path)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "not covered" in line]
    assert len(lines) == 1 and "test/r_002 (t = 1.00)" in lines[0]
    written = json.loads((tmp_path / "evaluation/test/metrics.json").read_text())
    assert written["missing_worst"]["name"] == "r_002" and written["per_image"][2]["missing_region"]["pixels"] > 8


def test_median_and_worst_image(tmp_path: Path) -> None:
    scene = FakeScene()
    frames = [fake_dataset(scene, 3, error=error)[index] for index, error in enumerate((0.01, 0.1, 0.03))]
    metrics = metrics_of(scene, Dataset(frames, folder=Path("x"), split="test"))
    scores = [row["psnr"] for row in metrics["per_image"]]
    assert (metrics["psnr_worst"], metrics["psnr_worst_time"]) == (scores[1], 0.5)
    assert metrics["psnr_median"] == scores[2] and metrics["psnr"] == pytest.approx(sum(scores) / 3)
    empty = metrics_of(scene, Dataset([], folder=Path("x"), split="val"))
    assert empty["psnr_worst"] is empty["psnr_median"] is empty["missing"] is None
    write_metrics(empty, tmp_path / "metrics.json")
