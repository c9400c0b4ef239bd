"""Scripts of examples/players: what they show is what the scene shows.

Blender is run where SCGS_BLENDER names a Python that has the package bpy; C# is compiled and run by Mono. Neither Unity
nor Unreal is run: their scripts are compiled against, or called with, the names that they use.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.paths import ROOT
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import rotate, unit
from scgs_warp.export.glb import write_glb
from scgs_warp.export.gltf import upright
from scgs_warp.export.moments import at_rest, even_moments
from scgs_warp.export.part_rig import build_rig
from scgs_warp.export.skeleton import build_skeleton
from scgs_warp.scene.scene import Scene

PLAYERS = ROOT / "examples" / "players"
HERE = Path(__file__).parent
UP = (0.0, 0.0, 1.0)
FRAMES, FPS = 9, 30.0


def moving() -> Scene:
    """A bar that swings, of Gaussians that are longer one way than another."""
    scene = bar_scene(nodes=24, gaussians=150)
    with torch.no_grad():
        scene.gaussians.log_scales += torch.tensor([0.5, 0.0, -0.7])
    return scene


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    """A moving scene by control points, and by parts."""
    folder = tmp_path_factory.mktemp("players")
    scene = moving()
    session, moments = EditSession(scene), even_moments(FRAMES, FPS)
    write_glb(folder / "points.glb", at_rest(scene), UP, build_skeleton(session, moments))
    rig = build_rig(session, session.skeleton, moments, np.ones(150, bool))
    write_glb(folder / "parts.glb", rig.gaussians, UP, rig.skeleton)
    return folder / "points.glb", folder / "parts.glb"


def module(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, PLAYERS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def test_the_reader_shows_the_scene(files):
    scene = moving()
    splats = module("skinned_splats").SkinnedSplats(files[0])
    root = np.array(upright(UP))[[3, 0, 1, 2]]
    for frame in (0, 4, 8):
        truth = scene.gaussians_at(frame / 8)
        means, quats = splats.at(frame / FPS)
        np.testing.assert_allclose(means, rotate(root, truth.means.double().numpy()), atol=5e-6)
        axes = rotate(unit(truth.quats.detach().double().numpy())[:, None], np.eye(3)[None])
        np.testing.assert_allclose(rotate(quats[:, None], np.eye(3)[None]), rotate(root, axes), atol=2e-5)
    between = splats.at(4.5 / FPS)[0]
    assert np.abs(between - 0.5 * (splats.at(4 / FPS)[0] + splats.at(5 / FPS)[0])).max() < 1e-3
    np.testing.assert_allclose(splats.opacities, scene.gaussians.opacities().detach(), atol=1e-6)


@pytest.mark.parametrize("which", [0, 1])
def test_unitys_reader_shows_the_same(files, which, tmp_path):
    if not (shutil.which("mcs") and shutil.which("mono")):
        pytest.skip("Mono is not installed (apt-get install mono-mcs mono-runtime)")
    program = tmp_path / "driver.exe"
    run = lambda *command: subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)  # noqa: E731
    run("mcs", f"-out:{program}", str(HERE / "Driver.cs"), str(PLAYERS / "SkinnedSplats.cs"))
    splats = module("skinned_splats").SkinnedSplats(files[which])
    for seconds in (0.0, 0.11, 0.2666):
        said = run("mono", str(program), str(files[which]), str(seconds), str(tmp_path / "out")).stdout.split()
        found = np.fromfile(tmp_path / "out", "<f4")
        means, quats = splats.at(seconds)
        np.testing.assert_allclose(found[: means.size].reshape(-1, 3), means, atol=2e-6)
        turns = found[means.size :].reshape(-1, 4)[:, [3, 0, 1, 2]]
        np.testing.assert_allclose(np.abs((turns * quats).sum(1)), 1.0, atol=1e-6)
    assert said[1].split(",") == splats.names and float(said[0]) == pytest.approx(8 / FPS)
    sources = [HERE / "UnityStubs.cs", PLAYERS / "SkinnedSplats.cs", PLAYERS / "UnityPlayer.cs"]
    run("mcs", "-target:library", f"-out:{tmp_path / 'unity.dll'}", *map(str, sources))


class FakeUnreal(types.ModuleType):
    """The functions of Unreal's Python that the script calls."""

    def __init__(self) -> None:
        super().__init__("unreal")
        self.arrays: dict[str, list[Any]] = {}
        self.tick: Any = None
        self.NiagaraComponent, self.EditorActorSubsystem = object, object
        actor = types.SimpleNamespace(get_component_by_class=lambda kind: "component")
        self.get_editor_subsystem = lambda kind: types.SimpleNamespace(get_selected_level_actors=lambda: [actor])
        self.Vector = self.Quat = self.LinearColor = lambda *values: values
        keep = lambda component, name, values: self.arrays.__setitem__(name, values)  # noqa: E731
        kinds = {f"set_niagara_array_{kind}": staticmethod(keep) for kind in ("vector", "position", "quat", "color")}
        self.NiagaraDataInterfaceArrayFunctionLibrary = type("Library", (), kinds)
        self.register_slate_post_tick_callback = lambda call: setattr(self, "tick", call) or 7
        self.unregister_slate_post_tick_callback = lambda handle: setattr(self, "tick", None)


def test_unreal_is_given_all_gaussians_in_its_axes(files, monkeypatch):
    fake = FakeUnreal()
    monkeypatch.setitem(sys.modules, "unreal", fake)
    monkeypatch.syspath_prepend(PLAYERS)
    script = module("unreal_play")
    player = script.Player(str(files[0]))
    splats = module("skinned_splats").SkinnedSplats(files[0])
    fake.tick(0.1)
    means, quats = splats.at(0.1)
    swap = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])  # y and z change places: a reflection
    np.testing.assert_allclose(fake.arrays["Positions"], 100.0 * means @ swap.T, atol=1e-9)
    turned = np.array(fake.arrays["Rotations"])[:, [3, 0, 1, 2]]
    matrices = np.swapaxes(rotate(quats[:, None], np.eye(3)[None]), 1, 2)
    found = np.swapaxes(rotate(turned[:, None], np.eye(3)[None]), 1, 2)
    np.testing.assert_allclose(found, swap @ matrices @ swap, atol=1e-9)
    np.testing.assert_allclose(np.array(fake.arrays["Scales"])[:, [0, 2, 1]], 100.0 * splats.scales, rtol=1e-6)
    assert len(fake.arrays["Colors"]) == 150 and len(fake.arrays["Colors"][0]) == 4
    player.stop()
    assert fake.tick is None


@pytest.mark.parametrize("which", [0, 1])
def test_blender_plays_the_file(files, which):
    program = os.environ.get("SCGS_BLENDER")
    if not program:
        pytest.skip("SCGS_BLENDER names no Python with the package bpy (pip install bpy)")
    command = [program, str(HERE / "in_blender.py"), str(files[which]), str(PLAYERS)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.strip().splitlines()[-1])
    splats = module("skinned_splats").SkinnedSplats(files[which])
    assert set(found["bones"]) == set(splats.names)
    assert found["off"] < 2e-6 and found["degrees"] < 0.1 and found["balls"] >= 150
