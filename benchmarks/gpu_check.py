"""Check and measure everything that needs a GPU in one call: agreement, timings beside gsplat's, tests.

    python benchmarks/gpu_check.py                            # on a machine with a GPU: all parts
    python benchmarks/gpu_check.py --parts frames,dynamic     # some of them
    python benchmarks/gpu_check.py --seconds 540              # no part begins after that time
    python benchmarks/gpu_check.py --device cpu --quick       # the same logic, small, anywhere

The result is one JSON, which is written after every part. A part that breaks is recorded there, and the others run.
The exit status is 1 if a check fails or if there was no time for a part.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import scgs_warp

import torch  # isort: skip
import gpu_trust
from gpu_rules import compare_gradients, compare_images, motion_ms, time_of, two_under_way
from torch import Tensor

from scgs_warp.benchmark.plan import MIDDLE, BenchPlan, posed
from scgs_warp.benchmark.run import bench
from scgs_warp.benchmark.scenes import load_of, scene_camera, synthetic_scene
from scgs_warp.benchmark.summary import table_s2
from scgs_warp.benchmark.workloads import Leaves
from scgs_warp.config.presets import MOTIONS
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.binning_cuda import bin_within
from scgs_warp.ops.compositing import composite
from scgs_warp.ops.harmonics import spherical_harmonics
from scgs_warp.ops.projection import project
from scgs_warp.ops.ssim import photometric_loss
from scgs_warp.rendering.render import render
from scgs_warp.runtime import environment
from scgs_warp.runtime.provenance import provenance
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Camera, Image, Splats

ROOT = Path(__file__).resolve().parent.parent
FRAMES_A_SECOND = 1000.0
MOTION_MS = 0.15
"""Targets on a GPU: frames per second of the moving scene, and milliseconds for its motion."""
SLOWEST_FORM = 50_000
"""Largest number of Gaussians for which the slow forms of compositing are timed."""
SHARPNESS = 0.5
"""Second sharpness at which the forms are compared, that of the presets."""


class Setting(NamedTuple):
    device: str
    quick: bool
    scenes: dict[str, tuple[int, tuple[int, int]]]
    """Number of Gaussians and image size, by name; the first entry is that of the moving scene."""
    nodes: int
    repeats: int
    seconds: float
    """Seconds to spend on every row of the step and stage timings."""


Report = dict[str, Any]


def setting(device: str, quick: bool) -> Setting:
    if quick:
        return Setting(device, True, {"tiny": (400, (64, 48)), "small": (900, (80, 70))}, 40, 2, 0.02)
    scenes = {"49k": (49_000, (800, 800)), "1M": (1_000_000, (1920, 1080))}
    return Setting(device, False, scenes, 512, 30, 1.0)


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


def agreement(s: Setting) -> Report:
    """Compare the images and gradients of the device's fastest form of compositing with the CPU's.

    On a CPU the comparison is with the readable pixel form. A second run must have the same bits as the first.
    """
    count, size = next(iter(s.scenes.values()))
    leaves = leaves_of(count, size, s.device)
    ours, again = drawn(leaves, "auto"), drawn(leaves, "auto")
    truth = drawn(leaves_of(count, size, "cpu"), "pixel" if s.device == "cpu" else "auto")
    report = compare(ours, truth, list(leaves.gaussians.tensors()))
    report["same_bits"] = all(torch.equal(a, b) for a, b in zip(ours, again))
    return {**report, "passed": report["passed"] and report["same_bits"]}


def forms(s: Setting) -> Report:
    """Compare every form of compositing on the device with the readable pixel form, and time it."""
    names = ("cuda", "blocks") if s.device == "cuda" else ("cpu",)
    report: Report = {"passed": True}
    for scene, (count, size) in s.scenes.items():
        leaves = leaves_of(count, size, s.device)
        for form in names if count <= SLOWEST_FORM else names[:1]:
            report[f"{scene}/{form}"] = form_times(leaves, form, s)
        if count > SLOWEST_FORM:
            continue
        for sharpness in (0.0, SHARPNESS):
            truth = drawn(leaves, "pixel", sharpness)
            for form in names:
                row = compare(drawn(leaves, form, sharpness), truth, list(leaves.gaussians.tensors()))
                report[f"{scene}/{form}"].update({"sharp": row} if sharpness else row)
                report["passed"] = report["passed"] and row["passed"]
    return report


def form_times(leaves: Leaves, form: str, s: Setting) -> Report:
    """Time the compositing of three channels alone, without projection and binning."""
    own, camera = leaves.gaussians, leaves.camera
    with torch.no_grad():
        splats = project(*leaves.geometry, camera.viewmat, camera.K, camera.width, camera.height)
        colors = spherical_harmonics(own.sh_dc, own.sh_rest, own.means, camera.position, leaves.degree)
        tiles = bin_splats(splats)
    inputs = [x.detach().requires_grad_() for x in (splats.means2d, splats.conics, splats.opacities, colors)]
    held = replace(splats, means2d=inputs[0], conics=inputs[1], opacities=inputs[2])

    def forward() -> Tensor:
        return composite(held, inputs[3], tiles, form=form)[0]  # type: ignore[arg-type]

    both = time_of(lambda: torch.autograd.grad(forward(), inputs, leaves.v_image), s.device, s.repeats)
    with torch.no_grad():
        return {"pairs": len(tiles.splats), "forward": time_of(forward, s.device, s.repeats), "both": both}


def stepwise(scene: Scene, camera: Camera, at: float) -> Image:
    """Draw a frame without a recorded graph, with lists of exactly as many pairs of splat and tile as there are."""
    with torch.no_grad():
        view = scene.normalisation.apply_camera(camera).to(scene.device)
        color = torch.tensor(scene.background_color, device=scene.device)
        image = render(
            scene.motion.gaussians_at(scene.gaussians, at), view, color, antialiased=scene.config.antialiased
        )
        return Image(image.rgb, image.alpha, scene.normalisation.undo_scale(image.depth))


def frames(s: Setting) -> Report:
    """Compare recorded frames with frames drawn step by step (``same_bits``: equal to the last bit) and with the CPU's.

    Every motion model that can be recorded draws five frames, the last with too small a capacity for its pairs.
    """
    report: Report = {"passed": True}
    for motion in MOTIONS:
        report[motion] = frames_of(motion, s)
        report["passed"] = report["passed"] and report[motion]["passed"]
    return report


def frames_of(motion: str, s: Setting) -> Report:
    count, size = next(iter(s.scenes.values()))
    scene, reference = (synthetic_scene(motion, count, s.nodes, device) for device in (s.device, "cpu"))
    if not scene.motion.takes_time_tensor:
        return {"recordable": False, "passed": True}
    graph, color = scene.frame_graph(), torch.tensor(scene.background_color)
    pairs = load_of(*posed(scene, size, MIDDLE), False).pairs
    checks, same = {}, []
    for index, at in enumerate((0.5, 0.1, 0.9, 0.3, 0.7)):
        if index == 4:
            graph.capacity, graph._recorded = max(1, pairs // 3), None
        camera = scene_camera(scene, size, 30.0 * index)
        image = graph.render(scene.normalisation.apply_camera(camera), at, color)
        truth = stepwise(scene, camera, at)
        same.append(all(torch.equal(a, b) for a, b in zip(vars(image).values(), vars(truth).values())))
        checks[f"frame {index}"] = compare_images(image.rgb.permute(2, 0, 1), truth.rgb.permute(2, 0, 1))["passed"]
    camera = scene_camera(scene, size)
    images = [one.render(camera, 0.5).rgb.permute(2, 0, 1) for one in (scene, reference)]
    against_cpu = compare_images(*images)
    checks["cpu"] = against_cpu["passed"]
    checks["recorded"] = graph.failure is None and graph.recordings > 0
    checks["room grew"] = graph.capacity > max(1, pairs // 3)
    figures = {"pairs": pairs, "capacity": graph.capacity, "recordings": graph.recordings, "failure": graph.failure}
    figures["same_bits"] = same
    return {"recordable": True, **figures, "cpu": against_cpu, "checks": checks, "passed": all(checks.values())}


def raster_of(leaves: Leaves, rasterization: Callable[..., Any], s: Setting) -> Report:
    def forward() -> None:
        with torch.no_grad():
            leaves.rasterize(rasterization)

    def both() -> None:
        torch.autograd.grad(leaves.rasterize(rasterization), (*leaves.geometry, leaves.harmonics), leaves.v_image)

    return {"forward": time_of(forward, s.device, s.repeats), "both": time_of(both, s.device, s.repeats)}


def raster(s: Setting) -> Report:
    """Time ``rasterization`` as a whole, and its forward stages one by one."""
    report: Report = {}
    for name, (count, size) in s.scenes.items():
        leaves = leaves_of(count, size, s.device)
        whole = raster_of(leaves, scgs_warp.rasterization, s)
        report[name] = {"gaussians": count, "size": size, **whole, **stage_times(leaves, s)}
    return report


@torch.no_grad()
def stage_times(leaves: Leaves, s: Setting) -> Report:
    own, camera = leaves.gaussians, leaves.camera

    def projected() -> Splats:
        return project(*leaves.geometry, camera.viewmat, camera.K, camera.width, camera.height)

    def colored() -> Tensor:
        return spherical_harmonics(own.sh_dc, own.sh_rest, own.means, camera.position, leaves.degree)

    splats, colors = projected(), colored()
    tiles = bin_splats(splats)
    image, room = composite(splats, colors, tiles)[0], max(1, len(tiles.splats))
    stages: dict[str, Callable[[], Any]] = {
        "project": projected,
        "harmonics": colored,
        "bin": lambda: bin_splats(splats),
        "bin_within": lambda: bin_within(splats, room, slots=False),
        "composite": lambda: composite(splats, colors, tiles),
        "photometric_loss": lambda: photometric_loss(image, leaves.v_image),
    }
    times = {stage: time_of(call, s.device, s.repeats) for stage, call in stages.items()}
    return {"pairs": len(tiles.splats), "stages": times}


def gsplat(s: Setting) -> Report:
    """Compare images with gsplat's, then time both renderers; building gsplat's extension may take minutes."""
    if s.device != "cuda":
        return {"skipped": "gsplat composites on CUDA only"}
    import gsplat as peer

    report: Report = {"version": peer.__version__, "passed": True}
    for name, (count, size) in s.scenes.items():
        leaves = leaves_of(count, size, s.device)
        with torch.no_grad():
            images = [leaves.rasterize(function) for function in (scgs_warp.rasterization, peer.rasterization)]
        row: Report = {"images": compare_images(*images)}
        row["ours"], row["theirs"] = (raster_of(leaves, f, s) for f in (scgs_warp.rasterization, peer.rasterization))
        row["ratio"] = {key: row["theirs"][key]["ms_median"] / row["ours"][key]["ms_median"] for key in row["ours"]}
        row["passed"] = row["images"]["passed"] and min(row["ratio"].values()) >= 1.0
        report[name] = row
        report["passed"] = report["passed"] and row["passed"]
    return report


def dynamic(s: Setting) -> Report:
    """Time frames of the moving scene with every motion model.

    The result has frames per second, the share of the time that motion takes, and the relative speeds of Table S2.
    """
    rows = [dynamic_row(name, s) for name in MOTIONS]
    for row in rows:
        row["ratios"] = {peer["motion"]: row["fps"] / peer["fps"] for peer in rows}
    moving = next(row for row in rows if row["motion"] == "control-points")
    goals = {"frames a second": moving["fps"] >= FRAMES_A_SECOND, "motion": moving["motion_ms"] <= MOTION_MS}
    share = moving["motion_ms"] * moving["fps"] / 1e3
    passed = s.device != "cuda" or all(goals.values())
    return {"rows": rows, "table_s2": table_s2(rows), "motion_share": share, "goals": goals, "passed": passed}


def dynamic_row(motion: str, s: Setting) -> Report:
    count, size = next(iter(s.scenes.values()))
    scene = synthetic_scene(motion, count, s.nodes, s.device)
    camera, repeats, numbers = scene_camera(scene, size), 5 * s.repeats, itertools.count()
    row: Report = {"name": "frame", "motion": motion, "threads": environment.thread_count()}
    row.update(time_of(lambda: scene.render(camera, (0.37 * next(numbers)) % 1.0), s.device, repeats))
    row["motion_ms"] = motion_ms(scene, s.device, s.repeats)
    row["step_by_step"] = time_of(lambda: stepwise(scene, camera, 0.3), s.device, s.repeats)
    best = row["ms_in_a_row"]
    if scene.motion.takes_time_tensor:
        graph = scene.frame_graph()
        row["ms_two_under_way"] = two_under_way(graph, scene, camera, repeats)
        best = min(best, row["ms_two_under_way"])
        row.update(failure=graph.failure, capacity=graph.capacity)
    return {**row, "fps": 1e3 / best}


def step(s: Setting) -> Report:
    """Time training steps at half the size, with and without ARAP, and their stages."""
    count, size = next(iter(s.scenes.values()))
    half = (size[0] // 2, size[1] // 2)
    plan = BenchPlan(
        None, min(count, 40_000), s.nodes, half, ("control-points",), s.device, (environment.thread_count(),), s.seconds
    )
    return {"rows": bench("step", plan)["rows"]}


PARTS: dict[str, Callable[[Setting], Report]] = {
    **{part.__name__: part for part in (agreement, frames, forms, raster, dynamic, step, gsplat)},
    "fuzz": lambda s: gpu_trust.fuzz(s.device, s.quick),
    "crowded": lambda s: gpu_trust.crowded(s.device, s.quick),
    "share": lambda s: gpu_trust.share(s.device),
    "tests": lambda s: gpu_trust.tests(s.quick),
}


def attempt(name: str, report: Report, function: Callable[..., Report], *args: Any) -> None:
    """Run one part; record its failure instead of raising it, so that the others run."""
    start = time.perf_counter()
    try:
        report[name] = function(*args)
    except Exception as error:
        report[name] = {"passed": False, "error": f"{type(error).__name__}: {error}", "trace": traceback.format_exc()}
    report[name]["seconds"] = time.perf_counter() - start
    passed = report[name].get("passed", True)
    print(f"{name}: {'ok' if passed else 'FAILED'} ({report[name]['seconds']:.1f} s)", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--quick", action="store_true", help="small scenes and one test, to try the script itself")
    parser.add_argument("--parts", default=",".join(PARTS), help="parts to run, of %(default)s")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="no part begins after that time")
    parser.add_argument("--output", type=Path, default=None, help="JSON; by default beside this script")
    options = parser.parse_args()
    parts = options.parts.split(",")
    if unknown := [part for part in parts if part not in PARTS]:
        parser.error(f"--parts: {', '.join(unknown)} not known; choose from {', '.join(PARTS)}")
    if options.device == "cuda" and not torch.cuda.is_available():
        print("gpu_check: torch finds no GPU; use --device cpu --quick to try the script", file=sys.stderr)
        return 2
    environment.configure()
    target = options.output or ROOT / "benchmarks" / f"gpu_check_{options.device}.json"
    gpu = torch.cuda.get_device_name() if options.device == "cuda" else None
    report: Report = {**provenance(options.device), "gpu": gpu, "device": options.device}
    start = time.perf_counter()
    for part in parts:
        if time.perf_counter() - start < options.seconds:
            attempt(part, report, PARTS[part], setting(options.device, options.quick))
        else:
            report[part] = {"passed": False, "error": "no time left"}
        report["passed"] = all(report[name].get("passed", True) for name in parts if name in report)
        target.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(f"{'all checks passed' if report['passed'] else 'CHECKS FAILED'}: {target}")
    return 0 if report["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
