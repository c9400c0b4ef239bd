"""Exported glTF in a real browser: three.js plays the animation and skins, and reads the Gaussians."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import trimesh

from helpers.chromium import chromium
from helpers.edit_scenes import bar_scene, figure_scene
from helpers.node_packages import package
from helpers.web_server import served
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import rotate
from scgs_warp.export.control_graph import write_graph
from scgs_warp.export.glb import write_glb
from scgs_warp.export.gltf import upright
from scgs_warp.export.mesh.binding import bind, posed
from scgs_warp.export.mesh.files import write_mesh
from scgs_warp.export.mesh.surface import Surface
from scgs_warp.export.moments import at_rest, even_moments
from scgs_warp.export.part_rig import build_rig
from scgs_warp.export.skeleton import build_skeleton
from scgs_warp.export.still import write_still
from scgs_warp.export.tracks import build_tracks, write_tracks
from scgs_warp.gaussians import SH_C0
from scgs_warp.types import Gaussians

FRAMES, FPS = 9, 4.0
PLAY = """
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
const point = new THREE.Vector3();

// World positions of joints and of bound vertices while the first animation plays.
window.play = async (url, times) => {
  const gltf = await new GLTFLoader().loadAsync(url);
  const skeleton = await gltf.parser.getDependency("skin", 0);
  let bound = null;
  gltf.scene.traverse((item) => { if (item.isSkinnedMesh || item.isPoints) bound = item; });
  if (bound.isPoints) {  // which three.js leaves unbound: bind them by its own skinning
    bound = new THREE.SkinnedMesh(bound.geometry, bound.material);
    bound.bind(skeleton, new THREE.Matrix4());
    gltf.scene.add(bound);
  }
  const mixer = new THREE.AnimationMixer(gltf.scene);
  const action = mixer.clipAction(gltf.animations[0]);
  action.setLoop(THREE.LoopOnce);
  action.clampWhenFinished = true;
  action.play();
  const frames = [];
  for (const time of times) {
    mixer.setTime(time);
    gltf.scene.updateMatrixWorld(true);
    skeleton.update();
    const joints = skeleton.bones.map((bone) => bone.getWorldPosition(point).toArray());
    const vertices = [];
    for (let i = 0; i < bound.geometry.attributes.position.count; i++)
      vertices.push(bound.getVertexPosition(i, point).applyMatrix4(bound.matrixWorld).toArray());
    frames.push({ joints, vertices });
  }
  return { frames, duration: gltf.animations[0].duration };
};

// World positions of a cloud of points while its animation plays.
window.cloud = async (url, times) => {
  const gltf = await new GLTFLoader().loadAsync(url);
  let cloud = null;
  gltf.scene.traverse((item) => { if (item.isPoints) cloud = item; });
  const mixer = new THREE.AnimationMixer(gltf.scene);
  const action = mixer.clipAction(gltf.animations[0]);
  action.setLoop(THREE.LoopOnce);
  action.clampWhenFinished = true;
  action.play();
  const { position } = cloud.geometry.attributes, moves = cloud.geometry.morphAttributes.position;
  return times.map((time) => {
    mixer.setTime(time);
    gltf.scene.updateMatrixWorld(true);
    const points = [];
    for (let i = 0; i < position.count; i++) {
      point.fromBufferAttribute(position, i);
      const base = point.clone(), away = new THREE.Vector3();
      moves.forEach((move, k) => {
        away.fromBufferAttribute(move, i);
        point.addScaledVector(cloud.geometry.morphTargetsRelative ? away : away.sub(base),
          cloud.morphTargetInfluences[k]);
      });
      points.push(point.applyMatrix4(cloud.matrixWorld).toArray());
    }
    return points;
  });
};

// The Gaussians as three.js's own reader of the extension makes them.
window.splats = async (url) => {
  const { GLTFGaussianSplatLoaderExtension } = await import(
    "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js");
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const gltf = await loader.loadAsync(url);
  let found = null;
  gltf.scene.updateMatrixWorld(true);
  gltf.scene.traverse((item) => { if (item.isGaussianSplat) found = item; });
  const arrays = {};
  for (const name of ["position", "covariance", "color"])
    arrays[name] = Array.from(found.splatGeometry.getAttribute(name).array);
  return { arrays, matrix: found.matrixWorld.toArray() };
};
window.ready = true;
"""
PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><script type="importmap">
{"imports": {"three": "/three/build/three.module.js", "three/webgpu": "/three/build/three.webgpu.js",
 "three/tsl": "/three/build/three.tsl.js", "three/addons/": "/three/examples/jsm/"}}
</script><script type="module" src="/play.js"></script>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Iterator:
    """A page with three.js, and the folder it is served from."""
    folder = tmp_path_factory.mktemp("web")
    (folder / "three").symlink_to(package("three"))
    (folder / "index.html").write_text(PAGE)
    (folder / "play.js").write_text(PLAY)
    with served(folder) as url, chromium() as browser:
        window = browser.new_page()
        problems: list[str] = []
        window.on("pageerror", lambda error: problems.append(str(error)))
        window.set_default_timeout(240e3)
        window.goto(f"{url}/index.html")
        window.wait_for_function("window.ready === true")
        yield window, folder
        assert problems == []


def turned(points: np.ndarray, up: tuple[float, float, float]) -> np.ndarray:
    return rotate(np.array(upright(up))[[3, 0, 1, 2]], points)


def test_the_moving_scene_plays_in_three(page):
    window, folder = page
    scene = bar_scene()
    up = scene.overview.up
    write_glb(folder / "a.glb", at_rest(scene), up, build_skeleton(EditSession(scene), even_moments(FRAMES, FPS)))
    seconds = [0.0, 1.0, 2.0]
    found = window.evaluate("([url, times]) => window.play(url, times)", ["/a.glb", seconds])
    assert found["duration"] == pytest.approx((FRAMES - 1) / FPS)
    for frame, time in zip(found["frames"], (0.0, 0.5, 1.0)):
        nodes = turned(scene.control_points_at(time).double().numpy(), up)
        assert np.abs(np.array(frame["joints"]) - nodes).max() < 2e-6
        means = turned(scene.gaussians_at(time).means.double().numpy(), up)
        assert np.abs(np.array(frame["vertices"]) - means).max() < 5e-6
    first, last = (np.array(found["frames"][i]["vertices"]) for i in (0, 2))
    assert np.abs(first - last).max() > 0.1


def test_the_rig_plays_in_three(page):
    window, folder = page
    scene, _, _ = figure_scene(nodes=96, points=1500)
    session, up = EditSession(scene), scene.overview.up
    rig = build_rig(session, session.skeleton, even_moments(FRAMES, FPS), np.ones(len(scene.gaussians), bool))
    write_glb(folder / "r.glb", rig.gaussians, up, rig.skeleton)
    found = window.evaluate("([url, times]) => window.play(url, times)", ["/r.glb", [0.0, 1.0, 2.0]])
    low, high = np.quantile(rig.gaussians.means.numpy(), [0.01, 0.99], axis=0)
    for frame, place in zip(found["frames"], (0, 4, 8)):
        joints = turned(rig.skeleton.positions[place], up)
        assert np.abs(np.array(frame["joints"]) - joints).max() < 5e-6
        means = turned(scene.gaussians_at(place / 8).means.double().numpy(), up)
        off = np.linalg.norm(np.array(frame["vertices"]) - means, axis=1) / np.linalg.norm(high - low)
        assert off.mean() < 2 * rig.loss.mean


def test_tracks_play_in_three(page):
    window, folder = page
    scene = bar_scene()
    up, tracks = scene.overview.up, build_tracks(scene, None, even_moments(FRAMES, FPS), 40)
    write_tracks(folder / "t.glb", tracks, up)
    found = window.evaluate("([url, times]) => window.cloud(url, times)", ["/t.glb", [0.0, 0.75, 2.0]])
    for frame, place in zip(found, (0, 3, 8)):
        assert np.abs(np.array(frame) - turned(tracks.points[place].astype(float), up)).max() < 2e-6


def test_the_graph_plays_in_three(page):
    window, folder = page
    scene = bar_scene()
    session, up = EditSession(scene), scene.overview.up
    skeleton = build_skeleton(session, even_moments(FRAMES, FPS))
    write_graph(folder / "g.glb", skeleton, session.graph.edges, up)
    found = window.evaluate("([url, times]) => window.play(url, times)", ["/g.glb", [0.0, 1.0, 2.0]])
    for frame, time in zip(found["frames"], (0.0, 0.5, 1.0)):
        nodes = turned(scene.control_points_at(time).double().numpy(), up)
        assert np.abs(np.array(frame["joints"]) - nodes).max() < 2e-6
        vertices = np.array(frame["vertices"]).reshape(-1, 6, 3)
        balls, bars = vertices[: len(nodes)], vertices[len(nodes) :]
        assert np.abs(balls.mean(1) - nodes).max() < 5e-6
        ends = bars.reshape(-1, 2, 3, 3).mean(2)
        assert np.abs(ends - nodes[session.graph.edges]).max() < 5e-6


def test_the_moving_mesh_plays_in_three(page):
    window, folder = page
    scene = bar_scene()
    up, frame = scene.overview.up, 3
    skeleton = build_skeleton(EditSession(scene), even_moments(FRAMES, FPS))
    box = trimesh.creation.box((1.2, 0.15, 0.15)).subdivide().subdivide()
    surface = Surface(np.asarray(box.vertices) + np.array([0.5, -1.0, 0.25]), np.asarray(box.faces, np.int32))
    tracks = np.stack([scene.gaussians_at(frame / (FRAMES - 1)).means.double().numpy()] * 2)
    bound = bind(surface, tracks, skeleton)
    colors = np.full((len(surface.vertices), 3), 0.5)
    write_mesh(folder / "m.glb", surface, colors, up, skeleton=bound, frame=frame)
    found = window.evaluate("([url, times]) => window.play(url, times)", ["/m.glb", [0.0, frame / FPS, 2.0]])
    for shown, at in zip(found["frames"], (0, frame, FRAMES - 1)):
        expected = turned(posed(surface.vertices, bound, frame, at), up)
        assert np.abs(np.array(shown["vertices"]) - expected).max() < 5e-6
    first, last = (np.array(found["frames"][i]["vertices"]) for i in (0, 2))
    assert np.abs(first - last).max() > 0.1


def test_three_reads_the_gaussians(page):
    window, folder = page
    gaussians = bar_scene().gaussians_at(0.5)
    gaussians = Gaussians(**{name: value.detach() for name, value in gaussians.tensors().items()})
    write_still(folder / "s.glb", gaussians, up=(0.0, 0.0, 1.0))
    found = window.evaluate("(url) => window.splats(url)", "/s.glb")
    matrix = np.array(found["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-6)
    arrays = {name: np.array(values, np.float64).reshape(400, -1) for name, values in found["arrays"].items()}
    np.testing.assert_array_equal(arrays["position"], gaussians.means.double().numpy())
    quats = gaussians.quats.double().numpy()
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    axes = gaussians.scales.double().numpy()[:, :, None] * rotate(quats[:, None], np.eye(3)[None])
    spread = np.einsum("nki,nkj->nij", axes, axes)
    upper = spread[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(arrays["covariance"], upper, rtol=1e-5, atol=1e-6 * upper.max())
    colors = np.column_stack([0.5 + SH_C0 * gaussians.sh_dc.double().numpy(), gaussians.opacities.double().numpy()])
    np.testing.assert_allclose(arrays["color"], 255 * colors.clip(0, 1), atol=0.51)
