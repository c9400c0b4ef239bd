"""Contact sheets and curves: the right pictures in the right places, whatever the log lacks."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from scgs_warp.errors import UserError
from scgs_warp.visualization import figures


def test_contact_sheet_places_truth_render_and_error() -> None:
    truth = torch.zeros(60, 80, 3)
    truth[..., 0] = 1.0
    render = truth.clone()
    render[:30] = 0.0
    sheet = figures.contact_sheet([(truth, render), (truth, truth)], ["r_000", "r_001"])
    top, left = figures.CAPTION, figures.GAP
    assert sheet.dtype == np.uint8 and sheet.shape == (22 + 2 * (60 + 22 + 4), 3 * 80 + 16, 3)
    np.testing.assert_array_equal(sheet[top : top + 60, left : left + 80], figures.to_bytes(truth))
    np.testing.assert_array_equal(sheet[top : top + 60, left + 84 : left + 164], figures.to_bytes(render))
    error = sheet[top : top + 60, left + 168 : left + 248].astype(int)
    assert error[:30].sum(-1).min() > 400 and error[31:].sum(-1).max() < 30  # inferno: bright above, black below
    captions = sheet[top + 60 : top + 82]
    assert (captions < 100).any()  # something is written there


def test_contact_sheet_shrinks_and_centres() -> None:
    large, small = np.zeros((500, 1000, 3), np.uint8), np.zeros((20, 10, 3), np.uint8)
    sheet = figures.contact_sheet([(large, large), (small, small)], cell=200)
    assert sheet.shape[1] == 3 * 200 + 16
    row = sheet[figures.CAPTION + 200 + 26 :][:200, figures.GAP : figures.GAP + 200]
    assert (row[95:105, 96:104] == 0).all() and (row[:80] == 255).all()


def test_rows_of_wide_pictures_are_no_higher_than_the_pictures() -> None:
    wide, flat = torch.rand(240, 480, 3), torch.rand(100, 480, 3)
    rows = [(wide, wide), (flat, flat)]
    sheet = figures.contact_sheet(rows, cell=200)
    expected = figures.CAPTION + 2 * (100 + figures.CAPTION + figures.GAP)
    assert sheet.shape[:2] == (expected, 3 * (200 + figures.GAP) + figures.GAP)


def test_contact_sheet_shows_the_content_on_grey() -> None:
    """Rows with alpha are cropped to it; the scores are those of the whole pictures."""
    alpha, wide = torch.zeros(100, 200), torch.zeros(100, 200)
    alpha[40:60, 90:120], wide[40:60, 85:120] = 1.0, 1.0
    truth, render = torch.ones(100, 200, 3), torch.ones(100, 200, 3)
    truth[alpha > 0], render[wide > 0] = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0])
    sheet = figures.contact_sheet([(truth, render)], alphas=[(alpha, wide)], background=(1.0, 1.0, 1.0))
    height, width = 20 + 2 * 8, 35 + 2 * 8
    assert sheet.shape == (22 + height + 22 + 4, 4 * (width + 4) + 4, 3)
    top, left = figures.CAPTION, figures.GAP
    shown = sheet[top : top + height, left : left + width]
    assert (shown[8:28, 13:43] == (255, 0, 0)).all() and (shown[:8] == 128).all() and (shown[:, :13] == 128).all()
    assert (sheet[top + 8 : top + 28, left + width + 4 + 8 : left + width + 4 + 43] == (255, 0, 0)).all(), "the render"
    kept = figures.contact_sheet([(truth, render)], alphas=[(alpha, wide)])
    assert (kept[top : top + 8, left : left + width] == 255).all(), "a background that is not known is kept"


def test_contact_sheet_of_nothing_or_misfits_raises() -> None:
    with pytest.raises(ValueError, match="empty"):
        figures.contact_sheet([])
    with pytest.raises(ValueError, match=r"\[4, 4, 3\]"):
        figures.contact_sheet([(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))])


def test_bytes_clamp_and_survive_nan() -> None:
    found = figures.to_bytes(torch.tensor([[-1.0, 0.5, 2.0, math.nan, math.inf]]))
    assert found.tolist() == [[0, 128, 255, 0, 255]]


def test_psnr() -> None:
    truth = torch.full((4, 4, 3), 0.5)
    assert figures.psnr_of(truth, truth + 0.1) == pytest.approx(20.0, abs=1e-4)
    assert figures.psnr_of(truth, truth) == math.inf


def write_log(path: Path, lines: list) -> None:
    path.write_text("\n".join(line if isinstance(line, str) else json.dumps(line) for line in lines))


def test_curves_draw_what_is_there(tmp_path: Path) -> None:
    nodes = [{"step": step, "stage": "nodes", "psnr": 20 + step / 100} for step in range(0, 500, 50)]
    main = [{"step": step, "stage": "main", "loss": 0.1 / (1 + step), "psnr": 25.0, "gaussians": 100 + step}
            for step in range(0, 1000, 50)]  # fmt: skip
    write_log(tmp_path / "log.jsonl", [*nodes, *main, {"step": 500, "test_psnr": 27.0}, "[1, 2]", '{"step": 9'])
    figures.curves(tmp_path / "log.jsonl", tmp_path / "curves.png")
    import cv2

    picture = cv2.imread(str(tmp_path / "curves.png"))
    assert picture is not None and picture.shape[0] > 200
    assert (picture.max(-1).astype(int) - picture.min(-1) > 60).sum() > 200  # coloured lines were drawn


def test_stages_follow_each_other_and_resumed_steps_count_once() -> None:
    lines = [{"step": 0, "stage": "a", "psnr": 1.0}, {"step": 10, "stage": "a", "psnr": 2.0},
             {"step": 0, "stage": "b", "psnr": 3.0}, {"step": 5, "stage": "b", "psnr": 4.0},
             {"step": 5, "stage": "b", "psnr": 5.0}, {"step": 7, "stage": "b", "psnr": math.nan}]  # fmt: skip
    positions, starts = figures.axis_positions(lines)
    assert starts == [("a", 0.0), ("b", 10.0)]
    assert figures.series_of(lines[:2] + lines[3:], "psnr", positions) == {0.0: 1.0, 10.0: 2.0, 15.0: 5.0}


def test_an_evaluation_in_the_first_stage_does_not_shift_the_second(tmp_path: Path, monkeypatch) -> None:
    lines = [{"step": 10, "stage": "pretrain"}, {"step": 10, "test_psnr": 20.0}, {"step": 20, "stage": "pretrain"},
             {"step": 30, "stage": "main"}, {"step": 30, "test_psnr": 25.0}]  # fmt: skip
    write_log(tmp_path / "log.jsonl", lines)
    seen = {}
    placed = figures.axis_positions
    monkeypatch.setattr(figures, "axis_positions", lambda lines: seen.setdefault("placed", placed(lines)))
    figures.curves(tmp_path / "log.jsonl", tmp_path / "curves.png")
    assert list(seen["placed"][0].values()) == [10, 20, 30]


@pytest.mark.parametrize("lines", [[], [{}], [{"step": 3}], [{"psnr": 3.0}], [{"step": None, "psnr": "x"}]])
def test_curves_of_next_to_nothing(tmp_path: Path, lines: list) -> None:
    write_log(tmp_path / "log.jsonl", lines)
    figures.curves(tmp_path / "log.jsonl", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 0


@pytest.mark.filterwarnings("error")
def test_curves_of_losses_that_are_zero(tmp_path: Path) -> None:
    """As with images that are all black."""
    write_log(tmp_path / "log.jsonl", [{"step": step, "stage": "main", "loss": 0.0, "l1": 0.0} for step in (50, 100)])
    figures.curves(tmp_path / "log.jsonl", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 0


def test_missing_log_is_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"log\.jsonl"):
        figures.curves(tmp_path / "log.jsonl", tmp_path / "curves.png")


def test_contact_sheet_shows_alpha_where_there_is_any() -> None:
    picture = torch.zeros(60, 80, 3)
    true, rendered = torch.zeros(60, 80), torch.zeros(60, 80)
    true[:, :40], rendered[:, 20:60] = 1.0, 1.0
    sheet = figures.contact_sheet([(picture, picture)] * 2, alphas=[(true, rendered), None])
    left, top = figures.GAP + 3 * 84, figures.CAPTION
    assert sheet.shape[1] == 4 * 84 + 4
    shown = sheet[top : top + 60, left : left + 80]
    colors = [shown[30, x].tolist() for x in (10, 30, 50, 70)]
    assert colors == [[255, 0, 0], [255, 255, 255], [0, 0, 255], [0, 0, 0]], "missing, both, extra, neither"
    assert (sheet[top + 86 : top + 146, left : left + 80] == 255).all(), "the second row has none"
    assert figures.contact_sheet([(picture, picture)], alphas=[None]).shape[1] == 3 * 84 + 4


def test_the_curve_of_a_loss_ends_where_it_turns_negative(tmp_path: Path, monkeypatch) -> None:
    """With the logarithm of the error in it: a fall to the edge of the panel would look like a defect."""
    from matplotlib.axes import Axes

    scales, titles = [], []
    monkeypatch.setattr(Axes, "set_yscale", lambda axes, value, **options: scales.append(options["nonpositive"]))
    monkeypatch.setattr(Axes, "set_title", lambda axes, text: titles.append(text))
    lines = [{"step": step, "stage": "main", "loss": 0.1 - step / 1000} for step in (50, 99, 101)]
    write_log(tmp_path / "log.jsonl", lines)
    figures.curves(tmp_path / "log.jsonl", tmp_path / "curves.png")
    assert scales == ["mask"] and "loss, where it is positive" in titles
