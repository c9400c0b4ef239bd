"""Measure what a film's own pictures give of its held-out views if shape, motion and cameras are known exactly.

    python apps/synthesize.py --film rig --arc 40 --offsets 0.5 --seconds 2 --fps 15 --size 480 270 --output rig
    python benchmarks/film_limits.py rig --held-out cam02 --json benchmarks/results/film-limits-rig.json

Each pixel of a held-out view shows a point of a surface. The point is followed to every frame, and the frames in which
it is visible are sampled there (bicubic) and averaged, with weights that fall with the angle between the two directions
of sight as the surface sees them, and with the time between the two: quickly, slowly or not at all, whichever is best
for the film. What this picture lacks is not due to errors of
shape or motion: texture finer than a pixel, compression, and light that changes while the subject moves.

``views`` holds, for each held-out view, the PSNR of its pixels that other frames see, of those on the subject and on
the room, and the share that no frame sees.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from provenance import ROOT
from torch import Tensor
from torch.nn.functional import normalize

from scgs_warp.capture.source import read_rgb
from scgs_warp.data.synthetic.films.encoding import decoded
from scgs_warp.data.synthetic.films.request import FilmRequest
from scgs_warp.data.synthetic.films.shooting import Shooting
from scgs_warp.data.synthetic.films.stage import Hits, Stage, stage_of
from scgs_warp.data.synthetic.films.truth import flow_to
from scgs_warp.data.synthetic.raycast import PosedSurface
from scgs_warp.geometry.rotation import OPENGL_TO_OPENCV
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.storage.files import read_text
from scgs_warp.storage.json_files import parse_json
from scgs_warp.types import Camera

ANGLE = 3.0
"""Angle at which a frame's weight has halved, in degrees."""
SECONDS = (0.1, 1.0, 1e6)
"""Times at which it has halved."""
EVERY = 3
"""Stride of the frames of a held-out camera."""


class Picture(NamedTuple):
    time: float
    """Of the subject, in [0, 1]."""
    camera: Camera
    image: np.ndarray
    """[H, W, 3] in [0, 1]"""


class HeldOut:
    """A held-out picture, and what the frames give of it so far."""

    def __init__(self, stage: Stage, picture: Picture) -> None:
        self.picture = picture
        posed = stage.pose_unlit(picture.time)
        self.hits = stage.hits(posed, picture.camera)
        self.mover, self.hit = stage.moves(self.hits).numpy(), (self.hits.face >= 0).numpy()
        self.sight = sight(stage, posed, self.hits, picture.camera)
        self.totals = np.zeros((len(SECONDS), *picture.image.shape))
        self.weights = np.zeros((len(SECONDS), *picture.image.shape[:2]))

    def add(self, stage: Stage, frame: Picture, posed: PosedSurface, length: float) -> None:
        """Add a frame of a film of ``length`` seconds; ``posed`` is everything at its time."""
        camera = frame.camera
        places = stage.places(posed, self.hits)
        height, width = self.hit.shape
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        x, y = np.moveaxis((flow_to(places, camera).numpy() + grid).astype(np.float32), -1, 0)
        visible = stage.caster.visible(posed, camera, places.reshape(-1, 3).contiguous()).view(height, width).numpy()
        seen = self.hit & visible & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        cosine = (sight(stage, posed, self.hits, camera) * self.sight).sum(-1).clamp(-1.0, 1.0)
        angle = torch.rad2deg(torch.acos(cosine)).numpy()
        elapsed = (frame.time - self.picture.time) * length
        near, sampled = seen / (1.0 + (angle / ANGLE) ** 2), cv2.remap(frame.image, x, y, cv2.INTER_CUBIC)
        for total, weights, seconds in zip(self.totals, self.weights, SECONDS):
            weight = near / (1.0 + (elapsed / seconds) ** 2)
            total += weight[..., None] * sampled
            weights += weight

    def scores(self, choice: int) -> dict[str, float]:
        """Compare the means with the picture; ``choice`` is an index of ``SECONDS``."""
        seen = self.weights[choice] > 0.0
        given = self.totals[choice] / np.maximum(self.weights[choice], 1e-12)[..., None]
        squares = np.square(given - self.picture.image).mean(2)
        parts = {"psnr": seen, "mover": seen & self.mover, "room": seen & ~self.mover}
        scores = {name: float(-10.0 * np.log10(squares[inside].mean())) for name, inside in parts.items()}
        return {"time": self.picture.time, **scores, "unseen": float(1.0 - seen.mean())}


def sight(stage: Stage, posed: PosedSurface, hits: Hits, camera: Camera) -> Tensor:
    """Return the directions [H, W, 3] to the camera in the frames of the triangles that were hit."""
    faces = stage.caster.faces.view(-1, 3).long()[hits.face.clamp(min=0).long()]
    first, second, third = posed.vertices[faces].unbind(-2)
    along = normalize(second - first, dim=-1)
    normal = normalize(torch.linalg.cross(along, third - first, dim=-1), dim=-1)
    axes = torch.stack([along, torch.linalg.cross(normal, along, dim=-1), normal], dim=-2)
    eye = torch.linalg.inv(camera.viewmat)[:3, 3]
    return (axes @ normalize(eye - stage.places(posed, hits), dim=-1)[..., None])[..., 0]


def frames_of(folder: Path, shooting: Shooting, without: str) -> Iterator[Picture]:
    """Yield the frames of all cameras but one."""
    for take in shooting.takes:
        if take.name != without:
            for second, picture in zip(take.seconds.tolist(), decoded(folder / take.file)):
                image = picture.astype(np.float32) / 255.0
                yield Picture(shooting.time_of(second), take.view.camera(second), image)


def held_out_views(folder: Path, shooting: Shooting, name: str) -> Iterator[Picture]:
    """Yield every third frame of the held-out camera of a rig, or the held-out views of a phone's film."""
    if name:
        take = next(take for take in shooting.takes if take.name == name)
        for index, picture in enumerate(decoded(folder / take.file)):
            if index % EVERY == 0:
                second, image = float(take.seconds[index]), picture.astype(np.float32) / 255.0
                yield Picture(shooting.time_of(second), take.view.camera(second), image)
        return
    view = shooting.takes[0].view
    content = parse_json(read_text(folder / "transforms.json"))
    for frame in content["frames"]:
        if frame["file_path"] in content["test_filenames"]:
            viewmat = torch.from_numpy(np.linalg.inv(np.array(frame["transform_matrix"]) @ OPENGL_TO_OPENCV)).float()
            camera = Camera(viewmat, torch.from_numpy(view.K).float(), view.width, view.height)
            yield Picture(frame["time"], camera, read_rgb(folder / frame["file_path"]).astype(np.float32) / 255.0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("film", type=Path, help="folder of synthesize.py --film")
    parser.add_argument("--held-out", default="", help="camera of a rig")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    content = parse_json(read_text(options.film / "film.json"))
    request = FilmRequest(**{field.name: content[field.name] for field in fields(FilmRequest)})
    stage = stage_of(request.subject, "cpu")
    shooting = Shooting.plan(request, stage.floor)
    views = [HeldOut(stage, picture) for picture in held_out_views(options.film, shooting, options.held_out)]
    for frame in frames_of(options.film, shooting, options.held_out):
        posed = stage.pose_unlit(frame.time)
        for view in views:
            view.add(stage, frame, posed, shooting.length)
    choices = [[view.scores(choice) for view in views] for choice in range(len(SECONDS))]
    means = [{name: float(np.mean([score[name] for score in scores])) for name in scores[0]} for scores in choices]
    best = max(range(len(SECONDS)), key=lambda choice: means[choice]["psnr"])
    mean, scores = means[best], choices[best]
    del mean["time"]
    result = {
        "film": content,
        "held_out": options.held_out,
        "halved_after": SECONDS[best],
        **mean,
        "views": scores,
    }
    print(json.dumps(mean, indent=1))
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/film_limits.py", sys.argv[1:])}
        (ROOT / options.json).write_text(json.dumps({**origin, **provenance("cpu"), **result}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
