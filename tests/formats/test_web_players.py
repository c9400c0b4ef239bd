"""Files of Gaussians in the programs that people open them with: PlayCanvas' engine, and three.js."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.chromium import chromium
from helpers.edit_scenes import bar_scene
from helpers.export_files import cloud, ordered
from helpers.node_packages import node, package
from helpers.web_server import served
from scgs_warp.export.still import write_still
from scgs_warp.formats.gaussian_files import read_gaussians
from scgs_warp.gaussians import SH_C0
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.rendering.render import render
from scgs_warp.types import Camera, Gaussians

SIZE = 96
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""From y down, z forward to y up, z back."""
SHOW = """
import * as pc from "/playcanvas/build/playcanvas.mjs";

// A picture of a file: RGBA bytes, bottom row first. The camera is camera-to-world, column by column, of OpenGL.
window.show = async (url, matrix, fov, size) => {
  const canvas = document.createElement("canvas");
  document.body.append(canvas);
  const device = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
  device.maxPixelRatio = 1;
  const options = new pc.AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem, pc.RenderComponentSystem,
    pc.LightComponentSystem];
  options.resourceHandlers = [pc.TextureHandler, pc.ContainerHandler, pc.GSplatHandler];
  const app = new pc.AppBase(canvas);
  app.init(options);
  app.setCanvasFillMode(pc.FILLMODE_NONE, size, size);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, size, size);
  app.start();
  const container = url.endsWith(".glb");
  const asset = new pc.Asset("splats", container ? "container" : "gsplat", { url, filename: url.split("/").pop() });
  await new Promise((resolve, reject) => {
    asset.on("load", resolve);
    asset.on("error", (error) => reject(new Error(String(error))));
    app.assets.add(asset);
    app.assets.load(asset);
  });
  const camera = new pc.Entity("camera");
  camera.addComponent("camera", { clearColor: new pc.Color(0, 0, 0, 1), fov, nearClip: 0.01, farClip: 100 });
  const pose = new pc.Mat4();
  pose.data.set(matrix);
  camera.setPosition(pose.getTranslation());
  camera.setRotation(new pc.Quat().setFromMat4(pose));
  app.root.addChild(camera);
  let splat;
  if (container) splat = asset.resource.instantiateRenderEntity();
  else {
    splat = new pc.Entity("splat");
    splat.addComponent("gsplat", { asset, unified: false });
    splat.setLocalEulerAngles(180, 0, 0);  // from y down to y up
  }
  app.root.addChild(splat);
  const frame = (after) => new Promise((resolve) => app.once("frameend", () => { after(); resolve(); }));
  for (let k = 0; k < 30; k++) await frame(() => {});  // a worker sorts
  const { gl } = device, pixels = new Uint8Array(4 * size * size);
  await frame(() => gl.readPixels(0, 0, size, size, gl.RGBA, gl.UNSIGNED_BYTE, pixels));
  app.destroy();
  canvas.remove();
  return Array.from(pixels);
};
window.ready = true;
"""
PAGE = """<!doctype html><link rel="icon" href="data:,"><script type="module" src="/s.js"></script>"""
PARSE = """
const { readFileSync } = require("fs");
(async () => {
  const [folder, file] = process.argv.slice(1);
  const { SPZLoader } = await import(`${folder}/examples/jsm/loaders/SPZLoader.js`);
  const bytes = readFileSync(file);
  const found = await new SPZLoader().parse(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
  const arrays = {};
  for (const name of ["position", "covariance", "color"]) arrays[name] = Array.from(found.getAttribute(name).array);
  console.log(JSON.stringify(arrays));
})();
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator[tuple[Any, Path]]:
    """A page with PlayCanvas' engine, and the folder it is served from."""
    folder = tmp_path_factory.mktemp("web")
    (folder / "playcanvas").symlink_to(package("playcanvas"))
    (folder / "index.html").write_text(PAGE)
    (folder / "s.js").write_text(SHOW)
    with served(folder) as url, chromium() as browser:
        window = browser.new_page()
        problems: list[str] = []
        window.on("pageerror", lambda error: problems.append(str(error)))
        window.set_default_timeout(300e3)
        window.goto(f"{url}/index.html")
        window.wait_for_function("window.ready === true")
        yield window, folder
        assert problems == []


def ours(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    return render(gaussians, camera, torch.zeros(3)).rgb.clamp(0, 1).detach().numpy()


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.sog", "loose/meta.json", "a.glb"])
def test_playcanvas_shows_what_we_show(page, name):
    window, folder = page
    scene = bar_scene()
    truth, path = scene.gaussians_at(0.3), folder / name
    write_still(path, truth)
    shown = truth if name == "a.glb" else read_gaussians(path).activate()  # what the format has left of it
    camera = orbit_camera(scene.overview, 40.0, SIZE)
    place = FLIP @ np.linalg.inv(camera.viewmat.double().numpy()) @ FLIP
    fov = 2 * math.degrees(math.atan(SIZE / 2 / float(camera.K[1, 1])))
    bytes_ = window.evaluate("(given) => window.show(...given)", [f"/{name}", place.T.ravel().tolist(), fov, SIZE])
    found = np.array(bytes_, np.uint8).reshape(SIZE, SIZE, 4)[::-1, :, :3] / 255
    expected = ours(shown, camera)
    assert (expected > 0.1).mean() > 0.02, "there is something to see"
    error = found - expected
    assert np.abs(error).mean() < 0.01 and np.sqrt((error**2).mean()) < 0.03
    write_still(folder / "other.ply", scene.gaussians_at(0.9))
    other = ours(read_gaussians(folder / "other.ply").activate(), camera)
    assert np.sqrt(((found - other) ** 2).mean()) > 2 * np.sqrt((error**2).mean())


@pytest.mark.parametrize("version", [3, 4])
def test_three_reads_spz_in_the_axes_of_the_format(tmp_path, version):
    truth = ordered(cloud())
    write_still(tmp_path / "a.spz", truth, spz_version=version)
    folder = package("three")
    if not (folder / "examples/jsm/loaders/SPZLoader.js").is_file():
        pytest.skip("this three.js has no loader of .spz")
    found = {name: np.array(v) for name, v in json.loads(node("-e", PARSE, folder, tmp_path / "a.spz")).items()}
    means = truth.means.double().numpy() * (1, -1, -1)  # right, up, back
    assert np.abs(found["position"].reshape(-1, 3) - means).max() < 2e-5
    shown = read_gaussians(tmp_path / "a.spz").activate()
    turn = torch.nn.functional.normalize(shown.quats.detach().double(), dim=1)
    w, x, y, z = turn.numpy().T
    axes = np.stack([
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ], 1) * np.array([1, -1, -1])[:, None]  # fmt: skip
    spread = axes * shown.scales.detach().double().numpy()[:, None, :]
    covariance = spread @ spread.transpose(0, 2, 1)
    upper = covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(found["covariance"].reshape(-1, 6), upper, atol=1e-5, rtol=1e-3)
    colors = (0.5 + SH_C0 * shown.sh_dc.detach().double().numpy()).clip(0, 1)
    np.testing.assert_allclose(found["color"].reshape(-1, 4)[:, :3] / 255, colors, atol=1.01 / 255)
    np.testing.assert_allclose(found["color"].reshape(-1, 4)[:, 3] / 255, truth.opacities, atol=1.01 / 255)
