"""Make a data set with known motion: ``python apps/synthesize.py --subject balls --output data/balls``."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from scgs_warp.apps.arguments import parse, refuse_given
from scgs_warp.apps.cli import Device, prepare, run
from scgs_warp.errors import shell_words


@dataclass(frozen=True)
class FilmOptions:
    """Options of --film."""

    film: Literal["phone", "rig"] | None = None
    """Instead of images, make films of the subject in a furnished room, for capture.py: with a phone in the hand, or
    with --views cameras that stand still. truth.npz holds poses, offsets and exposures; a phone's folder also
    trains as it is."""
    seconds: float = 6.0
    """Length of a film."""
    fps: float = 30.0
    """Frames per second of a film."""
    shake: float = 1.0
    """Strength of the movements of the hand that holds the phone; 0: none."""
    blur: float = 0.0
    """Motion blur: share of the time between two frames in which the shutter is open; phones are near 0.5 indoors."""
    rolling: float = 0.0
    """Rolling shutter: share of the time between two frames from the first row to the last; phones are near 0.5."""
    exposure: float = 0.0
    """Largest relative change of the exposure during a film, for example 0.2."""
    balance: float = 0.0
    """Largest relative change of red and blue against green during a film."""
    crf: int = 20
    """Compression of a film: x264's constant rate factor, 0 (lossless) to 51; phones are near 23."""
    arc: float = 100.0
    """Arc around the subject, in degrees, along which the cameras of a rig stand or the phone walks."""
    offsets: float = 0.0
    """Largest difference, in seconds, between the moments at which two cameras of a rig begin."""
    sound: bool = True
    """Record claps in the room, which allow capture.py to synchronise the cameras of a rig."""
    maps: bool = False
    """Also write the depth, the flow to the next frame and a mask of the subject for every frame of a film. The data
    set of a phone's film then names the depth maps."""
    depth_error: float = 0.0
    """Relative error of the depth maps of the data set, smooth over each image, for example 0.04; needs --maps."""


@dataclass(frozen=True)
class Output:
    """Option that --help lists first."""

    output: Path
    """Folder to make, with transforms_train.json, train/ and so on, ground_truth.npz, contact_sheet.png."""


@dataclass(frozen=True)
class Options(FilmOptions, Output):
    """Render a built-in subject or an animated mesh: images in D-NeRF layout and the true motion of the surface, for
    train.py --data. With --film, a film for capture.py."""

    mesh: Path | None = None
    """File .glb or .gltf; skins, moving nodes and morph targets are animated."""
    subject: str | None = None
    """Built-in subject instead of a file: robot (the default), rods, rods-dark, balls, balls-steady, cloth, fan,
    touch, opening, still."""
    clip: str | None = None
    """Name of the animation; the first one that moves by default. With an unknown name, the command lists all names."""
    start: float | None = None
    """Second of the clip that becomes time 0; its first keyframe by default."""
    end: float | None = None
    """Second of the clip that becomes time 1; its last keyframe by default."""
    size: tuple[int, ...] | None = None
    """Size of the images in pixels: one number, or width and height. 400 by default, and 640 360 for a film."""
    train: int | None = None
    """Training times, spread over the motion; each gives one image per camera. 100 with --subject, otherwise 150."""
    test: int = 20
    """Test images, spread over the motion, each from its own position."""
    val: int = 10
    """Validation images, like the test images; 0 for none."""
    cameras: Literal["sphere", "path"] = "sphere"
    """sphere: positions on a dome, new for every image (with several --views, fixed); path: cameras that move round the
    figure."""
    views: int | None = None
    """Number of synchronised cameras; 1, the default, is monocular, more are a rig. 6 for --film rig."""
    turns: float = 1.0
    """Number of times that a camera path goes round the figure; less than 1 is an arc."""
    elevation: tuple[float, float] = (2.866, 58.212)
    """Elevation of the lowest and the highest camera, degrees."""
    fov: float | None = None
    """Horizontal field of view, degrees: 39.6 by default, and cameras stand where the whole motion just fits the image;
    65 for a film."""
    samples: int | None = None
    """Rays per pixel and axis: 4, the default, gives 16 rays per pixel, 1 no anti-aliasing. 3 for a film."""
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
    two_sided: bool = False
    """Show the backs of surfaces that the file of --mesh shows from one side only."""
    seed: int = 0
    """Random seed of cameras and surface points; the same seed gives the same bytes."""
    device: Device = "auto"
    """Where to cast rays; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default."""


OF_IMAGES = ("clip", "start", "end", "train", "val", "cameras", "turns", "elevation", "background", "light", "ambient",
             "diffuse", "unlit", "two_sided")  # fmt: skip
"""Options that a film does not have."""


def check_unused(options: Options) -> None:
    """Refuse options that would have no effect.

    Raises:
        UserError: names the option, and what it belongs to.
    """
    from scgs_warp.errors import UserError

    if options.film is None:
        refuse_given(options, [field.name for field in fields(FilmOptions)], "belongs to a film; give --film, too")
        return
    if options.mesh is not None:
        raise UserError(f"--mesh {options.mesh}: --film shows a built-in subject; give --subject, or leave out --film")
    refuse_given(options, OF_IMAGES, "belongs to images; leave it out with --film")
    if options.film == "rig":
        refuse_given(options, ("shake", "test"), "belongs to --film phone; leave it out for a rig")
    elif options.views != 1 or options.offsets:
        refuse_given(options, ("offsets", "views"), "belongs to --film rig; leave it out for a phone")


def main(args: list[str] | None) -> None:
    options = parse(Options, "synthesize", args)
    check_unused(options)
    device = prepare(options.device, options.threads)

    from scgs_warp.errors import UserError

    if options.size is not None and len(options.size) not in (1, 2):
        raise UserError(f"--size {' '.join(map(str, options.size))}: give one number, or width and height")
    if options.film is None:
        _render(options, device)
    else:
        _film(options, options.film, device)


def _render(options: Options, device: str) -> None:
    """Make a data set of images."""
    from scgs_warp.data.synthetic.from_mesh import SHEET, SynthesisRequest, plan_synthesis, synthesize
    from scgs_warp.data.synthetic.mesh import Shading
    from scgs_warp.data.synthetic.orbit_cameras import FilmingSettings
    from scgs_warp.runtime.progress import progress

    o = options
    size = o.size or (400,)
    train = o.train if o.train is not None else 150 if o.subject is None else 100
    fov = FilmingSettings.fov if o.fov is None else o.fov
    views = 1 if o.views is None else o.views
    filming = FilmingSettings(size[0], size[-1], train, o.test, o.val, o.cameras, views, fov, o.elevation, o.turns)
    shading = Shading(o.light, o.ambient, o.diffuse, o.unlit, o.two_sided)
    samples = 4 if o.samples is None else o.samples
    request = SynthesisRequest(
        o.mesh, o.clip, o.start, o.end, filming, shading, samples, o.background, o.seed, o.subject
    )
    planned = plan_synthesis(o.output, request, device)
    print("\n".join(planned.lines), flush=True)
    if not planned.made:
        with progress(sum(planned.counts.values()), "filming") as bar:
            synthesize(planned, lambda done, total: bar.advance())
    pictures = ", ".join(f"{count} {split}" for split, count in planned.counts.items())
    files = ", ".join([*planned.truth_files, SHEET])
    print(f"{o.output}: {pictures}; {files}{' (made before)' if planned.made else ''}")
    print(f"next: python apps/train.py --data {shell_words(o.output)}")


def _film(options: Options, kind: Literal["phone", "rig"], device: str) -> None:
    """Make a film, or those of a rig."""
    from scgs_warp.data.synthetic.films import FilmRequest, make_film, plan_film
    from scgs_warp.runtime.progress import progress

    o = options
    given = {"fov": o.fov, "samples": o.samples, "views": o.views, "subject": o.subject}
    if o.size is not None:
        given |= {"width": o.size[0], "height": o.size[-1]}
    named = [field.name for field in fields(FilmOptions) if field.name != "film"]
    common = {name: getattr(o, name) for name in (*named, "test", "seed")}
    request = FilmRequest(kind, **common, **{name: value for name, value in given.items() if value is not None})
    plan = plan_film(o.output, request, device)
    if not plan.made:
        with progress(plan.pictures, "filming") as bar:
            make_film(plan, bar.advance)
    files = ", ".join(take.file for take in plan.shooting.takes)
    print(f"{o.output}: {files}, truth.npz{' (made before)' if plan.made else ''}")
    folder = str(o.output)
    source = ["--rig", folder] if kind == "rig" else [str(o.output / plan.shooting.takes[0].file)]
    print(f"next: python apps/capture.py {shell_words(*source, '--output', f'{folder}-captured')}")
    if kind == "phone":
        print(f"with the true cameras: python apps/train.py --data {shell_words(folder)}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
