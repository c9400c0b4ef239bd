"""Files of Gaussians: PLY in text, binary and packed, .splat, .spz of versions 1 to 4, SOG; and glTF."""

from __future__ import annotations

import functools
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fuzz.files_cases import Format, check_gaussians, expect, finite, within
from helpers.edit_scenes import bar_points, dress
from helpers.gltf_files import bar, box, quad
from scgs_warp.data.synthetic.from_mesh import SynthesisRequest, load_subject
from scgs_warp.formats.gaussian_compressed_ply import write_compressed_ply
from scgs_warp.formats.gaussian_files import gaussian_points
from scgs_warp.formats.gaussian_ply import write_gaussian_ply
from scgs_warp.formats.gaussian_sog import write_sog
from scgs_warp.formats.gaussian_splat import write_splat
from scgs_warp.formats.gaussian_spz import write_spz
from scgs_warp.scene.from_gaussians import open_gaussians
from scgs_warp.types import Gaussians

COUNT = 40


@torch.no_grad()
def cloud(degree: int = 1) -> Gaussians:
    return dress(bar_points(COUNT, 0), degree=degree).activate()


def write_text_ply(path: Path) -> None:
    from plyfile import PlyData

    write_gaussian_ply(path, cloud())
    found = PlyData.read(str(path), mmap=False)
    PlyData(list(found.elements), text=True).write(str(path))


def write_old_spz(path: Path, version: int) -> None:
    """Write version 1 or 2: three bytes per rotation; in version 1 half floats as positions."""
    import gzip

    random = np.random.default_rng(0)
    head = struct.pack("<IIIBBBB", 0x5053474E, version, COUNT, 1, 12, 0, 0)
    size = (6 if version == 1 else 9) + 1 + 3 + 3 + 3 + 9
    path.write_bytes(gzip.compress(head + random.integers(0, 256, COUNT * size, np.uint8).tobytes()))


def write_extended_spz(path: Path) -> None:
    """Write version 4 with an extension that names other axes."""
    write_spz(path, cloud())
    content, extra = path.read_bytes(), struct.pack("<III", 0xADBE0003, 4, 11)
    head = content[:14] + bytes([content[14] | 2, content[15]]) + struct.pack("<I", 32 + len(extra)) + content[20:32]
    path.write_bytes(head + extra + content[32:])


def maker(name: str, write: Any) -> Any:
    def make(folder: Path) -> None:
        folder.mkdir()
        write(folder / name)

    return make


def load_gaussians(name: str, folder: Path) -> None:
    """Open as ``apps/export.py --ply``, ``apps/edit.py --ply`` and training from points do."""
    path = folder / name
    scene = open_gaussians(path, nodes=8)
    check_gaussians(scene.gaussians_at(0.3))
    check_gaussians(scene.gaussians.activate())
    finite("overview", scene.overview.radius, *scene.overview.centre)
    finite("normalisation", scene.normalisation.centre, scene.normalisation.scale)
    points, colors = gaussian_points(path)
    finite("points", points)
    within("colours", colors)


def write_gltf(folder: Path) -> None:
    """Write the bar as JSON beside its binary data."""
    folder.mkdir()
    made, _ = bar(4)
    made.document["buffers"] = [{"byteLength": len(made.binary), "uri": "scene.bin"}]
    (folder / "scene.bin").write_bytes(bytes(made.binary))
    (folder / "scene.gltf").write_text(json.dumps(made.document))


def load_mesh(name: str, folder: Path) -> None:
    """Open as ``apps/synthesize.py --mesh`` does."""
    path = folder / name
    subject, _, lines = load_subject(SynthesisRequest(mesh=path), "cpu")
    expect(all("\n" not in line for line in lines), "a line of several")
    points = subject.sample(64, np.random.default_rng(0))
    finite("tracks", subject.track(points, (0.0, 0.3, 1.0)))


def write_textured(path: Path) -> None:
    quad(np.random.default_rng(1).integers(0, 256, (4, 3, 3), np.uint8)).save(path)


def _gaussians(name: str, suffix: str, write: Any, share: float = 1.0) -> Format:
    file = f"scene{suffix}"
    return Format(name, maker(file, write), functools.partial(load_gaussians, file), share=share)


def _mesh(name: str, write: Any, share: float = 1.0) -> Format:
    return Format(name, maker("scene.glb", write), functools.partial(load_mesh, "scene.glb"), share=share)


def write_loose_sog(folder: Path) -> None:
    write_sog(folder / "meta.json", cloud())


def write_old_sog(folder: Path) -> None:
    """Write version 1, with ranges in place of codebooks."""
    write_loose_sog(folder)
    meta = json.loads((folder / "meta.json").read_text())
    del meta["version"], meta["shN"]["bands"], meta["shN"]["count"]
    meta["means"]["shape"] = [meta.pop("count"), 3]
    for name, low, high in (("scales", [-6.0] * 3, [0.0] * 3), ("sh0", [-2.0] * 4, [2.0] * 4), ("shN", -1.0, 1.0)):
        del meta[name]["codebook"]
        meta[name] |= {"mins": low, "maxs": high}
    (folder / "meta.json").write_text(json.dumps(meta))


FORMATS = (
    _gaussians("ply", ".ply", lambda path: write_gaussian_ply(path, cloud()), 2.0),
    _gaussians("ply-text", ".ply", write_text_ply),
    _gaussians("ply-packed", ".compressed.ply", lambda path: write_compressed_ply(path, cloud()), 2.0),
    _gaussians("splat", ".splat", lambda path: write_splat(path, cloud())),
    _gaussians("spz-1", ".spz", functools.partial(write_old_spz, version=1), 0.4),
    _gaussians("spz-2", ".spz", functools.partial(write_old_spz, version=2), 0.6),
    _gaussians("spz-3", ".spz", lambda path: write_spz(path, cloud(), version=3)),
    _gaussians("spz-4", ".spz", lambda path: write_spz(path, cloud())),
    _gaussians("spz-axes", ".spz", write_extended_spz, 0.5),
    _gaussians("sog", ".sog", lambda path: write_sog(path, cloud()), 2.0),
    Format("sog-loose", write_loose_sog, functools.partial(load_gaussians, "meta.json"), share=2.0),
    Format("sog-1", write_old_sog, functools.partial(load_gaussians, "meta.json")),
    _mesh("glb-moving", lambda path: box().save(path)),
    _mesh("glb-skinned", lambda path: bar(4)[0].save(path), 1.5),
    _mesh("glb-textured", write_textured),
    Format("gltf", write_gltf, functools.partial(load_mesh, "scene.gltf")),
)
