"""Make a data set with known motion: ``python apps/synthesize.py --subject balls --output data/balls``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from scgs_warp.apps.cli import Device, prepare, run


@dataclass(frozen=True)
class Options:
    """Render a built-in subject or an animated mesh: images in D-NeRF layout and the true motion of the surface, for
    train.py --data."""

    output: Path
    """Folder to make, with transforms_train.json, train/ and so on, ground_truth.npz, contact_sheet.png."""
    mesh: Path | None = None
    """File .glb or .gltf; skins, moving nodes and morph targets are animated."""
    subject: str | None = None
    """Built-in subject instead of a file: robot (the default), rods, rods-dark, balls, balls-steady, cloth, fan,
    touch, opening, still."""
    clip: str | None = None
    """Name of the animation; the first one by default. With an unknown name, the command lists all names."""
    start: float | None = None
    """Second of the clip that becomes time 0; its first keyframe by default."""
    end: float | None = None
    """Second of the clip that becomes time 1; its last keyframe by default."""
    size: tuple[int, ...] = (400,)
    """Size of the images in pixels: one number, or width and height."""
    train: int | None = None
    """Training times, spread over the motion; each gives one image per camera. 100 with --subject, otherwise 150."""
    test: int = 20
    """Test images, spread over the motion, each from its own position."""
    val: int = 10
    """Validation images, like the test images; 0 for none."""
    cameras: Literal["sphere", "path"] = "sphere"
    """sphere: positions on a dome, new for every image (with several --views, fixed); path: cameras that move round the
    figure."""
    views: int = 1
    """Number of synchronised cameras; 1 is monocular, more are a rig."""
    turns: float = 1.0
    """Number of times that a camera path goes round the figure; less than 1 is an arc."""
    elevation: tuple[float, float] = (2.866, 58.212)
    """Elevation of the lowest and the highest camera, degrees."""
    fov: float = 39.597752
    """Horizontal field of view, degrees; cameras stand where the whole motion just fits the image."""
    samples: int = 4
    """Rays per pixel and axis: 4 gives 16 rays per pixel, 1 no anti-aliasing."""
    background: Literal["transparent", "black", "white"] = "transparent"
    """transparent: RGBA images; otherwise RGB images on that colour."""
    light: tuple[float, float, float] = (-0.42, -0.62, 0.66)
    """Direction to the light; z is up and the figure faces -y."""
    ambient: float = 0.5
    """Strength of ambient light; 0.5 is normal."""
    diffuse: float = 0.5
    """Strength of the light from --light, multiplied by the cosine with the surface normal; 0.5 is normal."""
    unlit: bool = False
    """Show textures and colours without lighting."""
    seed: int = 0
    """Random seed of cameras and surface points; the same seed gives the same bytes."""
    device: Device = "auto"
    """Where to cast rays; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default."""


def main(args: list[str] | None) -> None:
    import tyro

    options = tyro.cli(Options, args=args, prog="synthesize.py")
    device = prepare(options.device, options.threads)

    from scgs_warp.data.synthetic.from_mesh import SHEET, SynthesisRequest, plan_synthesis, synthesize
    from scgs_warp.data.synthetic.mesh import Shading
    from scgs_warp.data.synthetic.orbit_cameras import FilmingSettings
    from scgs_warp.errors import UserError
    from scgs_warp.runtime.progress import progress

    if len(options.size) not in (1, 2):
        raise UserError(f"--size {' '.join(map(str, options.size))}: give one number, or width and height")
    o = options
    train = o.train if o.train is not None else 150 if o.subject is None else 100
    filming = FilmingSettings(
        o.size[0], o.size[-1], train, o.test, o.val, o.cameras, o.views, o.fov, o.elevation, o.turns
    )
    shading = Shading(o.light, o.ambient, o.diffuse, o.unlit)
    request = SynthesisRequest(
        o.mesh, o.clip, o.start, o.end, filming, shading, o.samples, o.background, o.seed, o.subject
    )
    planned = plan_synthesis(o.output, request, device)
    print("\n".join(planned.lines), flush=True)
    if not planned.made:
        with progress(sum(planned.counts.values()), "filming") as bar:
            synthesize(planned, lambda done, total: bar.advance())
    pictures = ", ".join(f"{count} {split}" for split, count in planned.counts.items())
    files = ", ".join([*planned.truth_files, SHEET])
    print(f"{o.output}: {pictures}; {files}{' (made before)' if planned.made else ''}")
    print(f"next: python apps/train.py --data {o.output}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
