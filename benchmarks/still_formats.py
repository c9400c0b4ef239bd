"""Measure what each format of Gaussians at one instant takes, and what it loses.

    python benchmarks/still_formats.py --run runs/figure-quick ... --json benchmarks/results/still-formats.json

The Gaussians of each run at time 0.3 are written in every format, read back and compared. Rows hold `scene`,
`gaussians`, `degree`, `format`, `bytes`; as root mean squares over all Gaussians `position` (in the diameter of the
scene), `scale` (relative), `color`, `opacity`, `rotation` (degrees; half turns about a Gaussian's own axes do not
count), `harmonics`; and `psnr`, the lowest of eight views, against the image of the original, over pixels that show
something in it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from provenance import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from helpers.export_files import gltf_arrays
from scgs_warp.export.still import write_still
from scgs_warp.formats.gaussian_files import read_gaussians
from scgs_warp.formats.gaussian_parameters import to_arrays
from scgs_warp.gaussians import SH_C0
from scgs_warp.geometry.cameras import Overview, orbit_camera
from scgs_warp.geometry.morton import morton_order
from scgs_warp.rendering.render import render
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Gaussians

TIME = 0.3
FORMATS = {
    "ply": ("a.ply", {}),
    "glb": ("a.glb", {}),
    "compressed.ply": ("a.compressed.ply", {}),
    "splat": ("a.splat", {}),
    "spz, version 3": ("a.spz", {"spz_version": 3}),
    "spz": ("a.spz", {"spz_version": 4}),
    "sog": ("a.sog", {}),
}
VIEWS, SIZE = 8, 400
SORTED_BITS = 21
"""Cells along each axis, as a power of 2, for the order of Gaussians in the formats that sort them by place."""


def rows_of(run: Path) -> list[dict[str, Any]]:
    """Measure all formats on one run."""
    scene = Scene.load(run, device="cpu")
    truth = detached(scene.gaussians_at(TIME).plain())
    cameras = [orbit_camera(scene.overview, 360.0 * k / VIEWS, SIZE) for k in range(VIEWS)]
    pictures = [picture(truth, camera) for camera in cameras]
    rows = []
    for name, (file, options) in FORMATS.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / file
            write_still(path, truth, up=scene.overview.up, **options)
            size, found = path.stat().st_size, read(path)
        ordered = in_order_of(file, truth)
        losses = [loss(picture(found, camera), shown) for camera, shown in zip(cameras, pictures)]
        rows.append({
            "scene": run.name, "gaussians": len(truth.means), "degree": math.isqrt(truth.sh_rest.shape[1]),
            "format": name, "bytes": size, **errors(found, ordered, scene.overview), "psnr": min(losses),
        })  # fmt: skip
        print({key: round(value, 6) if isinstance(value, float) else value for key, value in rows[-1].items()})
    return rows


def detached(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{name: value.detach() for name, value in gaussians.tensors().items()})


def read(path: Path) -> Gaussians:
    if path.suffix != ".glb":
        return detached(read_gaussians(path).activate())
    found, e = gltf_arrays(path)[0], "KHR_gaussian_splatting:"
    count = len([name for name in found if "SH_DEGREE" in name])
    rest = [found[f"{e}SH_DEGREE_{d}_COEF_{n}"] for d in range(1, math.isqrt(count)) for n in range(2 * d + 1)]
    columns = (
        found["POSITION"], found[e + "ROTATION"][:, [3, 0, 1, 2]], found[e + "SCALE"], found[e + "OPACITY"][:, 0],
        found[e + "SH_DEGREE_0_COEF_0"], np.stack(rest, 1) if rest else np.zeros((len(found["POSITION"]), 0, 3)),
    )  # fmt: skip
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(column)).float() for column in columns))


def in_order_of(file: str, truth: Gaussians) -> Gaussians:
    """Return the Gaussians in the order in which the format stores them."""
    if file.endswith((".compressed.ply", ".sog")):
        order = morton_order(truth.means.double().numpy(), SORTED_BITS)
    elif file.endswith(".splat"):
        weight = truth.scales.double().numpy().prod(axis=1) * truth.opacities.double().numpy()
        order = np.argsort(-weight, kind="stable")
    else:
        return truth
    rows = torch.from_numpy(order)
    return Gaussians(**{name: value[rows] for name, value in truth.tensors().items()})


def errors(found: Gaussians, truth: Gaussians, overview: Overview) -> dict[str, float | None]:
    a, b = to_arrays(found), to_arrays(truth)
    diameter = 2.0 * overview.radius
    cosine = np.abs((a["quats"] * b["quats"]).sum(axis=1)).clip(0.0, 1.0)
    same = a["sh_rest"].shape == b["sh_rest"].shape
    return {
        "position": rms(np.linalg.norm(a["means"] - b["means"], axis=1)) / diameter,
        "scale": rms(np.expm1(a["log_scales"] - b["log_scales"])),
        "color": rms(SH_C0 * (a["sh_dc"] - b["sh_dc"])),
        "opacity": rms(a["opacities"] - b["opacities"]),
        "rotation": math.degrees(rms(2.0 * np.arccos(cosine))),
        "harmonics": rms(a["sh_rest"] - b["sh_rest"]) if same and a["sh_rest"].size else None,
    }


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values.astype(np.float64) ** 2).mean()))


@torch.no_grad()
def picture(gaussians: Gaussians, camera: Any) -> np.ndarray:
    """Return colours and alpha, [H, W, 4]."""
    image = render(gaussians, camera, torch.zeros(3))
    return torch.cat([image.rgb.clamp(0.0, 1.0), image.alpha[..., None]], dim=2).double().numpy()


def loss(shown: np.ndarray, truth: np.ndarray) -> float:
    """Return the PSNR over the pixels of which the original covers something; at most 120 dB."""
    covered = truth[..., 3] > 1e-3
    squared = float(((shown - truth)[covered][:, :3] ** 2).mean())
    return -10.0 * math.log10(max(squared, 1e-12))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, nargs="+", required=True)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    configure(1)
    rows = [row for run in options.run for row in rows_of(run)]
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/still_formats.py", sys.argv[1:])}
        options.json.write_text(json.dumps({**origin, **provenance("cpu"), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
