"""Run folders: checkpoints to load and to resume, logs, settings, cells of ablations."""

from __future__ import annotations

import functools
import json
import shutil
from pathlib import Path
from typing import Any

import torch

from fuzz.files_cases import (
    Broken,
    Format,
    check_dataset,
    check_gaussians,
    check_numbers,
    expect,
    finite,
    named,
    within,
)
from helpers.cells import craft
from helpers.edit_scenes import OVERVIEW, dress
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.ablation import table as ablate_table
from scgs_warp.ablation.markdown import markdown
from scgs_warp.apps.evaluate import Options, load_data
from scgs_warp.apps.settings import Settings, configuration
from scgs_warp.config.presets import TrainConfig, from_dict, preset, to_dict
from scgs_warp.data import Dataset
from scgs_warp.errors import UserError
from scgs_warp.evaluation.run_time import read_seconds, training_seconds
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.motion import ControlPoints, build_motion
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.training.camera_refinement import refined
from scgs_warp.training.frames import Frames
from scgs_warp.training.run_folder import RunFolder
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step
from scgs_warp.visualization import figures

RUN = ("checkpoint.safetensors", "config.json")


def write_run(folder: Path, scene: Scene) -> None:
    folder.mkdir()
    checkpoint.write(folder, scene.tensors(), {**scene.metadata(), "stage": "main"})
    settings = to_dict(scene.config)
    settings["data"]["folder"] = "/nowhere/data"
    (folder / "config.json").write_text(json.dumps(settings))
    (folder / "metrics.json").write_text(json.dumps({"psnr": 30.0, "seconds": 12.0}))


def write_model(model: str, folder: Path) -> None:
    """Write a scene of 30 Gaussians, static or moved by an untrained network."""
    fields = {"model": model, "nodes": 12, "layers": 3, "width": 16, "skip": 1, "mask": model == "control-points"}
    config = from_dict({"motion": fields})
    torch.manual_seed(0)
    points = torch.rand(30, 3) - 0.5
    motion = build_motion(model, config)
    masked = isinstance(motion, ControlPoints)
    if masked:
        with torch.no_grad():
            motion.positions.copy_(points[:12])
            motion.log_radii.fill_(-1.5)
    made = dress(points, degree=1, shaded=masked, hyper_columns=config.motion.hyper_columns)
    write_run(folder, Scene(made, motion, Normalisation.identity(), config, OVERVIEW))


def load_scene(folder: Path) -> None:
    """Open a run as viewing, evaluation and export do."""
    scene = Scene.load(folder)
    for time in (0.0, 0.37, 1.0):
        check_gaussians(scene.gaussians_at(time))
        finite("control points", scene.control_points_at(time))
    camera = tiny_dataset(2, 32).cameras[0]
    image = scene.render(camera, 0.4)
    finite("image", image.rgb, image.depth)
    within("alpha", image.alpha)
    check_numbers(scene.overview, "overview")
    expect(scene.step >= 0, "step")
    seconds = training_seconds(folder)
    expect(seconds is None or seconds >= 0, "seconds")
    try:
        load_data(scene, Options(run=folder))  # type: ignore[arg-type]
    except UserError as error:
        expect("\n" not in str(error), "a message of several lines")


@functools.cache
def data() -> Dataset:
    return tiny_dataset(6, 32)


@functools.cache
def config_of_run(stage: str) -> TrainConfig:
    """The first step of ``pretrain`` has the ARAP term, which builds the graph."""
    short = {"steps": 0 if stage == "main" else 30, "densify_until": 0 if stage == "main" else 20, "warm_up": 0}
    return tiny_config(60, optim={"cameras": 1e-3}, init_points=60, freeze=0, pretrain=short)


def frames_of(state: TrainState) -> Frames:
    return Frames(data(), state.normalisation, state.config, "cpu")


def write_resumable(folder: Path, stage: str = "main") -> None:
    """Write a run with camera refinement, two steps long."""
    config = config_of_run(stage)
    with RunFolder(folder, config, None, resume=False) as run:
        state = TrainState.begin(config, data(), "cpu")
        frames = frames_of(state)
        run.start(0)
        for _ in range(2):
            training_step(state, frames)
            state.step += 1
            entry = {"step": state.step, "stage": stage, "loss": 0.5, "l1": 0.4, "ssim": 0.1, "psnr": 12.0}
            run.log({**entry, "gaussians": 60})
        state.save(folder)


def load_resumed(folder: Path, stage: str = "main") -> None:
    """Resume as ``--resume`` does: state, log, one step."""
    config = config_of_run(stage)
    with RunFolder(folder, config, None, resume=True) as run:
        state = TrainState.resume(folder, config, data(), "cpu")
        run.start(state.step)
        within("seconds", run.elapsed, 0.0, 1e12)
        for optimizer in state.optimizers():
            for name, group in optimizer.groups.items():
                moments = [m for m in (group.exp_avg, group.exp_avg_sq) if m is not None]
                finite(name, group.parameter.detach(), *moments)
        check_gaussians(state.scene().gaussians_at(0.3))
        expect(0 <= state.step <= config.steps, "step")
        if training_step(state, frames_of(state)).failed is None:  # a failed one is dropped, and changes nothing
            for optimizer in state.optimizers():
                finite("a parameter after a step", *(g.parameter.detach() for g in optimizer.groups.values()))
    check_numbers([read_seconds(folder) or 0.0], "seconds")
    known = refined(data(), folder, state.normalisation)
    if known is not None:
        check_dataset(known)


def write_log(folder: Path) -> None:
    folder.mkdir()
    entries: list[dict[str, Any]] = [{"step": 50 * k, "stage": "main", "loss": 0.5 / k, "psnr": 20.0 + k, "l1": 0.1,
                "gaussians": 1000 * k, "seconds": 3.0 * k} for k in range(1, 6)]  # fmt: skip
    entries.insert(3, {"step": 150, "test_psnr": 22.5, "seconds": 9.5})
    (folder / "log.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))


def load_log(folder: Path) -> None:
    seconds = read_seconds(folder)
    expect(seconds is None or 0 <= seconds < 1e12, f"{seconds} seconds")
    path = folder / "log.jsonl"
    lines = figures.read_log(path)
    figures.curves(path, folder / ".curves.png")
    (folder / ".curves.png").unlink()
    expect(all(isinstance(line, dict) for line in lines), "a line that is no object")
    with RunFolder(folder, preset("cpu"), None, resume=True) as run:
        run.start(200)
        within("seconds", run.elapsed, 0.0, 1e12)


def write_config(folder: Path) -> None:
    folder.mkdir()
    settings = to_dict(preset("cpu"))
    settings["data"]["folder"] = "somewhere"
    (folder / "config.json").write_text(json.dumps(settings))


def load_config(folder: Path) -> None:
    """Read settings as ``--config`` does."""
    found, place = configuration(Settings(), folder / "config.json", {})
    check_numbers(found, "config", 1e9)
    expect(place is None or isinstance(place, str), f"data.folder is {place!r}")


def write_cells(folder: Path) -> None:
    for value, psnr in (("64", 30.0), ("512", 33.0)):
        for seed in (0, 1):
            craft(folder, "nodes", value, seed, psnr=psnr + 0.1 * seed, epe=1.2, jitter=0.3)


def write_zoo(folder: Path) -> None:
    """Cells, and the table of another zoo beside them."""
    worst = {
        "name": "r_019",
        "time": 1.0,
        "missing": 0.041,
        "region": {"share": 0.02, "pixels": 86.0, "x": 120.0, "y": 31.0},
        "images": 1,
    }
    shared = {"psnr_worst_time": 0.5, "missing": 0.01, "missing_worst": worst, "split": "test", "images": 20}
    for scene, psnr in (("rods", 24.0), ("hook", 36.0)):
        craft(folder / "now", "zoo", "zoo", scene=scene, psnr=psnr, psnr_worst=psnr - 3.0, **shared)
        craft(folder / "before", "zoo", "zoo", scene=scene, psnr=psnr, psnr_worst=psnr - 4.0, **shared)
    found = ablate_table.build("zoo", folder / "before")
    shutil.rmtree(folder / "before")
    (folder / "before").mkdir()
    (folder / "before" / "zoo.json").write_text(json.dumps(found))


def load_zoo(folder: Path) -> None:
    check_table(ablate_table.build("zoo", folder / "now", compare=folder / "before"))


def load_table(folder: Path) -> None:
    """Build the table as ``apps/ablate.py --table-only`` does."""
    check_table(ablate_table.build("nodes", folder))


def check_table(found: dict[str, Any]) -> None:
    for table in found["tables"]:
        check_numbers(table["rows"], "table")
    expect(bool(markdown(found)), "no table")
    try:
        json.dumps(found, allow_nan=False)
    except ValueError as error:
        raise Broken(f"the table is no JSON ({error})") from None


FORMATS = (
    Format("checkpoint", functools.partial(write_model, "control-points"), load_scene, named(RUN), share=2.0),
    Format("checkpoint-network", functools.partial(write_model, "per-gaussian"), load_scene, named(RUN[:1])),
    Format("checkpoint-static", functools.partial(write_model, "static"), load_scene, named((*RUN, "metrics.json"))),
    Format("resume", write_resumable, load_resumed, named(("checkpoint.safetensors", "log.jsonl")), share=2.0),
    Format(
        "resume-stage-1",
        functools.partial(write_resumable, stage="pretrain"),
        functools.partial(load_resumed, stage="pretrain"),
        named(("checkpoint.safetensors",)),
        share=0.7,
    ),
    Format("log", write_log, load_log, named(("log.jsonl",)), share=0.3),
    Format("config", write_config, load_config, share=1.5),
    Format("ablation", write_cells, load_table),
    Format("ablation-zoo", write_zoo, load_zoo),
)
