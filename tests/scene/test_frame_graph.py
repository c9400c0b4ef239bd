"""Recorded frames: the images of frames drawn step by step, whatever changes between them; none lacks splats."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from scgs_warp.benchmark import scenes
from scgs_warp.config.presets import MOTIONS
from scgs_warp.kernels.cpu import skinning
from scgs_warp.motion import network
from scgs_warp.motion.base import Motion
from scgs_warp.rendering.render import render
from scgs_warp.runtime import memory
from scgs_warp.scene import frame_graph
from scgs_warp.scene.frame_graph import CAPACITY_STEP, RECORD_AFTER, FrameGraph
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Camera, Image


def scene_of(model: str, device: str) -> Scene:
    return scenes.synthetic_scene(model, 600, 30, device)


def truth(scene: Scene, camera: Camera, time: float, color: torch.Tensor) -> Image:
    """Drawn step by step, with the exact number of pairs."""
    with torch.no_grad():
        posed = scene.motion.gaussians_at(scene.gaussians, time)
        view = scene.normalisation.apply_camera(camera)
        image = render(posed, view.to(scene.device), color.to(scene.device), antialiased=scene.config.antialiased)
        return Image(image.rgb, image.alpha, scene.normalisation.undo_scale(image.depth))


def assert_same(actual: Image, expected: Image) -> None:
    for name, value in vars(expected).items():
        assert torch.equal(getattr(actual, name), value), name
    assert expected.alpha.max() > 0.5


class Overwriting:
    """On a CPU: replays into the same memory, as a graph does."""

    overwrites = True

    def __init__(self, body: Callable[[], Any]) -> None:
        self.body, self.result = body, body()

    def replay(self) -> Any:
        image, total = self.body()
        for name, value in vars(image).items():
            getattr(self.result[0], name).copy_(value)
        self.result[1].copy_(total)
        return self.result


@pytest.fixture(autouse=True)
def graphs_overwrite(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_graph, "PlainGraph", Overwriting)


@pytest.mark.parametrize("model", MOTIONS)
def test_frames_are_those_drawn_step_by_step(device: str, model: str):
    scene = scene_of(model, device)
    scene.normalisation = type(scene.normalisation)(scene.normalisation.centre + 0.1, 1.3)
    frames = scene.frame_graph()
    found, expected = [], []
    for turn, time in ((0.0, 0.2), (50.0, 0.9), (120.0, 0.0), (200.0, 1.0), (10.0, 0.55)):
        camera = scenes.scene_camera(scene, (90, 70), turn)
        color = torch.tensor([0.1, turn / 400, 0.9])
        found.append(frames.render(scene.normalisation.apply_camera(camera), time, color))
        expected.append(truth(scene, camera, time, color))
    assert frames.recordings == 1 and frames.failure is None
    for actual, image in zip(found, expected, strict=True):
        assert_same(actual, image)


def test_scene_renders_through_it_on_cuda_only(device: str, monkeypatch: pytest.MonkeyPatch):
    scene = scene_of("control-points", device)
    camera = scenes.scene_camera(scene, (64, 48))
    asked = []
    original = scene.frame_graph
    monkeypatch.setattr(scene, "frame_graph", lambda: asked.append(True) or original())
    image = scene.render(camera, 2.0, (0.2, 0.3, 0.4))
    assert_same(image, truth(scene, camera, 1.0, torch.tensor([0.2, 0.3, 0.4])))
    assert bool(asked) == (device == "cuda")


def test_a_motion_that_needs_the_time_on_the_host_is_refused(device: str):
    class Host(Motion):
        name = "host"

    with pytest.raises(ValueError, match="motion host"):
        FrameGraph(scene_of("static", device).gaussians, Host())


def test_overflow_draws_the_frame_again_with_more_room(device: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(frame_graph, "CAPACITY_STEP", 16)
    scene = scene_of("control-points", device)
    frames = scene.frame_graph()
    color = torch.zeros(3)
    near, far = (scenes.scene_camera(scene, (90, 70)) for _ in range(2))
    far.K[:2, :2] *= 0.1  # everything in few tiles
    for _ in range(RECORD_AFTER + 1):
        assert_same(frames.render(far, 0.3, color), truth(scene, far, 0.3, color))
    small = frames.capacity
    pending = [frames.submit(camera, 0.6, color) for camera in (near, far, near)]
    assert [int(torch.as_tensor(p.total)) > small for p in pending if synchronised(p)] == [True, False, True]
    for actual, camera in zip([frames.finish(p) for p in pending], (near, far, near), strict=True):
        assert_same(actual, truth(scene, camera, 0.6, color))
    assert frames.capacity > small
    large, recordings = frames.capacity, frames.recordings
    assert_same(frames.render(near, 0.61, color), truth(scene, near, 0.61, color))
    assert frames.capacity == large and frames.recordings == recordings == 2


def synchronised(pending: frame_graph.Pending) -> bool:
    if pending.done is not None:
        pending.done.synchronize()
    return True


def test_recorded_anew_only_when_something_changed(device: str):
    scene = scene_of("control-points", device)
    frames = scene.frame_graph()
    color = torch.zeros(3)
    small, large = scenes.scene_camera(scene, (64, 48)), scenes.scene_camera(scene, (90, 70))

    def check(camera: Camera, recordings: int) -> None:
        for time in (0.1, 0.4, 0.8, 0.9):
            assert_same(frames.render(camera, time, color), truth(scene, camera, time, color))
        assert frames.recordings == recordings

    check(small, 1)
    check(small, 1)
    check(large, 2)
    with torch.no_grad():
        scene.gaussians.means[:300] *= 1.1
    check(large, 3)
    scene.gaussians.sh_dc = torch.nn.Parameter(scene.gaussians.sh_dc + 0.1)
    check(large, 4)
    with torch.no_grad():
        scene.motion.get_parameter("network.head.bias").add_(0.02)
    check(large, 5)
    scene.freeze_binding()
    check(large, 5)
    assert scene.frame_graph() is frames
    scene.motion = scene_of("static", device).motion
    assert scene.frame_graph() is not frames


class NoHost(TorchDispatchMode):
    """Refuses what makes the host wait for the device, or copies from the host: neither can be recorded."""

    FORBIDDEN = ("aten._local_scalar_dense", "aten.lift_fresh", "aten.nonzero", "aten.masked_select", "aten.is_nonzero")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if str(func).startswith(self.FORBIDDEN):
            raise AssertionError(f"{func} in a frame")
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("model", MOTIONS)
@torch.no_grad()
def test_nothing_in_a_frame_asks_the_host(model: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(network, "supported", lambda *_: False)  # network and skinning as on CUDA
    monkeypatch.setattr(skinning, "MAX_NEIGHBORS", 0)
    scene = scene_of(model, "cpu")
    frames = scene.frame_graph()
    frames.render(scenes.scene_camera(scene, (64, 48)), 0.5, torch.zeros(3))
    with NoHost():
        frames.draw_steps()
        with pytest.raises(AssertionError, match="in a frame"):
            torch.tensor([1.0])
        with pytest.raises(AssertionError, match="in a frame"):
            float(frames.inputs[0])


def test_a_single_picture_is_not_recorded(device: str):
    scene = scene_of("static", device)
    camera = scenes.scene_camera(scene, (64, 48))
    for _ in range(RECORD_AFTER):
        scene.frame_graph().render(camera, 0.0, torch.zeros(3))
    assert scene.frame_graph().recordings == 0


def test_room_is_a_multiple_and_has_a_limit(monkeypatch: pytest.MonkeyPatch):
    frames = FrameGraph(*(getattr(scene_of("static", "cpu"), name) for name in ("gaussians", "motion")))
    for pairs in (0, 1, CAPACITY_STEP, 10 * CAPACITY_STEP + 1):
        assert frames.make_room(pairs, (64, 48))
        assert frames.capacity % CAPACITY_STEP == 0 and frames.capacity >= max(1.2 * pairs, 1)
    monkeypatch.setattr(memory, "fits", lambda need, device: True)
    assert frames.make_room(frame_graph.MAX_ROOM, (64, 48))
    assert frames.capacity == frame_graph.MAX_ROOM
    assert not frames.make_room(frame_graph.MAX_ROOM + 1, (64, 48))
    monkeypatch.setattr(memory, "fits", lambda need, device: False)
    assert not frames.make_room(1, (64, 48))
    assert frames.capacity == frame_graph.MAX_ROOM


def test_a_frame_without_room_is_drawn_step_by_step(device: str, monkeypatch: pytest.MonkeyPatch):
    """And those after it from a recording, once there is room."""
    scene = scene_of("control-points", device)
    camera, color = scenes.scene_camera(scene, (90, 70)), torch.zeros(3)
    frames = scene.frame_graph()
    with monkeypatch.context() as patch:
        patch.setattr(frame_graph, "bytes_within", lambda *_: 1 << 60)
        assert_same(frames.render(camera, 0.3, color), truth(scene, camera, 0.3, color))
    assert frames.capacity == 1
    for time in (0.4, 0.5, 0.6, 0.7):
        assert_same(frames.render(camera, time, color), truth(scene, camera, time, color))
    assert frames.capacity >= CAPACITY_STEP and frames.recordings == 1
