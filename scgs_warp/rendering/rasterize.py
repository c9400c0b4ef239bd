"""gsplat's main entry point on this project's kernels, with the same names, so that changing one import suffices."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from ..ops.binning import bin_splats
from ..ops.compositing import composite, demand
from ..ops.harmonics import MAX_DEGREE, whole_harmonics
from ..ops.projection import project
from ..ops.shapes import given_number, given_whole
from ..runtime.caller_settings import unaffected
from ..types import Camera, Splats
from .render import centre_of, expected_depth

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


class Meta(dict[str, Any]):
    """Intermediate results by name."""

    def __missing__(self, name: str) -> Any:
        raise KeyError(
            f"{name}: not in meta, which holds {', '.join(self)} for all N Gaussians, as with packed=False; give "
            "packed=False to what reads it"
        )


@unaffected
def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye", "ftheta"] = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = "GLOBAL",
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians from C cameras, with the arguments, order and defaults of gsplat 1.5.3's ``rasterization``.

    Args:
        means: [N, 3] float32, world.
        quats: [N, 4] wxyz, need not be unit.
        scales: [N, 3] > 0, standard deviations, world units.
        opacities: [N] in [0, 1].
        colors: [N, D] or [C, N, D]; with ``sh_degree``, harmonics [N, K, 3] or [C, N, K, 3].
        viewmats: [C, 4, 4] world to camera (OpenCV), rigid.
        Ks: [C, 3, 3] pixels; no gradient.
        width: pixels.
        height: pixels.
        near_plane: smallest camera z kept.
        far_plane: largest camera z kept.
        radius_clip: pixels; splats whose radii are not larger are culled.
        eps2d: added to both variances of the 2D covariance, px^2.
        sh_degree: 0 to 3 if ``colors`` are harmonics. None: they are colours.
        backgrounds: [C, D] colours behind everything. None: zeros. The depth behind everything is zero.
        render_mode: content of the last dimension: colour, accumulated depth (D), expected depth (ED), or both.
        absgrad: after ``backward``, ``meta["means2d"].absgrad`` [C, N, 2] is the sum over pixels of the absolute
            gradients of the 2D means (AbsGS).
        rasterize_mode: ``antialiased``: Mip-Splatting's opacity compensation.
        packed: no effect, like ``tile_size``, ``sparse_grad``, ``channel_chunk`` and ``segmented``, because there is
            only one memory layout, that of ``packed=False``.

    Returns:
        renders [C, H, W, D], alphas [C, H, W, 1], and meta: ``means2d`` [C, N, 2] (may ``retain_grad``), ``radii``
        [C, N, 2] int32, ``depths`` [C, N], ``conics`` [C, N, 3], ``opacities`` [C, N], ``width``, ``height``,
        ``n_cameras``. Gradients reach means, quats, scales, opacities, colors, viewmats and backgrounds.

    Raises:
        ValueError: a shape, dtype or choice is wrong; the message names the argument.
        NotImplementedError: an argument asks for a feature that does not exist here; the message names it.
    """
    width, height = given_whole("width", width), given_whole("height", height)
    sh_degree = None if sh_degree is None else given_whole("sh_degree", sh_degree)
    _refuse(
        distributed=distributed,
        camera_model=camera_model != "pinhole",
        covars=covars is not None,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs is not None,
        tangential_coeffs=tangential_coeffs is not None,
        thin_prism_coeffs=thin_prism_coeffs is not None,
        ftheta_coeffs=ftheta_coeffs is not None,
        rolling_shutter=getattr(rolling_shutter, "name", rolling_shutter) != "GLOBAL",
        viewmats_rs=viewmats_rs is not None,
        sh_degree=sh_degree is not None and sh_degree > MAX_DEGREE,
    )
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode must be one of {', '.join(RENDER_MODES)}, got {render_mode!r}")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode must be classic or antialiased, got {rasterize_mode!r}")
    planes = {"near_plane": near_plane, "far_plane": far_plane, "radius_clip": radius_clip, "eps2d": eps2d}
    settings: dict[str, Any] = {name: given_number(name, value) for name, value in planes.items()}
    floats = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    _check_tensors(**floats, viewmats=viewmats, Ks=Ks, **({} if backgrounds is None else {"backgrounds": backgrounds}))
    _check_shapes(means, colors, viewmats, Ks, backgrounds, sh_degree)
    cameras = [Camera(viewmat, K, width, height) for viewmat, K in zip(viewmats, Ks)]
    geometry, smooth = (means, quats, scales, opacities), rasterize_mode == "antialiased"
    splats = [
        project(*geometry, camera.viewmat, camera.K, width, height, antialiased=smooth, **settings)
        for camera in cameras
    ]
    meta = _meta(splats, absgrad)

    renders, alphas = [], []
    for index, (camera, splat) in enumerate(zip(cameras, splats)):
        # The 2D means come from the stacked tensor, so that its retained gradient covers every camera.
        splat = Splats(meta["means2d"][index], *_without_means2d(splat))
        own = colors[index] if colors.ndim == (3 if sh_degree is None else 4) else colors
        background = None if backgrounds is None else backgrounds[index]
        channels, background = _channels(own, means, camera, splat, sh_degree, render_mode, background)
        buffer = meta["means2d"].absgrad[index] if absgrad else None
        tiles = bin_splats(splat, demand=demand(splat, channels, background), slots=torch.is_grad_enabled())
        unit = 1.0 if render_mode.endswith("ED") and not torch.is_grad_enabled() else None
        image, alpha = composite(splat, channels, tiles, background, absgrad=buffer, depth_unit=unit)
        if render_mode.endswith("ED") and unit is None:
            image = torch.cat([image[:-1], expected_depth(image[-1], alpha)[None]])
        renders.append(image.permute(1, 2, 0))
        alphas.append(alpha[..., None])
    return _stacked(renders), _stacked(alphas), meta


def _channels(
    colors: Tensor,
    means: Tensor,
    camera: Camera,
    splats: Splats,
    sh_degree: int | None,
    render_mode: str,
    background: Tensor | None,
) -> tuple[Tensor, Tensor | None]:
    """Return the channels to blend for one camera, [N, D], depth last, and the background, [D]."""
    depths = splats.depths[:, None]
    if not render_mode.startswith("RGB"):
        return depths, None
    if sh_degree is not None:
        colors = whole_harmonics(colors, means, centre_of(camera), sh_degree)
    if render_mode == "RGB":
        return colors, background
    if background is not None:
        background = torch.cat([background, background.new_zeros(1)])
    return torch.cat([colors, depths], dim=1), background


def _stacked(of_cameras: list[Tensor]) -> Tensor:
    """Stack the cameras' tensors; that of a single camera is not copied."""
    return of_cameras[0][None] if len(of_cameras) == 1 else torch.stack(of_cameras)


def _meta(splats: list[Splats], absgrad: bool) -> Meta:
    names = "means2d", "radii", "depths", "conics", "opacities"
    meta = Meta((name, _stacked([getattr(splat, name) for splat in splats])) for name in names)
    meta.update(width=splats[0].width, height=splats[0].height, n_cameras=len(splats))
    if absgrad:
        meta["means2d"].absgrad = torch.zeros_like(meta["means2d"])
    return meta


def _without_means2d(splats: Splats) -> tuple[Any, ...]:
    return splats.conics, splats.depths, splats.opacities, splats.radii, splats.width, splats.height


def _refuse(**unsupported: bool) -> None:
    for name, asked in unsupported.items():
        if asked:
            raise NotImplementedError(f"{name}: scgs_warp does not do this; see scgs_warp.rasterization")


def _check_tensors(**tensors: Tensor) -> None:
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor):
            raise ValueError(f"{name} must be a torch tensor, got {type(tensor).__name__}; use torch.as_tensor")
        if tensor.dtype != torch.float32:
            raise ValueError(f"{name} must be float32, got {tensor.dtype}")
        if tensor.layout != torch.strided:
            raise ValueError(f"{name} must be dense, got {tensor.layout}; use to_dense")
        if tensor.device != tensors["means"].device:
            raise ValueError(
                f"{name} is on {tensor.device}, means on {tensors['means'].device}; move them to one device"
            )


def _check_shapes(
    means: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor, backgrounds: Tensor | None, sh_degree: int | None
) -> None:
    """Check the shapes that ``project`` does not check."""
    if means.ndim != 2:
        raise ValueError(f"means must be [N, 3], got {tuple(means.shape)}; call once for each scene of a batch")
    count = len(means)
    if viewmats.ndim != 3 or tuple(viewmats.shape[1:]) != (4, 4) or len(viewmats) == 0:
        raise ValueError(f"viewmats must be [C, 4, 4] with C > 0, got {tuple(viewmats.shape)}")
    cameras = len(viewmats)
    if tuple(Ks.shape) != (cameras, 3, 3):
        raise ValueError(f"Ks must be [{cameras}, 3, 3], got {tuple(Ks.shape)}")
    inner = 1 if sh_degree is None else 2
    outer = tuple(colors.shape[: max(colors.ndim - inner, 0)])
    if outer not in ((count,), (cameras, count)) or colors.shape[-1] == 0:
        form = "[N, D] or [C, N, D]" if sh_degree is None else "[N, K, 3] or [C, N, K, 3]"
        raise ValueError(f"colors must be {form} with N = {count}, C = {cameras}, got {tuple(colors.shape)}")
    if sh_degree is not None and (colors.shape[-1] != 3 or not 1 <= (sh_degree + 1) ** 2 <= colors.shape[-2]):
        raise ValueError(f"colors must hold (sh_degree + 1)^2 harmonics of 3 channels, got {tuple(colors.shape)}")
    depth = 3 if sh_degree is not None else colors.shape[-1]
    if backgrounds is not None and tuple(backgrounds.shape) != (cameras, depth):
        raise ValueError(f"backgrounds must be [{cameras}, {depth}], got {tuple(backgrounds.shape)}")
