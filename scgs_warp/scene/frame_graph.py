"""Frames of an unchanging scene: recorded once as a CUDA graph and replayed with other cameras and times.

Nothing in a frame waits for the device. Binning has a fixed capacity of tile-splat pairs; the number of pairs comes
back with the image, and a frame that exceeds the capacity is drawn again with a larger one before it is returned. On a
CPU the same steps run one by one, which is how they are tested.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..gaussians import GaussianParameters
from ..kernels.types import TILE_SIZE
from ..motion.base import Motion
from ..ops.binning_cuda import MAX_ROOM, bin_within, bytes_within
from ..ops.compositing import image_demand
from ..ops.memory_windows import require_image
from ..rendering.render import draw, expected_depth
from ..runtime import debug, memory
from ..runtime.cuda_graph import CudaGraph, PlainGraph
from ..runtime.device_copies import pinned, sent
from ..types import Camera, Image, Splats, Tiles

CAPACITY_FACTOR = 1.25
"""Ratio of the new capacity to the number of pairs of a frame that exceeded the old one."""
CAPACITY_STEP = 1 << 16
"""Number of pairs to a multiple of which the capacity is rounded up, so that it seldom changes."""
RECORD_AFTER = 2
"""Number of frames drawn step by step before one is recorded, since recording does not pay for a single picture."""


@dataclass(frozen=True)
class Pending:
    """A frame in flight."""

    inputs: Tensor
    """[30] camera, time, background, and the background's depth, 0."""
    size: tuple[int, int]
    image: Image
    total: Tensor
    """[1] number of tile-splat pairs, on the host once ``done``."""
    capacity: int
    """Capacity in pairs when the frame was drawn."""
    done: torch.cuda.Event | None


class FrameGraph:
    """Renderer of one scene's frames, not differentiable. ``submit`` and ``finish`` keep several frames in flight.

    A frame whose pairs do not fit into memory is drawn step by step in windows of tiles instead of from a recording.

    Attributes: ``capacity`` (in pairs; 0 before the first frame), ``recordings`` (number of recorded graphs),
    ``failure`` (error of a failed recording, else None).
    """

    def __init__(
        self,
        gaussians: GaussianParameters,
        motion: Motion,
        *,
        antialiased: bool = False,
        depth_unit: float = 1.0,
    ) -> None:
        """
        Args:
            gaussians, motion: read in place at every frame. If one of their tensors is replaced or modified, the next
                frame is recorded anew.
            depth_unit: divisor of the depths, the number of the Gaussians' units in a unit of the caller's.

        Raises:
            ValueError: the motion does not take its time as a tensor.
        """
        if not motion.takes_time_tensor:
            raise ValueError(f"motion {motion.name} needs the time on the host; it cannot be recorded")
        self.gaussians, self.motion = gaussians, motion
        self.capacity, self.recordings, self.failure = 0, 0, None
        self._antialiased, self._depth_unit = antialiased, depth_unit
        self.inputs = torch.zeros(30, device=gaussians.means.device)
        self._size = (0, 0)
        self._state: list[Any] = []
        self._frames_of_state = 0
        self._recorded: CudaGraph | PlainGraph | None = None
        self._kept: list[Any] = []
        self._lock = threading.Lock()

    def render(self, camera: Camera, time: float, background: Tensor) -> Image:
        """Draw one complete frame.

        Args:
            camera: in the units of the Gaussians, on any device.
            time: in [0, 1].
            background: [3] in [0, 1], on any device.

        Raises:
            NotEnoughMemory: the image, or a single tile of it, takes more memory than there is.
        """
        return self.finish(self.submit(camera, time, background))

    def submit(self, camera: Camera, time: float, background: Tensor) -> Pending:
        """Start a frame; arguments as in :meth:`render`. Its image may lack splats until ``finish`` returns it."""
        where = camera.viewmat.device
        rest = torch.tensor([time]), background, torch.zeros(1)
        parts = camera.viewmat, camera.K, *(sent(part, where) for part in rest)
        return self._start(torch.cat([part.flatten() for part in parts]).float(), (camera.width, camera.height))

    def finish(self, pending: Pending) -> Image:
        """Wait for the frame; draw it again with more capacity if it lacks splats."""
        while True:
            if pending.done is not None:
                pending.done.synchronize()
            pairs = int(pending.total)
            if pairs <= pending.capacity:
                return pending.image
            with self._lock:
                if pairs > self.capacity and not self.make_room(pairs, pending.size):
                    return self._drawn(pending.inputs.to(self.inputs.device), pending.size)
            pending = self._start(pending.inputs, pending.size)

    @torch.no_grad()
    def _start(self, inputs: Tensor, size: tuple[int, int]) -> Pending:
        with self._lock:
            device = self.inputs.device
            self.inputs.copy_(pinned(inputs, device), non_blocking=True)
            self._follow(size)
            recorded = self._recorded or PlainGraph(self.draw_steps)
            image, total = recorded.replay()
            if recorded.overwrites:
                planes = image.rgb.permute(2, 0, 1).clone()
                image = Image(planes.permute(1, 2, 0), image.alpha.clone(), image.depth.clone())
                total = total.clone()
            done = None
            if device.type == "cuda":
                host = torch.empty(1, dtype=torch.int64, pin_memory=True)
                total = host.copy_(total, non_blocking=True)
                done = torch.cuda.Event()
                done.record(torch.cuda.current_stream(device))
            return Pending(inputs, size, image, total, self.capacity, done)

    def _follow(self, size: tuple[int, int]) -> None:
        """Detect another size or a changed scene, determine the capacity, and record when that pays."""
        state = self._scene_state()
        if size != self._size or state != self._state:
            require_image(image_demand(*size, 4), size, len(self.gaussians), self.inputs.device)
            self._size, self._state, self._recorded, self._frames_of_state = size, state, None, 0
        if self.capacity == 0:
            self.capacity = 1
            self.make_room(int(self.draw_steps()[1]), size)
        self._frames_of_state += 1
        if debug.enabled():  # Debug checks wait for the device.
            return
        if self._recorded is None and self.failure is None and self._frames_of_state > RECORD_AFTER:
            self._record()

    def _record(self) -> None:
        if self.inputs.device.type != "cuda":
            self._recorded = PlainGraph(self.draw_steps)
        else:
            try:
                self._recorded = CudaGraph(self.draw_steps, self.inputs.device)
            except RuntimeError as error:  # Frames are then drawn step by step.
                self.failure = str(error)
                return
        self.recordings += 1
        # The graph reads the scene's tensors in place: tensors cached by the motion must outlive it.
        self._kept = [list(vars(module).values()) for module in self.motion.modules()]

    def _scene_state(self) -> list[Any]:
        """Return a state that stays equal as long as no tensor of the scene is replaced or modified."""
        tensors = (*self.gaussians.parameters(), *self.motion.parameters())
        return [(x.data_ptr(), x.shape, 0 if x.is_inference() else x._version) for x in tensors]

    def make_room(self, pairs: int, size: tuple[int, int]) -> bool:
        """Set a capacity for ``pairs`` with a margin; return False if it exceeds the index range or memory."""
        capacity = min(-(-int(CAPACITY_FACTOR * max(pairs, 1)) // CAPACITY_STEP) * CAPACITY_STEP, MAX_ROOM)
        tiles = -(-size[0] // TILE_SIZE) * -(-size[1] // TILE_SIZE)
        need = bytes_within(capacity, len(self.gaussians), tiles)
        if pairs > capacity or not memory.fits(need, self.inputs.device):
            return False
        self.capacity, self._recorded = capacity, None
        return True

    def draw_steps(self) -> tuple[Image, Tensor]:
        """Draw the whole frame from ``inputs``; return it with the number of pairs, [1]."""
        totals: list[Tensor] = []

        def binned(splats: Splats) -> Tiles:
            tiles, total = bin_within(splats, self.capacity, slots=False)
            totals.append(total)
            return tiles

        return self._drawn(self.inputs, self._size, binned), totals[0]

    @torch.no_grad()
    def _drawn(self, inputs: Tensor, size: tuple[int, int], binned: Callable[[Splats], Tiles] | None = None) -> Image:
        """Draw the frame of ``inputs``; without ``binned``, in windows of tiles if necessary."""
        viewmat, K, time, background = inputs.split((16, 9, 1, 4))
        posed = self.motion.gaussians_at(self.gaussians, time)
        camera = Camera(viewmat.view(4, 4), K.view(3, 3), *size)
        image, alpha = draw(posed, camera, background, antialiased=self._antialiased, depth=True, binned=binned)
        depth = expected_depth(image[3], alpha, self._depth_unit)
        return Image(image[:3].permute(1, 2, 0), alpha, depth)
