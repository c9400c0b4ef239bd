"""Recorded steps against step by step ones: the same bits, whatever fails or is replaced between them."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch

from helpers.filmed_blobs import film, with_depth
from helpers.steps import PRETENDED, begin
from helpers.tiny import tiny_dataset
from scgs_warp import optim
from scgs_warp.motion import rigidity
from scgs_warp.ops.adam import adam_step
from scgs_warp.ops.step_outcome import UpdateTable
from scgs_warp.training import depth, recorded_step, recorded_update
from scgs_warp.training.density_control import control_density, density_due
from scgs_warp.training.frames import Frames
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.recorded_update import RecordedUpdate
from scgs_warp.training.state import StepResult, TrainState
from scgs_warp.training.step import training_step

MODELS = {
    "control-points": {},
    "per-gaussian": {"motion": {"model": "per-gaussian"}, "coarse": 6},
    "hexplane": {"motion": {"model": "hexplane"}, "coarse": 6},
    "static": {"motion": {"model": "static"}},
}


@pytest.fixture(autouse=True)
def _portable_adam(monkeypatch):
    """Let both forms update with the kernel that runs on any device; the one in SIMD rounds differently."""
    monkeypatch.setattr(optim, "adam_step", partial(adam_step, form="plain"))


def tensors(state: TrainState) -> dict[str, torch.Tensor]:
    found = {**dict(state.scene().tensors()), **state.gaussian_optimizer.tensors("gaussians")}
    if state.motion_optimizer is not None:
        found |= state.motion_optimizer.tensors("motion")
    names = ("grad_norm", "count", "max_radii")
    found |= {f"stats.{name}": value for name, value in zip(names, state.stats.sums)}
    return {name: value.detach().cpu().clone() for name, value in found.items()}


def different(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> list[str]:
    assert a.keys() == b.keys()
    return [name for name in a if not torch.equal(a[name], b[name])]


def run(
    state: TrainState,
    frames: Frames,
    until: int,
    recorded: bool,
    before: Callable[[TrainState], None] = lambda state: None,
) -> tuple[list[StepResult], RecordedSteps | None]:
    """Train as ``loop`` does, with densification; ``before`` acts on the state before each step."""
    steps, results = RecordedSteps(state, frames) if recorded else None, []
    while state.step < until:
        if state.stage == "pretrain" and state.step >= state.config.pretrain_steps:
            results += [] if steps is None else steps.settle()
            state.begin_main()
        before(state)
        due = density_due(state)
        if steps is None:
            results.append(training_step(state, frames))
        else:
            results += steps.take()
            results += steps.settle() if due else []
        if due:
            control_density(state, results[-1].size)
        state.step += 1
    results += [] if steps is None else steps.settle()
    return results, steps


def adds_in_any_order(model: str, device: str) -> bool:
    """Return whether two runs of the model differ: torch's ``grid_sample`` adds gradients by atomics on a GPU."""
    return model == "hexplane" and device == "cuda" and not PRETENDED


def compare(device: str, steps: int, before: Callable[[TrainState], None] = lambda state: None, **changes: Any):
    """Run both forms, assert that they agree to the bit, and return the recorded one with its results."""
    plain, recorded = begin(device, steps, **changes), begin(device, steps, **changes)
    expected, _ = run(*plain, steps, False, before)
    found, taker = run(*recorded, steps, True, before)
    assert taker is not None and taker.failure is None
    assert [result.step for result in found] == list(range(steps))
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.failed == theirs.failed and ours.size == theirs.size, ours.step
        if ours.failed is None:
            for name in ("loss", "l1", "ssim", "regulariser"):
                assert float(getattr(ours, name)) == float(getattr(theirs, name)), (ours.step, name)
    assert different(tensors(recorded[0]), tensors(plain[0])) == []
    assert torch.equal(found[-1].render, expected[-1].render) and torch.equal(found[-1].truth, expected[-1].truth)
    return taker, found, recorded[0]


@pytest.mark.parametrize("model", MODELS)
def test_same_bits_through_both_stages_and_densification(model, device):
    if adds_in_any_order(model, device):
        pytest.skip("torch adds this model's gradients in any order on a GPU")
    steps = 200 if model == "control-points" else 60
    taker, _, state = compare(device, steps, **MODELS[model])
    assert taker.recordings >= 3 and len(state.gaussians) > 0


def test_steps_that_compare_depth_are_recorded(device):
    """Two kinds of steps alternate; half of the frames have maps, which differ, as do lenses, and the weight fades."""
    data = with_depth(film(6), share=0.5)
    cameras = [dataclasses.replace(each.camera, K=each.camera.K.clone()) for each in data]
    for number, camera in enumerate(cameras):
        camera.K[:2, :2] *= 1.0 + 0.05 * number
    data = data.with_cameras(cameras)
    taker, found, state = compare(device, 120, data=data, loss={"depth": 0.5, "depth_until": 0.9})
    assert taker.recordings >= 3 and taker.repeats <= 4
    main = [result for result in found if result.step >= state.config.pretrain_steps + state.config.freeze]
    assert any(result.regulariser > 0 for result in main) and any(result.regulariser == 0 for result in main)


def test_lists_of_the_depth_count_as_room(device, monkeypatch):
    """The map's image may have more pairs than the view's; steps without room for them are repeated."""
    monkeypatch.setattr(depth, "flow_size", lambda width, height: (3 * width, 3 * height))
    monkeypatch.setattr(recorded_step, "CAPACITY_STEP", 64)
    monkeypatch.setattr(recorded_step, "PAIRS_PER_GAUSSIAN", 1)
    model = {"pretrain": {"steps": 0}, "motion": {"model": "static"}}
    taker, _, _ = compare(device, 40, data=with_depth(film(6, 48)), loss={"depth": 0.5}, **model)
    assert taker.repeats > 0


def test_the_same_losses_where_gradients_are_added_in_any_order(device):
    """Sums in another order differ in their last bits, and training magnifies that: compare early losses alone."""
    plain, recorded = (begin(device, 60, **MODELS["hexplane"]) for _ in range(2))
    expected, _ = run(*plain, 12, False)
    found, taker = run(*recorded, 12, True)
    assert taker is not None and taker.failure is None and taker.recordings >= 1
    for name in ("loss", "l1", "ssim", "regulariser"):
        ours, theirs = ([float(getattr(result, name)) for result in results] for results in (found, expected))
        assert ours == pytest.approx(theirs, rel=1e-4, abs=1e-7), name


@pytest.mark.parametrize(
    "changes",
    [
        {"half_size": 14, "loss": {"log_error": 2e-3, "log_error_from": 0.3, "pooled": "always"}},
        {"pretrain": {"silhouette": 1.0, "fade": "never", "warm_up": 4, "random_background": True}},
        {"loss": {"arap_pair": "random"}, "motion": {"mask": True, "time_noise": 0.1, "hyper_dim": 2}},
        {"pretrain": {"arap_by": "moment", "arap_weight": 0.03, "warm_up": 4, "progressive": True}},
    ],
    ids=["sizes and losses", "silhouettes", "noise", "neighbours of a moment"],
)
def test_same_bits_of_everything_that_changes_a_step(changes, device):
    compare(device, 60, **changes)


def test_lists_without_room_are_repeated(device, monkeypatch):
    """Room for one pair whenever tensors are replaced: a step and its successor change nothing, and are taken again."""
    monkeypatch.setattr(recorded_step, "CAPACITY_STEP", 1)
    inner = RecordedSteps._bound

    def tight(self):
        before, update = self._update, inner(self)
        self.capacity = self.capacity if update is before else 1
        return update

    monkeypatch.setattr(RecordedSteps, "_bound", tight)
    taker, _, _ = compare(device, 50)
    assert taker.repeats >= 4 and taker.recordings >= 2


def test_lists_beyond_the_memory_are_taken_step_by_step(device, monkeypatch):
    monkeypatch.setattr(RecordedSteps, "_make_room", lambda self, pairs: False)
    taker, _, _ = compare(device, 30)
    assert taker.recordings == taker.capacity == 0


def test_memory_that_ends_at_a_repeat(device, monkeypatch):
    monkeypatch.setattr(recorded_step, "CAPACITY_STEP", 1)
    monkeypatch.setattr(recorded_step, "PAIRS_PER_GAUSSIAN", 0)
    inner = RecordedSteps._make_room
    monkeypatch.setattr(RecordedSteps, "_make_room", lambda self, pairs: pairs < 30 and inner(self, pairs))
    taker, _, _ = compare(device, 30)
    assert taker.repeats > 0 and taker.capacity == 0


class Poison:
    """Makes the gradient of a parameter non-finite in some steps, by a number on the device."""

    def __init__(self, steps: set[int], name: str) -> None:
        self.steps, self.name, self.hooked = steps, name, None
        self.dose: torch.Tensor | None = None

    def __call__(self, state: TrainState) -> None:
        parameter = state.gaussian_optimizer.groups[self.name].parameter
        if self.hooked is not parameter:
            self.dose = dose = torch.zeros(1, device=state.device)
            parameter.register_hook(lambda gradient: gradient + dose)
            self.hooked = parameter
        assert self.dose is not None
        self.dose.fill_(float("inf") if state.step in self.steps else 0.0)


@pytest.mark.parametrize("steps", [{0}, {21, 22}, {30, 33, 39}])
def test_a_gradient_that_is_not_finite_drops_its_step_alone(steps, device):
    plain, recorded = begin(device), begin(device)
    expected, _ = run(*plain, 45, False, Poison(steps, "opacity_logits"))
    found, taker = run(*recorded, 45, True, Poison(steps, "opacity_logits"))
    assert taker is not None and taker.recordings > 0
    dropped = {result.step: result.failed for result in found if result.failed}
    assert dropped == dict.fromkeys(steps, "gradient of opacity_logits")
    assert dropped == {result.step: result.failed for result in expected if result.failed}
    assert different(tensors(recorded[0]), tensors(plain[0])) == []


def test_a_loss_that_is_not_finite_adds_no_statistics(device):
    """One frame of six is not finite. Neither its statistics nor its gradients reach the state."""

    def spoilt(device: str) -> tuple[TrainState, Frames]:
        state, frames = begin(device)
        frames.data[2].image[:4] = float("nan")
        return state, frames

    plain, recorded = spoilt(device), spoilt(device)
    expected, _ = run(*plain, 40, False)
    found, _ = run(*recorded, 40, True)
    names = [result.failed for result in found]
    assert names == [result.failed for result in expected] and 4 <= names.count("image loss") <= 10
    assert different(tensors(recorded[0]), tensors(plain[0])) == []


def test_a_run_that_is_cut_and_resumed(device, tmp_path):
    whole, first = begin(device), begin(device)
    run(*whole, 60, True)
    run(*first, 33, True)
    first[0].save(tmp_path)
    data = tiny_dataset(6)
    resumed = TrainState.resume(tmp_path, first[0].config, data, device)
    run(resumed, Frames(data, resumed.normalisation, resumed.config, device), 60, True)
    assert different(tensors(resumed), tensors(whole[0])) == []


def stale_rates(inner, self, view):
    cells = inner(self, view)
    kept = getattr(self, "_kept", None)
    if kept is None:
        self._kept = kept = cells[recorded_update.TIMES :].clone()
    return torch.cat([cells[: recorded_update.TIMES], kept])


def stale_camera(inner, self, view):
    cells = inner(self, view)
    kept = getattr(self, "_kept", None)
    if kept is None:
        self._kept = kept = cells[: recorded_update.CAMERA].clone()
    return torch.cat([kept, cells[recorded_update.CAMERA :]])


def stale_times(inner, self, view):
    cells = inner(self, view)
    cells[recorded_update.WEIGHT : recorded_update.TIMES] = 0.25
    return cells


@pytest.mark.parametrize("stale", [stale_rates, stale_camera, stale_times])
def test_a_stale_number_shows(stale, device, monkeypatch):
    inner = RecordedUpdate.numbers
    monkeypatch.setattr(RecordedUpdate, "numbers", lambda self, view: stale(inner, self, view))
    with pytest.raises(AssertionError):
        compare(device, 50)


def test_a_count_of_steps_on_the_host_shows(device, monkeypatch):
    """Recorded steps count on the device. A factor that is not computed anew in each replay is wrong."""
    inner = UpdateTable.adam_step

    def frozen(self, outcome, rates, counts, betas, eps):
        inner(self, outcome, rates, counts.clone(), betas, eps)

    monkeypatch.setattr(UpdateTable, "adam_step", frozen)
    with pytest.raises(AssertionError):
        compare(device, 50)


def test_images_that_are_not_copied_show(device, monkeypatch):
    inner = RecordedUpdate._in_buffers

    def first(self, view):
        kept = inner(self, view)
        if not hasattr(self, "_first"):
            self._first = kept.truth.clone()
        kept.truth.copy_(self._first)
        return kept

    monkeypatch.setattr(RecordedUpdate, "_in_buffers", first)
    with pytest.raises(AssertionError):
        compare(device, 50)


def test_plain_steps_between_recorded_ones(device, monkeypatch):
    """Memory comes and goes: the counts of both forms continue each other's."""
    inner, number = RecordedSteps._fits, iter(range(10_000))
    monkeypatch.setattr(RecordedSteps, "_fits", lambda self: next(number) % 9 < 5 and inner(self))
    taker, _, _ = compare(device, 60)
    assert taker.recordings > 0


def test_a_new_graph_of_neighbours_keeps_the_recordings(device, monkeypatch):
    """A graph of the same size is written into the old one's tensors, which the recorded step reads."""
    loss = {"arap": 0.01, "arap_end": 0.01, "arap_until": 1000, "arap_every": 1, "arap_refresh": 4}
    state, frames = begin(device, 80, loss=loss, freeze=0, densify={"start": 1000})
    state.step = state.config.pretrain_steps
    state.begin_main()
    steps, built = RecordedSteps(state, frames), []
    build = rigidity.trajectory_graph
    monkeypatch.setattr(rigidity, "trajectory_graph", lambda *inputs: built.append(1) or build(*inputs))
    for _ in range(14):
        steps.take()
        state.step += 1
    steps.settle()
    assert len(built) >= 3 and steps.recordings == 1 and steps.failure is None


def test_images_on_the_device_are_not_read_again(device, monkeypatch):
    state, frames = begin(device, 40)
    reads = []
    read = frames.pixels
    monkeypatch.setattr(frames, "pixels", lambda *key: reads.append(key) or read(*key))
    steps = RecordedSteps(state, frames)
    for _ in range(30):
        steps.take()
        state.step += 1
    steps.settle()
    once = len(set(reads))
    assert once >= 6 and (len(reads) == 30 if device == "cpu" else len(reads) <= 2 * once), reads


def test_nothing_is_held_after_a_release(device):
    state, frames = begin(device, pretrain={"steps": 0}, motion={"model": "static"})
    steps = RecordedSteps(state, frames)
    for _ in range(5):
        steps.take()
        state.step += 1
    steps.settle()
    steps.release()
    means = weakref.ref(state.gaussians.means)
    state.gaussian_optimizer.regather(
        state.gaussians, ("means",), torch.arange(3, device=device), torch.zeros(3, dtype=torch.bool, device=device)
    )
    gc.collect()
    assert means() is None
