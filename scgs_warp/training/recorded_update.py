"""The device's part of a recorded step: compare the view, judge the outcome, update the parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels.types import STEP_FINE
from ..ops.binning_cuda import bin_within
from ..ops.step_outcome import Moments, StepOutcome, UpdateTable
from ..optim import ADAM_BETAS, ADAM_EPS, Group
from ..runtime.cuda_graph import CudaGraph, GraphMemory, PlainGraph
from ..runtime.device_copies import pinned, sent
from ..types import Camera, Splats, Tiles
from .depth import SeenDepth
from .silhouettes import SilhouetteSample
from .state import TrainState
from .step import least_logit, motion_frozen
from .view import Numbers, View, compare, operations_key

RECORD_AFTER = 2
"""Number of steps of one kind that are taken operation by operation, which loads their kernels, before one is
recorded."""
MOST_RECORDINGS = 16
"""Largest number of recordings at a time. Images of many sizes have as many kinds of steps."""
MOST_TIMES = 3
"""Largest number of instants of a step: the view's and two of the regulariser."""
CAMERA, BACKGROUND, WEIGHT, TIMES, DEPTH = 25, 28, 29, 29 + MOST_TIMES, 39 + MOST_TIMES
"""Index behind the last number of the camera, the background, the weight, the times, and the depth map's weight and
intrinsics; the learning rates follow."""


class Kind(NamedTuple):
    """What all steps of one kind update."""

    table: UpdateTable
    received: list[int]
    """Indices of the parameters that receive a gradient."""
    gradients: list[Tensor]
    """Their gradients, at fixed addresses."""
    names: list[str]
    """Their names."""
    updated: list[Group]


class RecordedUpdate:
    """Steps on the present tensors of a state, valid until one of these is replaced.

    Attributes: ``outcome``; ``recordings`` (number of graphs recorded); ``failure`` (error of a failed recording, else
    None).
    """

    def __init__(self, state: TrainState, memory: GraphMemory) -> None:
        """
        Args:
            state: its optimisers' counts of steps must include every step taken so far.
            memory: of all recordings of a run.
        """
        self._state, self._device, self._memory = state, state.device, memory
        self.recordings, self.failure = 0, None
        self.outcome = StepOutcome(self._device)
        named = [pair for optimizer in state.optimizers() for pair in optimizer.groups.items()]
        self._names, self._groups = [name for name, _ in named], [group for _, group in named]
        for group in self._groups:
            group.begin()
        self._tensors = self._present()
        counts = torch.tensor([group.steps for group in self._groups], dtype=torch.int32)
        self._counts = counts.to(self._device)
        self._inputs = torch.zeros(DEPTH + len(self._groups), dtype=torch.float64, device=self._device)
        self._gradients: dict[int, Tensor] = {}
        self._short = False
        """True if there was too little memory for a recording."""
        self._kinds: dict[Hashable, Kind] = {}
        self._seen: Counter[Hashable] = Counter()
        self._recorded: dict[Hashable, CudaGraph | PlainGraph] = {}
        self._buffers: dict[Hashable, View] = {}

    def holds(self) -> bool:
        """Return True as long as none of the state's tensors has been replaced."""
        now = self._present()
        return len(now) == len(self._tensors) and all(
            old is new and address == new.data_ptr() for (old, address), (new, _) in zip(self._tensors, now)
        )

    def _present(self) -> list[tuple[Tensor, int]]:
        """Return all tensors that a step reads and writes, with their addresses."""
        state = self._state
        groups = [group for optimizer in state.optimizers() for group in optimizer.groups.values()]
        found = [tensor for group in groups for tensor in (group.parameter, group.exp_avg, group.exp_avg_sq)]
        found += [*state.motion.extra_state().values(), *state.stats.sums]
        return [(tensor, tensor.data_ptr()) for tensor in found if tensor is not None]

    def key(self, view: View) -> Hashable:
        """Return a key for the kind of the state's present step."""
        return operations_key(view, motion_frozen(self._state))

    def numbers(self, view: View) -> Tensor:
        """Gather the numbers that change from step to step, float64 on the host."""
        camera, times = view.camera, view.plan.times
        cells = [*camera.viewmat.flatten().tolist(), *camera.K.flatten().tolist(), *view.background.tolist()]
        cells += [view.plan.weight, *times, *[0.0] * (MOST_TIMES - len(times))]
        cells += [view.depth_weight, *([0.0] * 9 if view.depth is None else view.depth.camera.K.flatten().tolist())]
        return torch.tensor([*cells, *(group.rate for group in self._groups)], dtype=torch.float64)

    def take(self, view: View, numbers: Tensor, key: Hashable, room: int, record: bool) -> tuple[Tensor, Tensor, Kind]:
        """Take a step; the host does not wait.

        Args:
            numbers, key: results of :meth:`numbers` and :meth:`key` for the view.
            room: number of pairs that the lists hold; the same until :meth:`forget_recordings`.
            record: record the step if it has been repeated often enough.

        Returns:
            The report of ``StepOutcome``, the picture [3, H, W], and the step's kind. The next step of the same kind
            may overwrite report and picture.
        """
        self._inputs.copy_(pinned(numbers, self._device), non_blocking=True)
        if view.depth is not None:
            depth = view.depth._replace(inverse=sent(view.depth.inverse, self._device))
            view = view._replace(depth=depth)
        recorded = self._recorded.get(key)
        due = self._seen[key] >= RECORD_AFTER and len(self._recorded) < MOST_RECORDINGS and self.failure is None
        self._seen[key] += 1
        if recorded is not None:
            self._in_buffers(view)
        elif record and due and not self._short:
            recorded = self._record(key, partial(self._step, self._in_buffers(view), key, room))
        report, picture = self._step(view, key, room) if recorded is None else recorded.replay()
        torch.autograd.graph.increment_version([tensor for tensor, _ in self._tensors if tensor.is_floating_point()])
        return report, picture, self._kinds[key]

    def forget_recordings(self) -> None:
        """Drop what was recorded with another room."""
        self._recorded.clear()
        self._seen.clear()
        self._buffers.clear()

    def _in_buffers(self, view: View) -> View:
        """Copy the view's images to fixed addresses, and return the view with these."""
        shapes = tuple(image.shape for image in _images(view)), view.mask is None, view.depth is None
        kept = self._buffers.get(shapes)
        if kept is None:
            mask = None if view.mask is None else view.mask.clone()
            sample = None if view.sample is None else SilhouetteSample(*(part.clone() for part in view.sample))
            depth = None if view.depth is None else view.depth._replace(inverse=view.depth.inverse.clone())
            kept = view._replace(truth=view.truth.clone(), mask=mask, sample=sample, depth=depth)
            self._buffers[shapes] = kept
        else:
            for to, values in zip(_images(kept), _images(view)):
                to.copy_(values)
        return view._replace(truth=kept.truth, mask=kept.mask, sample=kept.sample, depth=kept.depth)

    def _record(self, key: Hashable, body: Callable[[], Any]) -> CudaGraph | PlainGraph | None:
        if self._device.type != "cuda":
            recorded: CudaGraph | PlainGraph = PlainGraph(body)
        else:
            # Nothing may be committed by a capture that runs the operations, as that of the pretended device does.
            halted = self.outcome.halted.clone()
            self.outcome.halted.fill_(1)
            try:
                recorded = CudaGraph(body, self._device, warm_ups=0, memory=self._memory)
            except torch.OutOfMemoryError:  # steps on these tensors are then taken operation by operation
                self._short = True
                self.forget_recordings()
                torch.cuda.empty_cache()
                return None
            except RuntimeError as error:  # as are all others
                self.failure = str(error)
                self.forget_recordings()
                self._memory.renew()
                return None
            finally:
                self.outcome.halted.copy_(halted)
        self._recorded[key] = recorded
        self.recordings += 1
        return recorded

    def _step(self, view: View, key: Hashable, room: int) -> tuple[Tensor, Tensor]:
        """Compare the view, judge the loss and the gradients, update, and report."""
        state, totals = self._state, []

        def binned(splats: Splats) -> Tiles:
            tiles, total = bin_within(splats, room)
            totals.append(total)
            return tiles

        # 1. Compare. Statistics obey the outcome, which is known before the backward pass.
        stats = replace(state.stats, outcome=self.outcome.value)
        compared = compare(state, view, self._on_device(view), stats, binned)
        most = totals[0] if len(totals) == 1 else torch.stack(totals).amax(0)
        self.outcome.judge_loss(most, room, compared.loss, compared.regulariser)
        parameters = [group.parameter for group in self._groups]
        gradients = torch.autograd.grad(compared.total, parameters, allow_unused=True)

        # 2. Update, unless a gradient is not finite.
        kind = self._kinds.get(key)
        if kind is None:
            kind = self._kinds[key] = self._kind(gradients)
        torch._foreach_copy_(kind.gradients, [gradients[index] for index in kind.received])  # pyright: ignore[reportPrivateImportUsage]
        kind.table.judge_gradients(self.outcome)
        kind.table.adam_step(self.outcome, self._inputs[DEPTH:], self._counts, ADAM_BETAS, ADAM_EPS)
        least = least_logit(state)
        if least is not None:
            logits = state.gaussians.opacity_logits.data
            logits.copy_(torch.where(self.outcome.value == STEP_FINE, logits.clamp(min=least), logits))
        terms = compared.loss, compared.l1, compared.ssim, compared.regulariser
        return self.outcome.report(most, *terms, compared.shown), compared.picture.detach()

    def _on_device(self, view: View) -> Numbers:
        cells = self._inputs[:DEPTH].float()
        viewmat, K = cells[:16].view(4, 4), cells[16:CAMERA].view(3, 3)
        camera = Camera(viewmat, K, view.camera.width, view.camera.height)
        times = cells[WEIGHT : WEIGHT + len(view.plan.times)]
        numbers = Numbers(camera, cells[CAMERA:BACKGROUND], times, cells[BACKGROUND])
        if view.depth is None:
            return numbers
        reduced = view.depth.camera
        seen = Camera(viewmat, cells[TIMES + 1 : DEPTH].view(3, 3), reduced.width, reduced.height)
        return numbers._replace(depth=SeenDepth(seen, view.depth.inverse), depth_weight=cells[TIMES])

    def _kind(self, gradients: tuple[Tensor | None, ...]) -> Kind:
        state = self._state
        learns = [state.gaussian_optimizer] if motion_frozen(state) else state.optimizers()
        learning = {id(group) for optimizer in learns for group in optimizer.groups.values()}
        received = [index for index, gradient in enumerate(gradients) if gradient is not None]
        for index in received:  # all kinds share them: one step follows the other
            if index not in self._gradients:
                self._gradients[index] = torch.zeros_like(self._groups[index].parameter)
        buffers = [self._gradients[index] for index in received]
        updates, updated = [], []
        for index, buffer in zip(received, buffers):
            group = self._groups[index]
            if id(group) in learning:
                assert group.exp_avg is not None and group.exp_avg_sq is not None
                updates.append((index, Moments(group.parameter, buffer, group.exp_avg, group.exp_avg_sq)))
                updated.append(group)
        table = UpdateTable(buffers, updates, self._device)
        return Kind(table, received, buffers, [self._names[index] for index in received], updated)


def _images(view: View) -> list[Tensor]:
    depth = None if view.depth is None else view.depth.inverse
    images = [view.truth, view.mask, *(() if view.sample is None else view.sample), depth]
    return [image for image in images if image is not None]
