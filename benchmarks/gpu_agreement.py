"""Parts of ``gpu_check`` for correctness: a GPU against the CPU, and everything against itself to the last bit."""

from __future__ import annotations

import tempfile
from pathlib import Path
from unittest import mock

import torch
from gpu_rules import compare_gradients, compare_images
from gpu_session import Call, Report, Setting
from torch import Tensor

from scgs_warp.benchmark.plan import MIDDLE, posed
from scgs_warp.benchmark.scenes import load_of, scene_camera, synthetic_scene, training_data
from scgs_warp.benchmark.workloads import Leaves
from scgs_warp.config.presets import MOTIONS, TrainConfig, from_dict, preset, with_steps
from scgs_warp.data.dataset import Dataset
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.ops.harmonics import spherical_harmonics
from scgs_warp.ops.projection import project
from scgs_warp.rendering.render import render
from scgs_warp.scene.scene import Scene
from scgs_warp.training import loop, stepping
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.types import Camera, Image

SHARPNESS = 0.5
"""Second sharpness at which results are compared, that of the presets."""
STEPS = 90
"""Number of training steps that are compared, through both stages and densification."""
CHECKPOINT = "checkpoint.safetensors"


def leaves_of(count: int, size: tuple[int, int], device: str) -> Leaves:
    """Make the Gaussians of the synthetic figure at rest, as leaf tensors that receive gradients."""
    return Leaves(*posed(synthetic_scene("static", count, 0, device), size, MIDDLE))


def drawn(leaves: Leaves, form: str, sharpness: float = 0.0) -> list[Tensor]:
    """Return image [4, H, W] (colour, depth), alpha [1, H, W], and the gradients of all leaves for random gradients of
    both images."""
    own, camera = leaves.gaussians, leaves.camera
    view = camera.viewmat, camera.K, camera.width, camera.height
    splats = project(*leaves.geometry, *view, sharpness=sharpness)
    colors = spherical_harmonics(own.sh_dc, own.sh_rest, own.means, camera.position, leaves.degree)
    channels = torch.cat([colors, splats.depths[:, None]], dim=1)
    image, alpha = composite(splats, channels, bin_splats(splats), form=form)  # type: ignore[arg-type]
    random = torch.Generator().manual_seed(7)
    v_image = torch.randn(image.shape, generator=random).to(image.device)
    v_alpha = torch.randn(alpha.shape, generator=random).to(image.device)
    gradients = torch.autograd.grad((image, alpha), list(own.tensors().values()), (v_image, v_alpha))
    return [image.detach(), alpha.detach()[None], *gradients]


def compare(results: list[Tensor], truth: list[Tensor], names: list[str]) -> Report:
    image = compare_images(torch.cat([results[0][:3], results[1]]), torch.cat([truth[0][:3], truth[1]]))
    gradients = {n: compare_gradients(a, b) for n, a, b in zip(names, results[2:], truth[2:], strict=True)}
    passed = image["passed"] and all(value["passed"] for value in gradients.values())
    return {"image": image, "gradients": gradients, "passed": passed}


def agreement(call: Call) -> Report:
    """Compare images, gradients and moving frames of the device with the CPU's.

    On a CPU its fastest form of compositing is compared with the readable plain form.
    """
    s = call.setting
    count, size = next(iter(s.scenes.values()))
    leaves, reference = (leaves_of(count, size, device) for device in (s.device, "cpu"))
    report: Report = {}
    for sharpness in (0.0, SHARPNESS):
        truth = drawn(reference, "plain" if s.device == "cpu" else "auto", sharpness)
        report[f"sharpness {sharpness}"] = compare(
            drawn(leaves, "auto", sharpness), truth, list(leaves.gaussians.tensors())
        )
    for motion in MOTIONS:
        scenes = [synthetic_scene(motion, count, s.nodes, device) for device in (s.device, "cpu")]
        images = [scene.render(scene_camera(scene, size), 0.3).rgb.permute(2, 0, 1) for scene in scenes]
        report[motion] = compare_images(*images)
    return {**report, "passed": all(row["passed"] for row in report.values())}


def bits(call: Call) -> Report:
    """Compare to the last bit: two runs, recorded frames with frames drawn step by step, recorded training steps with
    plain ones.

    ``hexplane`` trains without the promise of same bits, so only its frames are compared.
    """
    s = call.setting
    count, size = next(iter(s.scenes.values()))
    leaves = leaves_of(count, size, s.device)
    first, second = drawn(leaves, "auto"), drawn(leaves, "auto")
    report: Report = {"image and gradients": {"passed": _equal(first, second)}}
    for motion in MOTIONS:
        report[f"frames of {motion}"] = frames_of(motion, s)
    report["steps"] = steps_of(s)
    return {**report, "passed": all(row["passed"] for row in report.values())}


def _equal(a: list[Tensor], b: list[Tensor]) -> bool:
    return all(torch.equal(one, other) for one, other in zip(a, b, strict=True))


def stepwise(scene: Scene, camera: Camera, at: float) -> Image:
    """Draw a frame without a recorded graph, with lists of exactly as many pairs of splat and tile as there are."""
    with torch.no_grad():
        view = scene.normalisation.apply_camera(camera).to(scene.device)
        color = torch.tensor(scene.background_color, device=scene.device)
        image = render(
            scene.motion.gaussians_at(scene.gaussians, at), view, color, antialiased=scene.config.antialiased
        )
        return Image(image.rgb, image.alpha, scene.normalisation.undo_scale(image.depth))


def frames_of(motion: str, s: Setting) -> Report:
    """Draw five frames, the last with too small a capacity for its pairs, from a recording and step by step."""
    count, size = next(iter(s.scenes.values()))
    scene = synthetic_scene(motion, count, s.nodes, s.device)
    if not scene.motion.takes_time_tensor:
        return {"recordable": False, "passed": True}
    graph, color = scene.frame_graph(), torch.tensor(scene.background_color)
    pairs = load_of(*posed(scene, size, MIDDLE), False).pairs
    checks, differences = {}, []
    for index, at in enumerate((0.5, 0.1, 0.9, 0.3, 0.7)):
        if index == 4:
            graph.capacity, graph._recorded = max(1, pairs // 3), None
        camera = scene_camera(scene, size, 30.0 * index)
        image = graph.render(scene.normalisation.apply_camera(camera), at, color)
        truth = stepwise(scene, camera, at)
        checks[f"frame {index}"] = _equal(list(vars(image).values()), list(vars(truth).values()))
        differences.append(float((image.rgb - truth.rgb).abs().max()))
    checks["recorded"] = graph.failure is None and graph.recordings > 0
    checks["room grew"] = graph.capacity > max(1, pairs // 3)
    figures = {"pairs": pairs, "capacity": graph.capacity, "recordings": graph.recordings, "failure": graph.failure}
    return {"recordable": True, **figures, "differences": differences, "checks": checks, "passed": all(checks.values())}


def small_run(s: Setting) -> tuple[TrainConfig, Dataset]:
    """Return the configuration and the images of a run that passes both stages and densifies."""
    count, size = (300, (48, 40)) if s.quick else (10_000, (200, 200))
    steps = STEPS // 3 if s.quick else STEPS
    changes = {
        "init_points": count,
        "checkpoint_seconds": 1e9,
        "evaluate_every": 10 * steps,
        "motion": {"nodes": 16, "layers": 3, "width": 32, "skip": 2} if s.quick else {},
        "densify": {"every": 10, "start": 10, "opacity_reset_every": 10_000, "sh_every": 20},
        "pretrain": {"densify_every": 3},
    }
    data = training_data(synthetic_scene("control-points", count, s.nodes, s.device), size)
    return from_dict(changes, "gpu_check", with_steps(preset("cpu"), steps)), data


def steps_of(s: Setting) -> Report:
    """Train three times, the last time without recorded steps, and compare the checkpoints byte by byte."""
    config, data = small_run(s)
    takers: list[stepping.PlainSteps | RecordedSteps] = []
    saved = []
    for recorded in (True, True, False):

        def chosen(state, frames, tell, recorded=recorded, choose=stepping.steps_of):
            takers.append(choose(state, frames, tell) if recorded else stepping.PlainSteps(state, frames))
            return takers[-1]

        with tempfile.TemporaryDirectory() as folder, mock.patch.object(loop, "steps_of", chosen):
            loop.fit(config, data, output=folder, device=s.device)
            saved.append((Path(folder) / CHECKPOINT).read_bytes())
    checks = {"two runs": saved[0] == saved[1], "recorded and plain": saved[1] == saved[2]}
    figures: Report = {"steps": config.steps}
    if isinstance(taker := takers[0], RecordedSteps):
        figures.update(recordings=taker.recordings, repeats=taker.repeats, failure=taker.failure)
        checks["recorded"] = taker.failure is None and taker.recordings > 0
    return {**figures, "checks": checks, "passed": all(checks.values())}
