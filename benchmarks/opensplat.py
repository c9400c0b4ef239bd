"""Compare compositing on a CPU with OpenSplat's rasteriser, on one thread and with the same splats.

    git clone https://github.com/pierotofy/OpenSplat /somewhere/else
    python benchmarks/opensplat.py /somewhere/else --json benchmarks/results/opensplat.json

OpenSplat is under the AGPL, and none of it is in this repository. One source file of the checkout is compiled against
the installed torch, with the flags of its release build; that needs a C++ compiler, ninja and some minutes once.

Both sides get the same projected splats of the synthetic scene. OpenSplat's forward pass sorts splats by depth, so ours
is timed with binning, which sorts, too; compositing alone is given beside it. OpenSplat ends a splat at three standard
deviations, this project where alpha falls under 1/255. With OpenSplat's boxes widened to the same distance, the images
must agree. OpenSplat is timed unchanged, and the difference that its own boxes make is stated.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import scgs_warp  # noqa: F401  (before torch)

import torch  # isort: skip
from torch import Tensor

from scgs_warp.benchmark import timing
from scgs_warp.benchmark.gsplat import TOLERANCE, check_agreement
from scgs_warp.benchmark.plan import MIDDLE, posed
from scgs_warp.benchmark.run import write
from scgs_warp.benchmark.scenes import Size, camera_size, load_of, synthetic_scene
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.ops.harmonics import spherical_harmonics
from scgs_warp.ops.projection import project
from scgs_warp.runtime import environment
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.types import Splats

SOURCE = Path("rasterizer/gsplat-cpu/gsplat_cpu.cpp")
HEADER = Path("rasterizer/gsplat-cpu/bindings.h")
WIDENED = 2.0 * math.log(255.0) / 9.0
"""Factor on covariances that takes three standard deviations to the distance where an opaque splat's alpha is 1/255."""
BINDING = """
#include <torch/extension.h>
#include <memory>
#include <vector>
#include "{header}"

// The list of each pixel's splats lives on the C++ side between the passes.
struct Lists {{
    std::unique_ptr<std::vector<int32_t>[]> own;
}};

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {{
    pybind11::class_<Lists>(m, "Lists");
    m.def("forward", [](int width, int height, torch::Tensor xys, torch::Tensor conics, torch::Tensor colors,
            torch::Tensor opacities, torch::Tensor background, torch::Tensor cov2d, torch::Tensor depths) {{
        auto t = rasterize_forward_tensor_cpu(width, height, xys, conics, colors, opacities, background, cov2d, depths);
        auto lists = std::make_unique<Lists>();
        lists->own.reset(std::get<2>(t));
        return std::make_tuple(std::get<0>(t), std::get<1>(t), std::move(lists));
    }});
    m.def("backward", [](int width, int height, torch::Tensor xys, torch::Tensor conics, torch::Tensor colors,
            torch::Tensor opacities, torch::Tensor background, torch::Tensor cov2d, torch::Tensor depths,
            torch::Tensor final_ts, const Lists& lists, torch::Tensor v_image, torch::Tensor v_alpha) {{
        return rasterize_backward_tensor_cpu(height, width, xys, conics, colors, opacities, background, cov2d, depths,
            final_ts, lists.own.get(), v_image, v_alpha);
    }});
}}
"""


def build(checkout: Path, folder: Path, flags: list[str]) -> Any:
    """Compile OpenSplat's CPU rasteriser as a Python module, once per folder and set of flags."""
    from torch.utils.cpp_extension import load

    folder.mkdir(parents=True, exist_ok=True)
    binding = folder / "binding.cpp"
    text = BINDING.format(header=(checkout / HEADER).resolve().as_posix())
    if not binding.is_file() or binding.read_text(encoding="utf-8") != text:
        binding.write_text(text, encoding="utf-8")
    sources = [str(binding), str((checkout / SOURCE).resolve())]
    return load("opensplat_cpu", sources, extra_cflags=flags, build_directory=str(folder), verbose=False)


class Theirs:
    """OpenSplat's two passes on the same splats; its pixel centres are at whole numbers, ours at halves."""

    def __init__(self, module: Any, splats: Splats, colors: Tensor, widen: float = 1.0) -> None:
        self.module, self.size = module, (splats.width, splats.height)
        seen = (splats.radii > 0).all(dim=1)
        a, b, c = splats.conics[seen].unbind(1)
        determinant = a * c - b * b
        cov2d = widen * torch.stack([torch.stack([c, -b], 1), torch.stack([-b, a], 1)], 1) / determinant[:, None, None]
        self.seen = seen
        geometry = splats.means2d[seen] - 0.5, splats.conics[seen], colors[seen], splats.opacities[seen, None]
        rest = torch.zeros(3), cov2d, splats.depths[seen]
        self.inputs = tuple(tensor.detach().contiguous() for tensor in (*geometry, *rest))
        self.no_alpha = torch.zeros(splats.height, splats.width)

    def forward(self) -> tuple[Tensor, Tensor, Any]:
        return self.module.forward(*self.size, *self.inputs)

    def backward(self, drawn: tuple[Tensor, Tensor, Any], v_image: Tensor) -> tuple[Tensor, ...]:
        return self.module.backward(*self.size, *self.inputs, *drawn[1:], v_image, self.no_alpha)


class Ours:
    """Binning and compositing of the same splats."""

    def __init__(self, splats: Splats, colors: Tensor) -> None:
        self.fixed = splats
        names = ("means2d", "conics", "opacities")
        self.leaves = {name: getattr(splats, name).detach().clone().requires_grad_() for name in names}
        self.leaves["colors"] = colors.detach().clone().requires_grad_()
        geometry = {name: self.leaves[name] for name in names}
        self.splats = Splats(**{**vars(splats), **geometry})
        self.tiles = bin_splats(splats)

    def forward(self) -> Tensor:
        """Draw [3, H, W] for the backward pass."""
        return composite(self.splats, self.leaves["colors"], bin_splats(self.fixed))[0]

    def composite_only(self) -> Tensor:
        return composite(self.splats, self.leaves["colors"], self.tiles)[0]

    def backward(self, image: Tensor, v_image: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad(image, tuple(self.leaves.values()), v_image)


def differences(ours: Tensor, theirs: Tensor) -> dict[str, float]:
    difference = (ours - theirs).abs().amax(0)
    within = float((difference <= TOLERANCE).double().mean())
    return {"pixels_within_1e-4": within, "largest": float(difference.max()), "mean": float(difference.mean())}


def relative(ours: Tensor, theirs: Tensor) -> float:
    return float((ours - theirs).double().norm() / theirs.double().norm().clamp(min=1e-30))


def timed(passes: dict[str, Callable[[], Any]], seconds: float) -> dict[str, dict[str, float]]:
    """Time all passes in turns, so that a disturbance affects both sides.

    Return medians and least times in milliseconds.
    """
    times: dict[str, list[float]] = {name: [] for name in passes}
    began = time.perf_counter()
    while time.perf_counter() - began < seconds or len(next(iter(times.values()))) < timing.MIN_REPEATS + 1:
        for name, function in passes.items():
            start = time.perf_counter()
            function()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: {"ms_median": statistics.median(t[1:]), "ms_min": min(t[1:])} for name, t in times.items()}


def compare(module: Any, count: int, size: Size, seconds: float) -> dict[str, Any]:
    scene = synthetic_scene("static", count, 12, "cpu")
    with torch.no_grad():
        gaussians, camera = posed(scene, size, MIDDLE)
        geometry = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
        splats = project(*geometry, camera.viewmat, camera.K, camera.width, camera.height)
        degree = round((1 + gaussians.sh_rest.shape[1]) ** 0.5) - 1
        colors = spherical_harmonics(gaussians.sh_dc, gaussians.sh_rest, gaussians.means, camera.position, degree)
    ours, theirs = Ours(splats, colors), Theirs(module, splats, colors)
    v_image = torch.rand(3, camera.height, camera.width, generator=torch.Generator().manual_seed(1))
    v_planar = v_image.permute(1, 2, 0).contiguous()

    wide = Theirs(module, splats, colors, WIDENED)
    image, drawn = ours.forward(), wide.forward()
    pictures = {"boxes_widened": differences(image.detach(), drawn[0].permute(2, 0, 1))}
    pictures["as_it_is"] = differences(image.detach(), theirs.forward()[0].permute(2, 0, 1))
    check_agreement(image.detach(), drawn[0].permute(2, 0, 1), "OpenSplat")
    v_means, _, v_opacities, v_colors = ours.backward(image, v_image)
    w_means, _, w_colors, w_opacities = wide.backward(drawn, v_planar)
    pairs = {
        "means2d": (v_means, w_means),
        "opacities": (v_opacities[:, None], w_opacities),
        "colors": (v_colors, w_colors),
    }
    gradients = {name: relative(mine[theirs.seen], yours) for name, (mine, yours) in pairs.items()}

    kept = {"ours": ours.forward(), "alone": ours.composite_only(), "theirs": theirs.forward()}

    def keep(name: str, function: Callable[[], Any]) -> Callable[[], None]:
        def call() -> None:
            kept[name] = function()

        return call

    passes = {
        "scgs_warp/forward": keep("ours", ours.forward),
        "scgs_warp/backward": lambda: ours.backward(kept["ours"], v_image),
        "scgs_warp/composite": keep("alone", ours.composite_only),
        "opensplat/forward": keep("theirs", theirs.forward),
        "opensplat/backward": lambda: theirs.backward(kept["theirs"], v_planar),
    }
    rows = timed(passes, seconds)
    median = {name: row["ms_median"] for name, row in rows.items()}
    ratios = {name: median[f"opensplat/{name}"] / median[f"scgs_warp/{name}"] for name in ("forward", "backward")}
    both = [sum(median[f"{side}/{name}"] for name in ratios) for side in ("opensplat", "scgs_warp")]
    load = load_of(gaussians, camera)
    return {
        "gaussians": count,
        "width": camera.width,
        "height": camera.height,
        "threads": 1,
        **load._asdict(),
        "pictures": pictures,
        "gradients_relative": gradients,
        "rows": rows,
        "ratios": {**ratios, "both": both[0] / both[1]},
    }


def commit_of(checkout: Path) -> str | None:
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, help="folder of an OpenSplat checkout")
    parser.add_argument("--gaussians", type=int, default=49_000)
    parser.add_argument("--size", default="800", help="longer side, or WIDTHxHEIGHT")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long the passes are timed, in turns")
    parser.add_argument("--flags", default="-O3 -DNDEBUG", help="for the compiler; by default those of its release")
    parser.add_argument("--build", type=Path, default=None, help="folder for the compiled module; temporary by default")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args()
    for path in (SOURCE, HEADER):
        if not (options.checkout / path).is_file():
            print(f"opensplat: {options.checkout} has no {path}; give a checkout of OpenSplat", file=sys.stderr)
            return 2
    environment.configure(threads=1)
    folder = options.build or Path(tempfile.mkdtemp(prefix="opensplat-"))
    try:
        module = build(options.checkout, folder, options.flags.split())
        comparison = compare(module, options.gaussians, camera_size(options.size), options.seconds)
    finally:
        if options.build is None:
            shutil.rmtree(folder, ignore_errors=True)
    command = command_line("benchmarks/opensplat.py", sys.argv[1:])
    extra = {"opensplat": commit_of(options.checkout), "flags": options.flags}
    report = {"command": command, **provenance("cpu"), "what": "opensplat", **extra, **comparison}
    if options.json is not None:
        write(report, options.json)
    print(json.dumps(report, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
