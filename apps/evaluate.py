"""Score a trained scene on held-out views, and write renders beside the ground truth."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from scgs_warp.apps.arguments import parse
from scgs_warp.apps.cli import Device, prepare, print_parts, run

if TYPE_CHECKING:
    from scgs_warp.data import Dataset
    from scgs_warp.scene.scene import Scene


@dataclass(frozen=True)
class Options:
    """Score a trained scene on held-out views, and write renders beside the ground truth to RUN/evaluation."""

    run: Path
    """Run folder, as apps/train.py writes it."""
    also: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Run folder of a further training of the same data with another seed: score the mean of their pictures. Repeat
    it for more."""
    split: Literal["train", "test", "val"] = "test"
    """Frames to score; training frames are rendered from their refined poses if training refined them."""
    data: Path | None = None
    """Folder of the data set, if it has moved since training."""
    background: Literal["black", "white"] | None = None
    """Colour behind a subject that is cut out; by default that of the training images. Another colour shows what
    training left beside the subject; its files go to RUN/evaluation/SPLIT-COLOUR."""
    lpips_weights: Path | None = None
    """File with VGG16 and LPIPS weights; without it LPIPS is not measured."""
    fit_color: bool = False
    """Also score each image with the affine colour (exposure, white balance) that fits it best. A run with
    optim.frame_colors always gets this score, and one with the colours of the training frames before and after."""
    json: Path | None = None
    """File for the metrics; by default metrics.json in RUN/evaluation/SPLIT, with --also in SPLIT-mean. With it, a run
    that cannot be written is scored without renders."""
    device: Device = "auto"
    """Where to render; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default."""
    memory_gib: float | None = None
    """Limit on memory in GiB (on a GPU, on the memory of the GPU); by default all free memory. Large images are drawn
    in bands, and what does not fit is refused with an error that names its size."""


def check(options: Options) -> None:
    """Refuse impossible options before anything is loaded, and make the folder of --json.

    Raises:
        UserError: names the option and the remedy.
    """
    from scgs_warp.errors import UserError
    from scgs_warp.storage.output_folders import make_parent, refuse_inputs

    if options.also and options.split == "train":
        raise UserError("--also: scores held-out views; leave --split train out")
    if options.json is not None:
        if options.json.is_dir():
            raise UserError(f"--json {options.json}: is a folder; name a file, as {options.json / 'metrics.json'}")
        refuse_inputs(options.json, [options.lpips_weights], options.run, "--json")
        make_parent(options.json)


def load_data(scene: Scene, options: Options) -> Dataset:
    """Load the split with the size, the choice and, unless another is given, the background of the training images.

    Raises:
        UserError: the run does not name its data folder, the folder is missing, or it has no such split; or a
            background is given, and no image has alpha.
    """
    from scgs_warp import data
    from scgs_warp.config.fields import IMAGE_SETTINGS
    from scgs_warp.errors import UserError

    settings: dict[str, Any] = scene.settings.get("data", {})
    folder = options.data or settings.get("folder")
    if not folder:
        raise UserError(f"{options.run}/config.json: data.folder is missing; say where the data lies with --data DIR")
    kept = {key: settings[key] for key in IMAGE_SETTINGS if key in settings}
    if options.data is None and not Path(folder).is_dir():
        raise UserError(f"{folder}: the run's data are no longer there; say where they lie with --data DIR")
    if options.background is not None:
        kept["background"] = options.background
    dataset = data.load(folder, options.split, **kept)
    if options.background is not None and not dataset.with_alpha:
        raise UserError(f"--background {options.background}: the images of {folder} have no alpha; leave it out")
    return dataset


def other_images(run: Path, dataset: Dataset) -> str | None:
    """Say that the images are not those that the run recorded for this split, or return None."""
    from scgs_warp.data.thumbnails import thumbnails
    from scgs_warp.storage import checkpoint
    from scgs_warp.storage.recorded_images import differ

    recorded = checkpoint.read(run, ())[1].get("images")
    if not isinstance(recorded, dict) or not differ(recorded.get(dataset.split), thumbnails(dataset)):
        return None
    return (
        f"{dataset.folder}: its {dataset.split} images are not those with which {run} was trained; scoring them anyway"
    )


def pictures_folder(folder: Path, metrics: Path | None) -> Path | None:
    """Return the folder for renders; if it cannot be written and the metrics go elsewhere, say so and return None.

    Raises:
        UserError: neither renders nor metrics could be written.
    """
    from scgs_warp.errors import UserError
    from scgs_warp.storage.output_folders import make_parent

    try:
        make_parent(folder / "metrics.json")
    except UserError:
        if metrics is None:
            raise UserError(f"{folder}: cannot be written; give --json FILE for the scores alone") from None
        print(f"note: {folder}: cannot be written, so that no renders are kept")
        return None
    return folder


def show(metrics: dict[str, Any], unfinished: str | None) -> None:
    """Print the metrics as a table."""
    from rich.table import Table

    where = unfinished or f"step {metrics['step']:,}"
    table = Table(title=f"{metrics['split']}, {metrics['images']} images, {where}")
    columns = {
        "psnr": "PSNR [dB]",
        "mpsnr": "mPSNR [dB]",
        "psnr_median": "median",
        "psnr_worst": "worst",
        "psnr_fitted": "fitted colour",
        "psnr_interpolated": "interpolated",
        "ssim": "SSIM",
        "lpips": "LPIPS",
        "epe": "EPE [%]",
        "jitter": "jitter [%]",
    }
    columns.update(gaussians="Gaussians", control_points="control points")
    present = [key for key in columns if metrics.get(key) is not None]
    for key in present:
        table.add_column(columns[key], justify="right")
    digits = {
        "psnr": 2,
        "mpsnr": 2,
        "psnr_median": 2,
        "psnr_worst": 2,
        "psnr_fitted": 2,
        "psnr_interpolated": 2,
        "ssim": 4,
        "lpips": 4,
        "epe": 3,
        "jitter": 4,
    }
    cells = [f"{metrics[key]:.{digits[key]}f}" if key in digits else f"{metrics[key]:,}" for key in present]
    table.add_row(*cells)
    print_parts(table)


def main(args: list[str] | None) -> None:
    options = parse(Options, "evaluate", args)
    check(options)
    device = prepare(options.device, options.threads, options.memory_gib)

    from scgs_warp.evaluation.coverage import coverage_line
    from scgs_warp.evaluation.evaluate import metrics_of, write_metrics
    from scgs_warp.evaluation.run_time import training_seconds
    from scgs_warp.runtime.progress import progress
    from scgs_warp.scene.frame_colors import FrameColors
    from scgs_warp.scene.mean import load_mean

    runs = [options.run, *options.also]
    scene = load_mean(runs, device)
    lpips = None
    if options.lpips_weights is not None:
        from scgs_warp.evaluation.image_metrics import LPIPS

        lpips = LPIPS(options.lpips_weights, device)
    dataset = load_data(scene, options)
    recolored = dataset.background != scene.settings.get("data", {}).get("background", dataset.background)
    notes = [*dataset.notes, *filter(None, [None if recolored else other_images(options.run, dataset)])]
    print("\n".join(notes), end="\n" if notes else "")
    poses = "given"
    if options.split == "train":
        from scgs_warp.training.camera_refinement import refined

        corrected = refined(dataset, options.run, scene.normalisation)
        dataset, poses = (dataset, poses) if corrected is None else (corrected, "refined")
    kinds = [options.split, *(["mean"] if options.also else []), *([dataset.background] if recolored else [])]
    folder = options.run / "evaluation" / "-".join(kinds)
    pictures = pictures_folder(folder, options.json)
    known = [seconds for run in runs if (seconds := training_seconds(run)) is not None]
    with progress(len(dataset), "evaluate") as shown:
        metrics = metrics_of(
            scene,
            dataset,
            seconds=sum(known) if len(known) == len(runs) else None,
            lpips=lpips,
            render_dir=pictures,
            progress=lambda done, total: shown.advance(),
            colors=None if options.also else FrameColors.read(options.run),
            fit_color=options.fit_color,
        )
    metrics["poses"] = poses
    if options.also:
        metrics.update(runs=[str(run) for run in runs], epe=None, jitter=None)  # pictures have a mean, tracks have none
    target = options.json or folder / "metrics.json"
    write_metrics(metrics, target)
    show(metrics, scene.unfinished)
    uncovered = coverage_line(metrics)
    if uncovered is not None:
        print(uncovered)
    print("poses: as training refined them" if poses == "refined" else "poses: as the data give them")
    print(f"{'' if pictures is None else f'renders and ground truth: {folder}; '}metrics: {target}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
