"""The page as a file: what its data say of the scene, what it costs, and that no text can become a program."""

from __future__ import annotations

import base64
import hashlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene, rich_scene
from helpers.page_reader import PagePlayer, gaussians_of, read_page
from scgs_warp.errors import UserError
from scgs_warp.export import page, page_scene
from scgs_warp.export.page_data import Column, integers, pack, quantise, unpack
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.motion import build_motion
from scgs_warp.types import Pose


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * torch.log10(((a.clamp(0, 1) - b.clamp(0, 1)) ** 2).mean()))


@pytest.mark.parametrize("make", [bar_scene, rich_scene])
def test_what_a_page_holds_renders_as_the_scene(make, tmp_path):
    scene = make()
    page.write_page(scene, tmp_path / "page.html")
    facts, columns = read_page(tmp_path / "page.html")
    player = PagePlayer(scene, facts, columns)
    assert facts["gaussians"] == scene.gaussian_count
    for time in (0.0, 0.41, 1.0):
        camera = orbit_camera(scene.overview, 70.0 + 200 * time, 96)
        assert psnr(player.render(camera, time).rgb, scene.render(camera, time, (0, 0, 0)).rgb) > 50


def test_columns_come_back(tmp_path):
    random = np.random.default_rng(3)
    walk = random.normal(size=500).cumsum()
    columns = [
        quantise("fine", walk, 1e-4, delta=True),
        quantise("coarse", walk, 1e-4, most_bits=5),
        quantise("constant", np.full(500, 2.5), 1e-3),
        integers("whole", random.integers(0, 700, 500)),
        integers("none", np.zeros(0, int)),
    ]
    facts, values = unpack(pack({"fact": 1.5}, columns))
    assert facts["fact"] == 1.5
    for column in columns:
        assert np.array_equal(values[column.name], column.values()), column.name
    assert np.abs(values["fine"] - walk).max() <= 0.51e-4 and 16 < columns[0].bits < 24
    assert 0.4 * np.ptp(walk) / 31 < np.abs(values["coarse"] - walk).max() <= 0.51 * np.ptp(walk) / 31
    assert (values["constant"] == 2.5).all()
    assert pack({"fact": 1.5}, columns) == pack({"fact": 1.5}, columns)


def test_differences_may_pass_zero():
    codes = np.array([5, 0, 1023, 1], np.uint32)
    _, values = unpack(pack({}, [Column("x", codes, 10, delta=True)]))
    assert values["x"].tolist() == [5, 0, 1023, 1]


def test_what_cannot_be_seen_is_left_out():
    scene = bar_scene(nodes=12, gaussians=50)
    with torch.no_grad():
        scene.gaussians.opacity_logits[3] = -7.0
        scene.gaussians.means[5, 1] = float("nan")
        scene.gaussians.quats[8] = 0.0
    content = page_scene.page_scene(scene, 0)
    assert content.facts["gaussians"] == 47
    made = gaussians_of(*unpack(pack(content.facts, content.columns)))
    assert made.opacities().min() > 1 / 255 and made.means.isfinite().all()
    with torch.no_grad():
        scene.gaussians.opacity_logits.fill_(-9.0)
    with pytest.raises(UserError, match="no Gaussian that can be seen"):
        page_scene.page_scene(scene, 0)


def test_one_outlier_does_not_coarsen_the_others():
    plain, spoilt = (bar_scene(nodes=12, gaussians=3000) for _ in range(2))
    with torch.no_grad():
        spoilt.gaussians.sh_rest[7] = 80.0
        spoilt.gaussians.means[11] = torch.tensor([4e5, -1e7, 3.0])
    contents = [page_scene.page_scene(scene, 1) for scene in (plain, spoilt)]
    assert contents[0].facts["gaussians"] == 3000 and contents[1].facts["gaussians"] == 2999  # a stray is left out
    steps = [{column.name: column.step for column in content.columns} for content in contents]
    for name, step in steps[0].items():
        if name.startswith(("mean", "sh")):
            assert steps[1][name] < 1.7 * step and steps[1][name] <= 1.01 * page_scene.STEPS["sh_rest"], name
    made = gaussians_of(*unpack(pack(contents[1].facts, contents[1].columns)))
    assert 0.9 < made.sh_rest.max() < 1.7  # the outlier, clipped
    with torch.no_grad():
        spoilt.gaussians.means.add_(1e6)  # all are far: one is a stray
    assert page_scene.page_scene(spoilt, 0).facts["gaussians"] == 2999


def test_scarce_codes_are_for_what_is_common():
    values = np.random.default_rng(1).normal(size=5000)
    for outlier in (1e4, -1e4):
        column = quantise("x", np.append(values, outlier), 1e-3, most_bits=8)
        most = np.abs(values).max()
        assert column.step < 3 * most / 255 and np.abs(column.values()[:-1] - values).max() < 0.51 * column.step
    far = quantise("x", 1e3 + values, 1e-3, most_bits=8)
    assert np.abs(far.values() - values - 1e3).max() < 0.51 * np.ptp(values) / 255


def test_quick_motions_are_sampled_more_often():
    slow, quick = bar_scene(), bar_scene()
    swing = quick.motion.poses
    quick.motion.poses = lambda times: swing(0.5 + 0.5 * torch.sin(40 * times))  # type: ignore[method-assign]
    few, many = (page_scene.sample_poses(scene.motion)["translation"] for scene in (slow, quick))
    assert len(few) < len(many) == page_scene.MAX_SAMPLES
    exact = swing(0.5 + 0.5 * torch.sin(40 * torch.tensor([100 / 256])))[0].translations
    assert np.allclose(many[100], exact, atol=1e-6)


def test_rotations_do_not_turn_over_between_samples():
    scene = rich_scene()
    plain = scene.motion.poses

    def flipping(times: torch.Tensor) -> list[Pose]:
        return [
            Pose(pose.translations, pose.rotations * (-1.0) ** round(97 * time), pose.shape_rotations, pose.log_scales)
            for time, pose in zip(times.tolist(), plain(times))
        ]

    scene.motion.poses = flipping  # type: ignore[method-assign]
    found = page_scene.sample_poses(scene.motion)["rotation"]
    assert ((found[1:] * found[:-1]).sum(axis=2) > 0.5).all()


class Parts(HTMLParser):
    """Elements' texts, by name, as a browser reads them."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.found: list[tuple[str, dict, str]] = []
        self.open: list[int] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), ""))
        if tag not in ("meta", "input", "br", "path"):
            self.open.append(len(self.found) - 1)

    def handle_endtag(self, tag):
        while self.open and self.found[self.open.pop()][0] != tag:
            pass

    def handle_data(self, data):
        if self.open:
            tag, attrs, text = self.found[self.open[-1]]
            self.found[self.open[-1]] = tag, attrs, text + data

    def texts(self, tag: str) -> list[str]:
        return [text for name, _, text in self.found if name == tag]


@pytest.mark.parametrize(
    "title", ["</title><script>alert(1)</script>", "{{program}} \"'&<b>", "ein Tänzer\nim Saal", "caf\udce9"]
)
def test_a_title_is_text(title, tmp_path):
    page.write_page(bar_scene(nodes=12, gaussians=20), tmp_path / "page.html", title=title)
    parts = Parts(tmp_path / "page.html")
    shown = title.replace("\n", " ").replace("\udce9", "?")  # a name that is no UTF-8
    assert parts.texts("title") == [shown] and parts.texts("h1") == [shown]
    assert len(parts.texts("script")) == 2 and not parts.texts("b")


def test_only_its_own_program_may_run(tmp_path):
    page.write_page(bar_scene(nodes=12, gaussians=20), tmp_path / "page.html")
    parts = Parts(tmp_path / "page.html")
    policy = next(attrs["content"] for tag, attrs, _ in parts.found if tag == "meta" and "http-equiv" in attrs)
    for text in (parts.texts("script")[1], parts.texts("style")[0]):
        assert base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() in policy
    assert "default-src 'none'" in policy and "unsafe" not in policy


def test_the_program_is_small_and_the_same_scene_gives_the_same_page(tmp_path):
    scene = bar_scene(nodes=12, gaussians=20)
    for name in ("a", "b"):
        page.write_page(scene, tmp_path / f"{name}.html")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert len(page.assemble(b"")) < 64 * 1024
    assert "http://" not in page.program_text() and "https://" not in page.program_text()


def test_a_page_gives_up_degrees_until_it_fits_and_refuses_otherwise(tmp_path):
    scene = bar_scene(gaussians=3000)
    path = tmp_path / "page.html"
    page.write_page(scene, path)
    full = path.stat().st_size
    page.write_page(scene, path, max_mib=0.8 * full / page.MIB)
    smaller = path.read_bytes()
    assert len(smaller) <= 0.8 * full
    assert 0 < read_page(path)[0]["sh_degree"] < 3
    with pytest.raises(UserError, match=r"takes 0\.\d+ MiB even .* 0\.01 MiB of --max-mib"):
        page.write_page(scene, path, max_mib=0.01)
    assert path.read_bytes() == smaller and [p.name for p in tmp_path.iterdir()] == ["page.html"]
    with pytest.raises(UserError, match="above 0"):
        page.write_page(scene, path, max_mib=0)


@pytest.mark.parametrize("name", ["hexplane", "per-gaussian"])
def test_motions_without_control_points_are_refused(name, tmp_path):
    scene = bar_scene(nodes=12, gaussians=20)
    scene.motion = build_motion(name, scene.config)
    with pytest.raises(UserError, match=f"{name} has no control points"):
        page.write_page(scene, tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


def test_bad_places_are_refused(tmp_path):
    scene = bar_scene(nodes=12, gaussians=20)
    with pytest.raises(UserError, match=r"in \.html"):
        page.write_page(scene, tmp_path / "page.txt")
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(UserError, match="is a folder"):
        page.write_page(scene, tmp_path / "folder.html")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be made"):
        page.write_page(scene, tmp_path / "file" / "page.html")
    assert page.write_page(scene, tmp_path / "new" / "page.HTM") == 20
    assert (tmp_path / "new" / "page.HTM").is_file()
