"""Cases of rendering: projection, harmonics, binning, compositing and whole renderers."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

import scgs_warp
from fuzz.poison import Draw, finite_rows
from helpers.splats import random_splats
from scgs_warp.ops.binning import BandBinning, bin_splats
from scgs_warp.ops.binning_cuda import RadixBinning, bin_within, geometry_of
from scgs_warp.ops.compositing import composite
from scgs_warp.ops.forms import GpuForm
from scgs_warp.ops.harmonics import spherical_harmonics
from scgs_warp.ops.projection import project
from scgs_warp.rendering.render import draw as draw_image
from scgs_warp.rendering.render import render
from scgs_warp.types import Camera, Gaussians, Splats, Stats

from . import laws

FIELDS = ("means2d", "conics", "depths", "opacities", "radii")


def leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().requires_grad_()


def gaussians_of(d: Draw, count: int, degree: int) -> Gaussians:
    """Return Gaussians around the origin, from smaller than a pixel to larger than the screen."""
    size = float(d.pick((0.02, 0.1, 0.5, 3.0)))
    return Gaussians(
        means=d.normal(count, 3, scale=float(d.pick((0.1, 1.0, 1.0, 10.0)))),
        quats=d.normal(count, 4),
        scales=size * d.uniform(count, 3, low=0.05),
        opacities=d.uniform(count, low=float(d.pick((0.0, 0.9)))),
        sh_dc=d.normal(count, 3),
        sh_rest=d.normal(count, (degree + 1) ** 2 - 1, 3, scale=0.3),
    )


def camera_of(d: Draw, width: int, height: int, poisoned: float = 0.15) -> Camera:
    """Return a camera outside, inside, behind or very far from the Gaussians, or an invalid one."""
    direction = torch.nn.functional.normalize(d.normal(3) + 1e-6, dim=0)
    far = float(d.pick((4.0, 4.0, 4.0, 0.5, 0.0, 1e6, 1e20, 3e38)))
    side = torch.nn.functional.normalize(torch.linalg.cross(direction, d.normal(3) + 1e-6), dim=0)
    viewmat = torch.eye(4)
    toward = direction if d.chance(0.15) else -direction  # looking away: everything is behind
    viewmat[:3, :3] = torch.stack([side, torch.linalg.cross(toward, side), toward])
    viewmat[:3, 3] = -(viewmat[:3, :3] @ direction) * far
    focal = max(width, height) * float(d.pick((1.2, 1.2, 1.2, 0.05, 100.0)))
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, 1.1 * focal, height / 2], [0.0, 0.0, 1.0]])
    if d.chance(poisoned):
        d.poison(viewmat)
    if d.chance(poisoned):
        d.poison(K)
    return Camera(viewmat, K, width, height)


def poisoned_gaussians(d: Draw, count: int, degree: int) -> Gaussians:
    g, rows = gaussians_of(d, count, degree), d.rows(count)
    for name in ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest"):
        if d.chance(0.4):
            d.poison(getattr(g, name), rows)
    return g


def on(device: str, *tensors: Tensor) -> list[Tensor]:
    return [tensor.to(device) for tensor in tensors]


def case_projection(d: Draw, device: str) -> None:
    """Splats are finite; invalid Gaussians are zero and pass no gradient; the others are as if alone."""
    count, size = d.count(), d.size()
    g, camera = poisoned_gaussians(d, count, 0), camera_of(d, *size)
    shape = [leaf(x) for x in on(device, g.means, g.quats, g.scales, g.opacities)]
    viewmat, K = leaf(camera.viewmat.to(device)), camera.K.to(device)
    settings = {
        "near_plane": float(d.pick((0.01, 0.01, 0.0, -1.0, 1e-30, 1e30))),
        "far_plane": float(d.pick((1e10, 1e10, 0.0, float("inf")))),
        "eps2d": float(d.pick((0.3, 0.3, 0.0, 1e-30, 1e30))),
        "radius_clip": float(d.pick((0.0, 0.0, 3.0))),
        "antialiased": d.chance(0.3),
        "sharpness": sharpness_of(d),
        "form": "plain" if device != "cpu" or d.chance(0.3) else "cpu",
    }
    splats = project(*shape, viewmat, K, *size, **settings)
    floats = splats.means2d, splats.conics, splats.depths, splats.opacities
    laws.finite("splats", *floats)
    culled = splats.radii[:, 0] == 0
    laws.all_zero_where("culled splats", culled, [*floats, splats.radii])
    whole = finite_rows(*shape).to(device)
    assert bool(culled[~whole].all()), "a broken Gaussian is visible"
    incoming = [d.normal(*x.shape).to(device) for x in floats]
    wanted = [*shape, viewmat] if d.chance() else shape
    grads = torch.autograd.grad(floats, wanted, incoming)
    laws.finite("gradients of means, quats, scales, opacities, viewmat", *grads)
    laws.all_zero_where("gradients of the culled", culled, grads[:4])
    with torch.no_grad():
        alone = project(*(x[whole] for x in shape), viewmat, K, *size, **settings)
    for name in FIELDS:
        laws.equal(f"{name} of the valid", getattr(splats, name)[whole], getattr(alone, name))


def case_harmonics(d: Draw, device: str, form: GpuForm | None = None) -> None:
    """No colour is negative; an invalid row affects itself alone and passes no gradient."""
    count, degree = d.count(), int(d.rng.integers(4))
    g, camera = poisoned_gaussians(d, count, max(degree, int(d.rng.integers(4)))), d.normal(3)
    if d.chance(0.2):
        d.poison(camera)
    inputs = [leaf(x) for x in on(device, g.sh_dc, g.sh_rest, g.means, camera)]
    form = form or ("plain" if d.chance(0.3) else "cpu" if device == "cpu" else "cuda")
    colors = spherical_harmonics(*inputs, degree, form=form)
    used = inputs[1][:, : (degree + 1) ** 2 - 1]
    whole = finite_rows(inputs[0], used).to(device)
    marked = ~colors.isfinite().all(1)
    assert bool(marked[~whole].all()), "a broken coefficient is not marked"
    moderate = whole & (torch.cat([inputs[0][:, None], used], 1).abs().amax((1, 2)) < 1e37)
    assert not bool(marked[moderate].any()), "a good coefficient is marked"
    assert bool((colors[~marked] >= 0).all())
    grads = torch.autograd.grad(colors, inputs, d.normal(*colors.shape).to(device), allow_unused=True)
    laws.finite("gradients of sh_dc, sh_rest, means, camera", *grads)
    laws.zero("gradients of the marked channels", grads[0][~colors.isfinite()])
    alone = spherical_harmonics(*(x[whole] for x in inputs[:3]), inputs[3], degree, form=form)
    laws.equal("colours of the valid", colors[whole], alone)


def splats_of(d: Draw, device: str) -> Splats:
    """Return splats with arbitrary values, as another projection might produce them."""
    count, (width, height) = d.count(), d.size()
    splats = random_splats(d.seed % 2**31, count, width, height, log_scale=float(d.pick((-1.0, 1.0, 3.0))))
    rows = d.rows(count)
    for name in FIELDS[:4]:
        if d.chance(0.4):
            d.poison(getattr(splats, name), rows)
    if d.chance(0.3):
        values = torch.tensor([0, -1, 2**31 - 1, -(2**31), 1], dtype=torch.int32)
        splats.radii[rows] = values[torch.from_numpy(d.rng.integers(0, 5, (int(rows.sum()), 2)))]
    fields = on(device, *(getattr(splats, name) for name in FIELDS))
    return Splats(*fields, width=width, height=height, sharpness=sharpness_of(d))


def sharpness_of(d: Draw) -> float:
    return float(d.pick((0.0, 0.0, 0.5, 1e-6, 100.0)))


def case_binning(d: Draw, device: str) -> None:
    """Both sorts give the same lists, as many pairs as counted; invalid splats are in no tile."""
    splats, tile_size = splats_of(d, device), int(d.pick((16, 16, 16, 1, 3, 8, 64, 2**20)))
    if tile_size < 8 and splats.width * splats.height > 4096:
        tile_size = 8
    count, tiles = len(splats.means2d), bin_splats(splats, tile_size)
    laws.counted_as_emitted(tiles, count)
    broken = ~finite_rows(*(getattr(splats, name) for name in FIELDS[:4]))
    assert not bool(broken[tiles.splats.cpu().long()].any()), "a broken splat is in a tile"
    size = (splats.width, splats.height, tiles.columns, tiles.rows, tile_size)
    ours_of = (tiles.ranges, tiles.splats, tiles.slots, tiles.offsets)
    for counted in (BandBinning, RadixBinning) if device == "cpu" else (RadixBinning,):
        for ours, other in zip(ours_of, counted(geometry_of(splats), size, (0, tiles.columns * tiles.rows)).lists()):
            assert torch.equal(ours, other), f"{counted.__name__} differs"
    if tile_size == 16:
        room = max(1, len(tiles.splats) + int(d.rng.integers(-3, 4)))
        within, total = bin_within(splats, room)
        assert int(total) == len(tiles.splats)
        if room >= int(total):
            laws.equal("ranges within room", within.ranges, tiles.ranges)
            laws.equal("splats within room", within.splats[: int(total)], tiles.splats)


def case_compositing(d: Draw, device: str) -> None:
    """Images and gradients of arbitrary splats are finite; invalid splats change nothing."""
    splats, channels_count = splats_of(d, device), int(d.pick((1, 3, 3, 4, 5, 8, 9, 17)))
    count = len(splats.means2d)
    channels, background = d.normal(count, channels_count), d.uniform(channels_count)
    if d.chance():
        d.poison(channels, d.rows(count))
    if d.chance(0.2):
        d.poison(background)
    form = "cuda" if device != "cpu" else d.pick(("cpu", "cpu", "plain"))
    check_composite(d, splats, channels.to(device), background.to(device), form)


def check_composite(d: Draw, splats: Splats, channels: Tensor, background: Tensor, form: str) -> None:
    count, device = len(splats.means2d), channels.device
    leaves = [leaf(x) for x in (splats.means2d, splats.conics, splats.opacities, channels, background)]
    own = replace(splats, means2d=leaves[0], conics=leaves[1], opacities=leaves[2])
    stats, absgrad = Stats.zeros(count, device, absolute=d.chance()), torch.full((count, 2), torch.nan, device=device)
    image, alpha = composite(own, leaves[3], bin_splats(own), leaves[4], stats=stats, absgrad=absgrad, form=form)
    laws.finite("image, alpha", image, alpha)
    assert bool(((alpha >= 0) & (alpha < 1)).all())
    incoming = d.normal(*image.shape).to(device), d.normal(*alpha.shape).to(device)
    grads = torch.autograd.grad((image, alpha), leaves, incoming)
    laws.finite("gradients of means2d, conics, opacities, channels, background", *grads)
    laws.finite("statistics", stats.grad_norm, stats.count, stats.max_radii, absgrad)
    whole = finite_rows(*(getattr(splats, name) for name in FIELDS[:4]), channels).to(device)
    laws.all_zero_where("gradients of the broken", ~whole, grads[:4])
    rest = replace(splats, **{name: getattr(splats, name)[whole] for name in FIELDS})
    with torch.no_grad():
        alone = composite(rest, channels[whole], bin_splats(rest), background, form=form)
    for name, ours, other in zip(("image", "alpha"), (image, alpha), alone):
        laws.equal(f"{name} of the valid alone", ours, other)


def case_draw(d: Draw, device: str) -> None:
    """The whole pipeline draws valid Gaussians as if alone, with finite gradients."""
    count, size, degree = d.count(), d.size(), int(d.rng.integers(4))
    g, camera = poisoned_gaussians(d, count, degree), camera_of(d, *size).to(device)
    values = [leaf(x) for x in on(device, *g.tensors().values())]
    color = d.uniform(3)
    if d.chance(0.1):
        d.poison(color)
    background = leaf(color.to(device))
    viewmat = leaf(camera.viewmat)
    own = Camera(viewmat, camera.K, *size)
    options, sharpness = {"antialiased": d.chance(0.3), "depth": d.chance()}, sharpness_of(d)
    stats = Stats.zeros(count, device)
    image, alpha = draw_image(Gaussians(*values, sharpness), own, background, stats=stats, **options)
    laws.finite("image, alpha", image, alpha)
    incoming = d.normal(*image.shape).to(device), d.normal(*alpha.shape).to(device)
    grads = torch.autograd.grad((image, alpha), [*values, viewmat, background], incoming, allow_unused=True)
    laws.finite("gradients of the Gaussians' fields, viewmat, background", *grads)
    laws.finite("statistics", stats.grad_norm, stats.count, stats.max_radii)
    whole = finite_rows(*values).to(device)
    laws.all_zero_where("gradients of the broken", ~whole, [x for x in grads[:6] if x is not None])
    assert not bool(stats.count[~finite_rows(*values[:4]).to(device)].any()), "a broken Gaussian counts as seen"
    # Without gradients a GPU computes the colours in another kernel, so equal bits are required of like passes only.
    alone = draw_image(Gaussians(*(x[whole] for x in values), sharpness), own, background, **options)
    with torch.no_grad():
        shown = draw_image(Gaussians(*values, sharpness), own, background, **options)
        shown_alone = draw_image(Gaussians(*(x[whole] for x in values), sharpness), own, background, **options)
    for name, *images in zip(("image", "alpha"), (image, alpha), alone, shown, shown_alone):
        laws.equal(f"{name} of the valid alone", *images[:2])
        laws.equal(f"{name} of the valid alone, without gradients", *images[2:])
        if device == "cpu":
            laws.equal(f"{name} without gradients", images[0], images[2])


def case_render(d: Draw, device: str) -> None:
    """Colour, alpha and depth are finite; depth lies between the planes, or is 0."""
    g, camera = poisoned_gaussians(d, d.count(), int(d.rng.integers(4))), camera_of(d, *d.size())
    values = [leaf(x) for x in on(device, *g.tensors().values())]
    image = render(Gaussians(*values, sharpness_of(d)), camera.to(device), antialiased=d.chance())
    laws.finite("rgb, alpha, depth", image.rgb, image.alpha, image.depth)
    assert bool((image.depth >= 0).all())
    incoming = [d.normal(*x.shape).to(device) for x in (image.rgb, image.alpha, image.depth)]
    grads = torch.autograd.grad((image.rgb, image.alpha, image.depth), values, incoming, allow_unused=True)
    laws.finite("gradients", *grads)


def case_rasterization(d: Draw, device: str) -> None:
    """Check the same through gsplat's entry point, with one to three cameras, any of them invalid."""
    count, size, cameras = d.count(), d.size(), int(d.rng.integers(1, 4))
    degree = None if d.chance() else int(d.rng.integers(3))
    g = poisoned_gaussians(d, count, degree or 0)
    colors = torch.cat([g.sh_dc[:, None], g.sh_rest], 1) if degree is not None else g.sh_dc
    views = [camera_of(d, *size) for _ in range(cameras)]
    inputs = [leaf(x) for x in on(device, g.means, g.quats, g.scales, g.opacities, colors)]
    viewmats = leaf(torch.stack([view.viewmat for view in views]).to(device))
    Ks = torch.stack([view.K for view in views]).to(device)
    mode = d.pick(("RGB", "D", "ED", "RGB+D", "RGB+ED"))
    options = {"sh_degree": degree, "render_mode": mode, "absgrad": d.chance(0.3)}
    renders, alphas, meta = scgs_warp.rasterization(*inputs, viewmats, Ks, *size, **options)
    laws.finite("renders, alphas", renders, alphas)
    laws.finite("meta", *(meta[name] for name in ("means2d", "conics", "depths", "opacities")))
    assert renders.shape[:3] == (cameras, size[1], size[0])
    broken = ~finite_rows(*inputs[:4]).to(device)
    assert not bool(meta["radii"][:, broken].any()), "a broken Gaussian is visible"
    incoming = d.normal(*renders.shape).to(device), d.normal(*alphas.shape).to(device)
    grads = torch.autograd.grad((renders, alphas), [*inputs, viewmats], incoming, allow_unused=True)
    laws.finite("gradients", *grads)


CASES = {
    "projection": (case_projection, 3),
    "harmonics": (case_harmonics, 2),
    "binning": (case_binning, 3),
    "compositing": (case_compositing, 4),
    "draw": (case_draw, 4),
    "render": (case_render, 2),
    "rasterization": (case_rasterization, 2),
}
