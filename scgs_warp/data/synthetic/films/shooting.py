"""What the cameras of a film do: where they are, when they begin, how they expose; and the recording itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .cameras import HandHeldPath, rig_viewmats
from .encoding import write_film
from .photography import Shutter, View, develop, drifting_gains, photograph
from .request import FilmRequest
from .sound import clap_shapes, clap_times, heard
from .stage import Stage

PHONE_FILE = "film.mp4"


@dataclass(frozen=True)
class Take:
    """The recording of one camera. Seconds are those of the room's clock."""

    name: str
    file: str
    view: View
    start: float
    """Moment of the first frame."""
    seconds: np.ndarray
    """[V] moments at which the middle row of each frame is exposed."""
    gains: np.ndarray
    """[V, 3] factors on linear light: exposure and white balance."""

    @property
    def viewmats(self) -> np.ndarray:
        """[V, 4, 4] world-to-camera, OpenCV, at ``seconds``."""
        return np.stack([self.view.viewmat(second) for second in self.seconds])


class Shooting:
    """All takes of a film, and the clock that they share."""

    def __init__(self, request: FilmRequest, takes: list[Take], length: float, floor: float) -> None:
        self.request, self.takes, self.length, self.floor = request, takes, length, floor
        self.shutter = Shutter(request.blur / request.fps, request.rolling / request.fps)
        rng = np.random.default_rng([request.seed, 3])
        self.claps = clap_times(length, rng)
        self.clap_shapes = clap_shapes(len(self.claps), rng)

    @staticmethod
    def plan(request: FilmRequest, floor: float) -> Shooting:
        """Plan the cameras of a film."""
        rng = np.random.default_rng([request.seed, 1])
        count = round(request.seconds * request.fps)
        own = np.arange(count) / request.fps
        K = intrinsics(request)
        phone = request.kind == "phone"
        path = HandHeldPath(own[-1], floor, request.shake, request.arc, rng)
        rig = rig_viewmats(request.views, floor, request.arc)
        poses = [path.viewmat] if phone else [_standing(matrix) for matrix in rig]
        starts = np.zeros(len(poses))
        if not phone and request.offsets > 0:
            starts = rng.uniform(0.0, request.offsets, len(poses))
            starts[rng.permutation(len(poses))[:2]] = 0.0, request.offsets
        takes = []
        for index, (pose, start) in enumerate(zip(poses, starts.tolist())):
            name = "film" if phone else f"cam{index:02d}"
            gains = drifting_gains(own, request.exposure, request.balance, rng)
            file = PHONE_FILE if phone else f"{name}.mp4"
            takes.append(Take(name, file, View(pose, K, request.width, request.height), start, start + own, gains))
        return Shooting(request, takes, float(max(starts) + own[-1]), floor)

    @property
    def count(self) -> int:
        """Number of frames of each take."""
        return len(self.takes[0].seconds)

    def time_of(self, seconds: float) -> float:
        """Return the time of the subject, in [0, 1], at a second of the room's clock."""
        return min(max(seconds / self.length, 0.0), 1.0)

    def shoot(self, stage: Stage, take: Take, path: Path, done: Callable[[], object]) -> None:
        """Record a take.

        Args:
            done: called after each picture.

        Raises:
            OSError: the film cannot be written.
        """
        request, pictures = self.request, []
        for second, gains in zip(take.seconds.tolist(), take.gains):
            light = photograph(stage, take.view, second, self.time_of, self.shutter, request.samples)
            pictures.append(develop(light, gains))
            done()
        write_film(path, pictures, request.fps, request.crf, self.sound(take) if request.sound else None)

    def sound(self, take: Take) -> np.ndarray:
        """Return what the take's microphone hears: claps at the middle of the room."""
        viewmat = take.view.viewmat(float(take.seconds[0]))
        distance = float(np.linalg.norm(viewmat[:3, :3].T @ viewmat[:3, 3]))
        rng = np.random.default_rng([self.request.seed, 5, self.takes.index(take)])
        return heard(self.claps, self.clap_shapes, take.start, self.count / self.request.fps, distance, rng)


def intrinsics(request: FilmRequest) -> np.ndarray:
    """Return K [3, 3] of every camera."""
    focal = 0.5 * request.width / math.tan(math.radians(request.fov) / 2)
    return np.array([[focal, 0.0, request.width / 2], [0.0, focal, request.height / 2], [0.0, 0.0, 1.0]])


def _standing(viewmat: np.ndarray) -> Callable[[float], np.ndarray]:
    return lambda seconds: viewmat
