"""Exported files, read back for comparison."""

from __future__ import annotations

import gzip
import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scipy.spatial import KDTree

from helpers.edit_scenes import dress
from helpers.paths import ROOT
from helpers.scenes import look_at
from scgs_warp.edit.rotations import multiply
from scgs_warp.gaussians import SH_C0
from scgs_warp.ops.harmonics_rotation import rotate_harmonics
from scgs_warp.rendering.render import render
from scgs_warp.types import Camera, Gaussians


def gltf_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """Attributes of the only primitive, by pygltflib, and the node that shows it."""
    pygltflib = pytest.importorskip("pygltflib", reason="the package pygltflib is not installed")
    gltf = pygltflib.GLTF2().load(str(path))
    blob, found = gltf.binary_blob(), {}
    types = {5126: "<f4", 5121: "u1", 5123: "<u2"}
    for name, index in vars(gltf.meshes[0].primitives[0].attributes).items():
        if index is None:
            continue
        accessor = gltf.accessors[index]
        view = gltf.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        values = np.frombuffer(blob, types[accessor.componentType], accessor.count * width, start)
        found[name] = values.reshape(-1, width).astype(np.float64)
    node = next(node for node in gltf.nodes if node.mesh is not None)
    return found, {"node": node, "gltf": gltf}


def picture(gaussians: Gaussians) -> torch.Tensor:
    eye = torch.tensor([0.5, -3.0, 0.8], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    K = torch.tensor([[80.0, 0, 32], [0, 80, 32], [0, 0, 1]])
    camera = Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up).float(), K, 64, 64)
    return render(gaussians, camera, torch.zeros(3)).rgb


@torch.no_grad()
def cloud(count: int = 300, degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(5)
    made = dress(0.5 * torch.randn(count, 3, generator=generator) + torch.tensor([0.3, -0.2, 0.1]), degree=degree)
    made.opacity_logits.copy_(2.0 * torch.randn(count, generator=generator))
    made.log_scales.add_(0.4 * torch.randn(count, 3, generator=generator))
    return made.activate()


def ordered(gaussians: Gaussians) -> Gaussians:
    """By x, so that files which sort can be compared; quaternions unit, w positive."""
    order = gaussians.means[:, 0].argsort()
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    parts = {**gaussians.tensors(), "quats": quats}
    return Gaussians(**{name: value.detach()[order] for name, value in parts.items()})


def ply_columns(path: Path, sort: bool = False) -> dict[str, np.ndarray]:
    """A .ply by plyfile; ``sort``: in the order of :func:`ordered`."""
    data = PlyData.read(str(path))["vertex"].data
    order = np.argsort(data["x"], kind="stable") if sort else np.arange(len(data))
    return {name: np.asarray(data[name], np.float64)[order] for name in data.dtype.names}


def turned(found: dict[str, np.ndarray], signs: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """The columns of a .ply, turned by half a turn, or not at all; ``signs`` says which coordinates change sign."""
    if signs == (1, 1, 1):
        return found
    half = torch.tensor([[float(sign > 0) if sum(signs) < 0 else 0.0 for sign in signs]])
    half = torch.cat([torch.zeros(1, 1), half], 1).expand(len(found["x"]), 4).contiguous()
    found = found | {axis: sign * found[axis] for axis, sign in zip("xyz", signs)}
    quats = multiply(half.double().numpy(), columns(found, "rot", 4))
    quats = multiply(quats, half.double().numpy())  # a Gaussian looks the same after half a turn about its own axis
    found |= {f"rot_{i}": quats[:, i] for i in range(4)}
    rest = len([name for name in found if name.startswith("f_rest_")])
    if rest:
        values = torch.from_numpy(columns(found, "f_rest", rest)).float().reshape(len(half), 3, -1).transpose(1, 2)
        rotated = rotate_harmonics(values.contiguous(), half).double().transpose(1, 2).reshape(len(half), rest).numpy()
        found |= {f"f_rest_{i}": rotated[:, i] for i in range(rest)}
    return found


def matched(found: dict[str, np.ndarray], truth: Gaussians) -> dict[str, np.ndarray]:
    """The rows of a .ply in the order of the Gaussians whose positions they have, for files that sort and round."""
    rows = nearest(np.stack([found[axis] for axis in "xyz"], 1), truth)
    return {name: values[rows] for name, values in found.items()}


def nearest(places: np.ndarray, truth: Gaussians) -> np.ndarray:
    """The row of the nearest of the places, for every Gaussian; each is the nearest of one."""
    _, rows = KDTree(places).query(truth.means.detach().double().numpy())
    assert len(places) == len(truth.means) and len(set(rows)) == len(rows), "positions have moved too far to be matched"
    return rows


def columns(found: dict[str, np.ndarray], name: str, count: int) -> np.ndarray:
    return np.stack([found[f"{name}_{i}"] for i in range(count)], 1)


def difference(found: dict[str, np.ndarray], truth: Gaussians) -> dict[str, float]:
    """Largest differences of a .ply's activated columns; rotations in degrees."""
    quats = columns(found, "rot", 4)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    other = torch.nn.functional.normalize(truth.quats.double(), dim=1).numpy()
    chord = np.minimum(np.linalg.norm(quats - other, axis=1), np.linalg.norm(quats + other, axis=1))
    means = np.stack([found[axis] for axis in "xyz"], 1)
    errors = {
        "means": np.abs(means - truth.means.double().numpy()).max(),
        "scales": np.abs(columns(found, "scale", 3) - truth.scales.double().log().numpy()).max(),
        "opacities": np.abs(1 / (1 + np.exp(-found["opacity"])) - truth.opacities.double().numpy()).max(),
        "colors": np.abs(SH_C0 * (columns(found, "f_dc", 3) - truth.sh_dc.double().numpy())).max(),
        "degrees": np.degrees(4 * np.arcsin(chord / 2)).max(),
    }
    rest = 3 * truth.sh_rest.shape[1]
    if rest and "f_rest_0" in found:
        values = columns(found, "f_rest", rest).reshape(len(means), 3, -1).transpose(0, 2, 1)
        errors["harmonics"] = np.abs(values - truth.sh_rest.double().numpy()).max()
    return {name: float(value) for name, value in errors.items()}


def zeros_spz(path: Path, count: int) -> Path:
    """A file of harmonics of degree 3 that are all the same: a thousandth of what it holds."""
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, count, 3, 12, 0, 0)
    path.write_bytes(gzip.compress(head + bytes(65 * count)))
    return path


def documented_player() -> dict:
    """The functions of the script in docs/formats.md that plays a .npz."""
    script = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "formats.md").read_text(encoding="utf-8"), re.DOTALL)[
        0
    ]
    names: dict = {}
    exec(script, names)
    return names


def npz_player(path: Path) -> Callable[[float], Gaussians]:
    """Gaussians of a .npz at a second, by the script in docs/formats.md."""
    play, scene = documented_player()["play"], dict(np.load(path, allow_pickle=False))

    def at(seconds: float) -> Gaussians:
        means, quats, scales, sh_dc = play(scene, seconds)
        parts = means, quats, scales, scene["opacities"], sh_dc, scene["sh_rest"]
        return Gaussians(*(torch.from_numpy(np.asarray(part)).float() for part in parts))

    return at


def fourdgs_player(path: Path) -> Callable[[float], Gaussians]:
    """Gaussians of a .4dgs at a second, by the format's reference implementation; harmonics of the first keyframe."""
    pytest.importorskip("fourdgs", reason="the package fourdgs is not installed")
    from fourdgs import keyframe_delta_file, opcode, serialization

    data, bands = path.read_bytes(), {}
    decoded = keyframe_delta_file.decode_streamed(data)
    for record in serialization.iter_records(data, 8):
        if record.opcode == opcode.SH_BAND_STREAM:
            cursor = serialization.Cursor(record.content)
            band = cursor.u8()
            codes = serialization.decode_stream(cursor)[1]
            bands.setdefault(band, -4.0 + codes.reshape(-1, 3, 2 * band + 1).transpose(0, 2, 1) * 8.0 / 255.0)
    count = int(decoded.header.gaussian_count)
    rest = np.concatenate([bands[band] for band in sorted(bands)], 1) if bands else np.zeros((count, 0, 3))

    def at(seconds: float) -> Gaussians:
        found = keyframe_delta_file.render_at(decoded, seconds + 1e-9)
        quats, sh_dc = found["rotations"][:, [3, 0, 1, 2]], (found["rgb"] - 0.5) / SH_C0
        parts = found["centers"], quats, found["scales"], found["opacity"], sh_dc, rest
        return Gaussians(*(torch.from_numpy(np.ascontiguousarray(part)).float() for part in parts))

    return at
