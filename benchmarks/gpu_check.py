"""Everything that needs a GPU, in one call: tests, agreement with the CPU, timings beside gsplat's. Writes one JSON.

    python benchmarks/gpu_check.py                          # on a machine with a GPU: a few minutes
    python benchmarks/gpu_check.py --device cpu --quick     # the same logic, small, anywhere

Exit status 1 if a check fails; the JSON is written all the same and says which.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import scgs_warp

import torch  # isort: skip
import warp as wp
from torch import Tensor

from scgs_warp import environment
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.ops.harmonics import spherical_harmonics
from scgs_warp.ops.projection import project
from scgs_warp.ops.ssim import photometric_loss
from scgs_warp.types import Camera, Gaussians

ROOT = Path(__file__).resolve().parent.parent
SCENES = {"49k": (49_000, 800, 800), "1M": (1_000_000, 1920, 1080)}
QUICK_SCENES = {"tiny": (400, 64, 48), "small": (1_000, 80, 70)}
SH_DEGREE = 3
PIXEL_TOLERANCE = 1e-4
LARGEST_DIFFERENCE = 8e-3
"""One alpha threshold that flips moves a pixel by up to 1/255, two by up to this."""
GRADIENT_TOLERANCE = 1e-2


def make_scene(count: int, width: int, height: int, device: str, seed: int = 42) -> tuple[Gaussians, Camera]:
    """Random Gaussians in a ball, smaller the more there are, filling the image of one camera."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    means = direction * torch.rand(count, 1, generator=g) ** (1 / 3)
    size = 0.35 / count ** (1 / 3)
    gaussians = Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=g),
        scales=size * torch.exp(0.5 * torch.randn(count, 3, generator=g)),
        opacities=0.05 + 0.95 * torch.rand(count, generator=g),
        sh_dc=torch.randn(count, 3, generator=g),
        sh_rest=0.2 * torch.randn(count, (SH_DEGREE + 1) ** 2 - 1, 3, generator=g),
    )
    viewmat, K = torch.eye(4), torch.eye(3)
    viewmat[2, 3] = 3.0
    K[0, 0] = K[1, 1] = 1.4 * max(width, height)
    K[0, 2], K[1, 2] = width / 2, height / 2
    moved = Gaussians(**{name: value.to(device) for name, value in vars(gaussians).items()})
    return moved, Camera(viewmat, K, width, height).to(device)


def leaves_of(gaussians: Gaussians) -> dict[str, Tensor]:
    return {name: value.detach().clone().requires_grad_() for name, value in vars(gaussians).items()}


def draw(leaves: dict[str, Tensor], camera: Camera, form: str = "auto") -> tuple[Tensor, Tensor]:
    """[4, H, W] colour and accumulated depth, and alpha [H, W]."""
    geometry = (leaves[name] for name in ("means", "quats", "scales", "opacities"))
    splats = project(*geometry, camera.viewmat, camera.K, camera.width, camera.height)
    colors = spherical_harmonics(leaves["sh_dc"], leaves["sh_rest"], leaves["means"], camera.position, SH_DEGREE)
    channels = torch.cat([colors, splats.depths[:, None]], dim=1)
    return composite(splats, channels, bin_splats(splats), form=form)  # type: ignore[arg-type]


def compare_images(a: Tensor, b: Tensor) -> dict[str, Any]:
    """The rule of agreement: 99.9 % of pixels within the tolerance, none beyond one flipped threshold."""
    difference = (a.detach().cpu() - b.detach().cpu()).abs().amax(0)
    within = float((difference <= PIXEL_TOLERANCE).double().mean())
    largest = float(difference.max())
    passed = within >= 0.999 and largest <= LARGEST_DIFFERENCE
    return {"pixels_within_1e-4": within, "largest_difference": largest, "passed": passed}


def compare_gradients(ours: Tensor, theirs: Tensor) -> dict[str, Any]:
    """Relative L2 per Gaussian, with a floor of 1e-6 of the tensor's norm."""
    a, b = (t.detach().cpu().double().reshape(len(t), -1) for t in (ours, theirs))
    error = (a - b).norm(dim=1) / torch.maximum(b.norm(dim=1), 1e-6 * b.norm())
    p99 = float(error.kthvalue(max(1, int(0.99 * len(error)))).values)
    return {"median": float(error.median()), "p99": p99, "passed": p99 <= GRADIENT_TOLERANCE}


def check_agreement(count: int, width: int, height: int, device: str) -> dict[str, Any]:
    """The device's fastest form against the CPU's (or, on a CPU, against the readable one)."""
    reference_form = "pixel" if device == "cpu" else "auto"
    results, gradients = [], []
    for where, form in ((device, "auto"), ("cpu", reference_form)):
        gaussians, camera = make_scene(count, width, height, where)
        leaves = leaves_of(gaussians)
        image, alpha = draw(leaves, camera, form)
        g = torch.Generator().manual_seed(7)
        v_image = torch.randn(image.shape, generator=g).to(where)
        v_alpha = torch.randn(alpha.shape, generator=g).to(where)
        found = torch.autograd.grad((image, alpha), list(leaves.values()), (v_image, v_alpha))
        gradients.append(dict(zip(leaves, found)))
        results.append(torch.cat([image[:3], alpha[None]]))
    found = {name: compare_gradients(gradients[0][name], gradients[1][name]) for name in gradients[0]}
    image_result = compare_images(*results)
    passed = image_result["passed"] and all(value["passed"] for value in found.values())
    return {"image": image_result, "gradients": found, "passed": passed}


def check_same_bits(count: int, width: int, height: int, device: str) -> dict[str, Any]:
    """Two runs on the device give the same image and the same gradients."""
    runs = []
    for _ in range(2):
        gaussians, camera = make_scene(count, width, height, device)
        leaves = leaves_of(gaussians)
        image, _ = draw(leaves, camera)
        truth = torch.rand(image[:3].shape, generator=torch.Generator().manual_seed(3)).to(device)
        photometric_loss(image[:3], truth)[0].backward()
        runs.append([image.detach(), *(leaf.grad for leaf in leaves.values())])
    return {"passed": all(torch.equal(a, b) for a, b in zip(*runs))}


def time_of(function: Callable[[], Any], device: str, repeats: int) -> dict[str, float]:
    """Median and least milliseconds of a call, after three to warm up."""
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    times = []
    for index in range(repeats + 3):
        wait()
        start = time.perf_counter()
        function()
        wait()
        if index >= 3:
            times.append(1e3 * (time.perf_counter() - start))
    return {"ms_median": statistics.median(times), "ms_min": min(times)}


def gsplat_or_reason(device: str) -> tuple[Callable | None, str]:
    if device != "cuda":
        return None, "gsplat composites on CUDA only"
    try:
        import gsplat

        gaussians, camera = make_scene(100, 32, 32, device)
        rasterize(gsplat.rasterization, leaves_of(gaussians), camera)
    except Exception as error:  # not installed, or its extension cannot be built here
        return None, f"{type(error).__name__}: {str(error).splitlines()[0][:200] if str(error) else ''}"
    return gsplat.rasterization, gsplat.__version__


def rasterize(rasterization: Callable, leaves: dict[str, Tensor], camera: Camera) -> Tensor:
    """[3, H, W] through the entry point that both libraries share."""
    harmonics = torch.cat([leaves["sh_dc"][:, None], leaves["sh_rest"]], dim=1)
    geometry = (leaves[name] for name in ("means", "quats", "scales", "opacities"))
    renders, _, _ = rasterization(
        *geometry,
        harmonics,
        camera.viewmat[None],
        camera.K[None],
        camera.width,
        camera.height,
        sh_degree=SH_DEGREE,
        packed=False,
    )
    return renders[0].permute(2, 0, 1)


def time_scene(count: int, width: int, height: int, device: str, repeats: int) -> dict[str, Any]:
    """Forward, and forward + adjoint, ours and gsplat's; images are compared before anything is timed."""
    from scgs_warp.rasterize import rasterization

    gaussians, camera = make_scene(count, width, height, device)
    leaves = leaves_of(gaussians)
    seed_gradient = torch.rand(3, height, width, generator=torch.Generator().manual_seed(1)).to(device)

    def forward(function: Callable) -> Callable[[], Any]:
        def run() -> None:
            with torch.no_grad():
                rasterize(function, leaves, camera)

        return run

    def both(function: Callable) -> Callable[[], Any]:
        return lambda: torch.autograd.grad(
            rasterize(function, leaves, camera), list(leaves.values()), seed_gradient, allow_unused=True
        )

    row: dict[str, Any] = {"gaussians": count, "width": width, "height": height}
    row["ours"] = {"forward": time_of(forward(rasterization), device, repeats)}
    row["ours"]["both"] = time_of(both(rasterization), device, repeats)
    image = rasterize(rasterization, leaves, camera).detach()
    row["photometric_loss"] = time_of(lambda: photometric_loss(image, seed_gradient), device, repeats)
    theirs, note = gsplat_or_reason(device)
    row["gsplat_note"] = note
    if theirs is not None:
        row["against_gsplat"] = compare_images(image, rasterize(theirs, leaves, camera))
        row["passed"] = row["against_gsplat"]["passed"]
        row["gsplat"] = {"forward": time_of(forward(theirs), device, repeats)}
        row["gsplat"]["both"] = time_of(both(theirs), device, repeats)
    return row


def run_tests(quick: bool) -> dict[str, Any]:
    """The test suite; on a machine with a GPU its ``device`` fixture takes CUDA as well."""
    selection = ["tests/test_ssim.py", "-k", "bad_arguments"] if quick else []
    start = time.perf_counter()
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-x" if quick else "--maxfail=50", "-p", "no:cacheprovider", *selection],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    lines = result.stdout.strip().splitlines()
    failures = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    summary = lines[-1] if lines else result.stderr[-300:]
    seconds = time.perf_counter() - start
    return {"passed": result.returncode == 0, "summary": summary, "failures": failures, "seconds": seconds}


def machine(device: str) -> dict[str, Any]:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.strip()
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "gpu": torch.cuda.get_device_name() if device == "cuda" else None,
        "processor": platform.processor() or platform.machine(),
        "threads": environment.thread_count(),
        "commit": commit or None,
        "scgs_warp": getattr(scgs_warp, "__version__", None),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "warp": wp.__version__,
        "device": device,
    }


def attempt(name: str, report: dict[str, Any], function: Callable[..., dict[str, Any]], *args: Any) -> None:
    """One part that breaks must not take the others with it: the machine may be ours only once."""
    start = time.perf_counter()
    try:
        report[name] = function(*args)
    except Exception as error:
        report[name] = {"passed": False, "error": f"{type(error).__name__}: {error}"}
    passed = report[name].get("passed", True)
    print(f"{name}: {'ok' if passed else 'FAILED'} ({time.perf_counter() - start:.1f} s)", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--quick", action="store_true", help="small scenes and one test: does the script itself work?")
    parser.add_argument("--no-tests", action="store_true", help="leave the test suite out")
    parser.add_argument("--output", type=Path, default=None, help="JSON; by default beside this script")
    options = parser.parse_args()
    if options.device == "cuda" and not torch.cuda.is_available():
        print("gpu_check: torch finds no GPU; use --device cpu --quick to try the script", file=sys.stderr)
        return 2
    environment.configure()
    scenes = QUICK_SCENES if options.quick else SCENES
    target = options.output or ROOT / "benchmarks" / f"gpu_check_{options.device}.json"
    report: dict[str, Any] = machine(options.device)
    first = next(iter(scenes.values()))
    attempt("agreement", report, check_agreement, *first, options.device)
    attempt("same_bits", report, check_same_bits, *first, options.device)
    for name, scene in scenes.items():
        attempt(f"time/{name}", report, time_scene, *scene, options.device, 3 if options.quick else 30)
        target.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    if not options.no_tests:
        attempt("tests", report, run_tests, options.quick)
    report["passed"] = all(v.get("passed", True) for v in report.values() if isinstance(v, dict))
    target.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    print(f"{'all checks passed' if report['passed'] else 'CHECKS FAILED'}: {target}")
    return 0 if report["passed"] else 1


if __name__ == "__main__":
    sys.exit(main())
