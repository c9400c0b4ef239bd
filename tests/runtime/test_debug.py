"""Debug mode: random scenes keep every promise, with the results of the usual mode; and every check can fail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from helpers.cuda_emulation import COMPILER, build, launcher
from helpers.splats import random_splats
from scgs_warp.benchmark import scenes
from scgs_warp.ops import binning, binning_cuda, checks, compositing, compositing_cuda, cuda_blocks
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.binning_cuda import bin_within
from scgs_warp.ops.compositing import composite
from scgs_warp.runtime import debug, environment
from scgs_warp.runtime.debug import BrokenInvariant
from scgs_warp.types import Splats, Tiles

SIZE = (70, 50)


@pytest.fixture
def debugging():
    before = debug.enabled()
    debug.enable()
    yield
    debug.enable(before)


def some_splats(seed: int, device: str = "cpu", count: int = 150, **how: Any) -> Splats:
    """A third of them poisoned or culled."""
    splats = random_splats(seed, count, *SIZE, device, **how)
    g = torch.Generator().manual_seed(seed + 100)
    depths = torch.round(4.0 * splats.depths.cpu()) / 4.0 - 2.0
    depths[torch.rand(count, generator=g) < 0.1] = float("nan")
    conics = splats.conics.cpu() * torch.where(torch.rand(count, 1, generator=g) < 0.1, -1.0, 1.0)
    radii = splats.radii.cpu() * (torch.rand(count, 1, generator=g) > 0.1).int()
    return replace(splats, depths=depths.to(device), conics=conics.to(device), radii=radii.to(device))


def draw(splats: Splats, form: str, channels: int = 4) -> list[torch.Tensor]:
    """Image, alpha and gradients."""
    g = torch.Generator().manual_seed(1)
    count, device = len(splats.means2d), splats.means2d.device
    colors = torch.rand(count, channels, generator=g)
    colors[: count // 20] = float("nan")
    colors = colors.to(device).requires_grad_()
    means = splats.means2d.clone().requires_grad_()
    splats = replace(splats, means2d=means)
    image, alpha = composite(splats, colors, bin_splats(splats), form=form)  # type: ignore[arg-type]
    (image.square().sum() + alpha.sum()).backward()
    assert means.grad is not None and colors.grad is not None
    return [image.detach(), alpha.detach(), means.grad, colors.grad]


@pytest.mark.parametrize("form", ("auto", "plain"))
@pytest.mark.parametrize("how", ({}, {"log_scale": 3.0, "aspect": 1.5}, {"log_scale": -1.0}, {"opacity": (0.9, 1.0)}))
def test_random_scenes_keep_every_promise(device: str, form: str, how: dict, debugging: None):
    for seed in range(4):
        splats = some_splats(seed, device, **how)
        checked = draw(splats, form)
        debug.enable(False)
        assert all(torch.equal(a, b) for a, b in zip(checked, draw(splats, form), strict=True))
        debug.enable()
        for count, channels in ((0, 3), (1, 3), (60, 11)):
            draw(some_splats(seed + 50, device, count, **how), form, channels)


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler, or not Linux, whose fibres the shim uses")
def test_so_do_the_native_form_and_the_radix_sort(tmp_path, monkeypatch: pytest.MonkeyPatch, debugging: None):
    monkeypatch.setattr(cuda_blocks, "launch_native", launcher(build(tmp_path)))
    monkeypatch.setattr(binning, "BandBinning", binning_cuda.RadixBinning)
    for seed in range(2):
        draw(some_splats(seed), "cuda")
    spoil_launch(monkeypatch, compositing_cuda, "sum_slots", lambda _, outputs: outputs[-1][0].fill_(torch.inf))
    with pytest.raises(BrokenInvariant, match="gradients of finite gradients are finite"):
        draw(some_splats(0), "cuda")


@pytest.mark.parametrize("capacity", (1, 100, 5000))
def test_lists_with_room_stay_within_it(device: str, capacity: int, debugging: None):
    for slots in (False, True):
        bin_within(some_splats(3, device), capacity, slots=slots)


def test_a_moving_scene_is_drawn_and_never_recorded(device: str, debugging: None):
    scene = scenes.synthetic_scene("control-points", 600, 30, device)
    camera = scenes.scene_camera(scene, (64, 48))
    for _ in range(5):
        image = scene.frame_graph().render(camera, 0.4, torch.zeros(3))
    assert image.alpha.max() > 0.5 and scene.frame_graph().recordings == 0


def test_the_variable_turns_it_on(monkeypatch: pytest.MonkeyPatch):
    import importlib

    for value, expected in (("1", True), ("0", False), ("", False)):
        monkeypatch.setenv("SCGS_DEBUG", value)
        module = importlib.util.module_from_spec(importlib.util.spec_from_file_location("own", debug.__file__))  # type: ignore
        module.__spec__.loader.exec_module(module)  # type: ignore[union-attr]
        assert module.enabled() is expected


def good() -> tuple[Splats, Tiles]:
    splats = some_splats(7)
    tiles = bin_splats(splats)
    checks.check_tiles(splats, tiles)
    return splats, tiles


def _set(name: str, place: Any, value: Any) -> Callable[[Tiles], None]:
    def spoil(tiles: Tiles) -> None:
        getattr(tiles, name)[place] = value

    return spoil


def _swap_neighbours(tiles: Tiles) -> None:
    """Two pairs of one tile, with their slots."""
    begin = int(tiles.ranges[(tiles.ranges[:, 1] - tiles.ranges[:, 0]).argmax(), 0])
    for row in (tiles.splats, tiles.slots):
        row[begin : begin + 2] = row[begin : begin + 2].flip(0)


def _give_away(tiles: Tiles) -> None:
    """A pair of one Gaussian is listed for another: as many in all."""
    listed = tiles.splats
    listed[0] = int(listed[listed != listed[0]][0])


def _swap_owners(tiles: Tiles) -> None:
    other = int((tiles.splats != tiles.splats[0]).nonzero()[0])
    tiles.slots[[0, other]] = tiles.slots[[other, 0]]


SPOILT: dict[str, Callable[[Tiles], Any]] = {
    "every place in the list was written": _set("splats", 5, checks.UNWRITTEN),
    "every gradient slot lies within their number": _set("slots", 5, 10**6),
    "tile ranges lie within the list": _set("ranges", (3, 1), 10**6),
    "no tile range ends before it begins": lambda tiles: tiles.ranges[3].copy_(tiles.ranges[3].flip(0)),
    "the first Gaussian's slots begin at 0": _set("offsets", 0, 1),
    "Gaussians' slots follow each other within their number": _set("offsets", 9, 10**6),
    "tile ranges cover the list": lambda tiles: tiles.ranges.sub_((tiles.ranges == len(tiles.splats)).int()),
    "each tile's range begins where the last one ends": _set("ranges", (4, 0), 0),
    "of each Gaussian, as many pairs are emitted as were counted": _give_away,
    "no two pairs share a gradient slot": lambda tiles: tiles.slots[:1].copy_(tiles.slots[1:2]),
    "a pair's gradient slot is one of its Gaussian's": _swap_owners,
    "within a tile, pairs are sorted by depth, then index": _swap_neighbours,
}


@pytest.mark.parametrize("promise", SPOILT)
def test_broken_lists_are_found(promise: str):
    splats, tiles = good()
    SPOILT[promise](tiles)
    with pytest.raises(BrokenInvariant) as caught:
        checks.check_tiles(splats, tiles)
    assert str(caught.value) == f"violated: {promise}"


def test_lists_of_other_lengths_are_found():
    splats, tiles = good()
    with pytest.raises(BrokenInvariant, match="as many slots as pairs"):
        checks.check_tiles(splats, replace(tiles, slots=tiles.slots[:-1]))
    with pytest.raises(BrokenInvariant, match="the room that was planned"):
        checks.check_room(tiles, len(tiles.splats) + 1, len(splats.means2d))
    offsets = torch.cat([tiles.offsets[:-1], tiles.offsets[-2:-1]])
    with pytest.raises(BrokenInvariant, match=r"as many pairs are listed as were counted|of each Gaussian"):
        checks.check_tiles(splats, replace(tiles, offsets=offsets.clamp(max=int(tiles.offsets[-1]) - 1)))


def spoil_launch(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, spoil: Callable[[str, tuple], Any]) -> None:
    """``spoil`` gets a kernel's name and its arguments after it ran."""
    original = getattr(module, name)

    def launch(kernel: Any, *args: Any, **options: Any) -> None:
        original(kernel, *args, **options)
        spoil(getattr(kernel, "key", str(kernel)), args)

    monkeypatch.setattr(module, name, launch)


@pytest.mark.parametrize(
    ("promise", "place", "value"),
    [
        ("final transmittance lies in \\[0, 1\\]", -2, 1.5),
        ("final transmittance lies in \\[0, 1\\]", -2, float("nan")),
        ("alpha lies in \\[0, 1\\]", -3, -0.1),
        ("the last contributor is one of its tile's splats", -1, 10**6),
        ("an image of finite colours is finite", -4, float("inf")),
    ],
)
def test_broken_pixels_are_found(promise: str, place: int, value: float, monkeypatch, debugging: None):
    def spoil(kernel: str, args: tuple) -> None:
        if kernel == "composite":
            args[place].view(-1)[40] = value

    spoil_launch(monkeypatch, compositing, "launch", spoil)
    with pytest.raises(BrokenInvariant, match=promise):
        draw(some_splats(1), "cpu")


def test_broken_slots_are_found(monkeypatch: pytest.MonkeyPatch, debugging: None):
    original = compositing.launch

    def forgetful(kernel: Any, count: int, *args: Any, **options: Any) -> None:
        if kernel.key == "composite_adjoint":  # the last tile's adjoint is not run
            count, options["load"] = count - 1, options["load"][:-1]
        original(kernel, count, *args, **options)

    monkeypatch.setattr(compositing, "launch", forgetful)
    with pytest.raises(BrokenInvariant, match="every gradient slot was written before it is read"):
        draw(some_splats(1), "cpu")


def test_missing_slots_are_found():
    _, tiles = good()
    with pytest.raises(BrokenInvariant, match="a gradient slot for each pair"):
        checks.check_slots(tiles, torch.zeros(len(tiles.splats) - 1, 16))


@pytest.mark.parametrize("counted", ("BandBinning", "RadixBinning"))
def test_emitting_other_tiles_than_were_counted_is_found(counted: str, monkeypatch, debugging: None, all_threads: None):
    """The second pass sees smaller splats than the first: what it leaves out was never written, or is not owned."""
    environment.configure(1)
    kind = getattr(binning, counted, None) or binning_cuda.RadixBinning
    monkeypatch.setattr(binning, "BandBinning", kind)

    def shrinking(geometry: list[torch.Tensor], *rest: Any) -> Any:
        count = kind(geometry, *rest)
        count._geometry = [geometry[0], 4.0 * geometry[1], *geometry[2:]]
        return count

    monkeypatch.setattr(binning, "BandBinning", shrinking)
    large = random_splats(2, 60, 400, 300, log_scale=4.0, opacity=(0.5, 1.0))  # beyond the window of 8 x 8 tiles
    with pytest.raises(BrokenInvariant):
        bin_splats(large)
