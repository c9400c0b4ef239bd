"""A trained scene: Gaussians, their motion, and the normalisation of world units."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..config.fields import BACKGROUND_COLORS
from ..config.presets import TrainConfig, from_dict, lasting, to_dict
from ..config.recorded import with_newer_fields
from ..config.validation import check_sizes
from ..errors import UserError
from ..gaussians import GaussianParameters
from ..geometry.cameras import Overview
from ..geometry.normalisation import Normalisation
from ..motion import build_motion
from ..motion.base import Motion
from ..motion.control_points import ControlPoints
from ..motion.spheres import Spheres
from ..rendering.render import render
from ..runtime.caller_settings import unaffected
from ..runtime.environment import check_device
from ..storage import checkpoint
from ..storage.files import read_text
from ..storage.json_files import parse_json
from ..types import Camera, Gaussians, Image
from . import film_maker, page_maker
from .arguments import clamped_time, given_camera, given_color
from .frame_graph import FrameGraph
from .validation import check_metadata, check_motion, check_settings, check_tensors, reason


class Scene:
    """A trained scene, as returned by training and stored in a run folder. Public methods use world units.

    Attributes: ``gaussians`` (:class:`GaussianParameters`, normalised units), ``motion``, ``normalisation``,
    ``config``, ``overview`` (summary of the training cameras), ``step``, ``settings`` (``config.json`` as a dict),
    ``folder`` (the run folder; None for a scene from elsewhere).
    """

    def __init__(
        self,
        gaussians: GaussianParameters,
        motion: Motion,
        normalisation: Normalisation,
        config: TrainConfig,
        overview: Overview,
        *,
        step: int = 0,
        settings: dict[str, Any] | None = None,
    ) -> None:
        self.gaussians, self.motion, self.normalisation = gaussians, motion, normalisation
        self.config, self.overview, self.step = config, overview, step
        self.settings = settings if settings is not None else to_dict(config)
        self.folder: Path | None = None
        self._frames: FrameGraph | None = None

    @staticmethod
    @unaffected
    def load(run: str | Path, device: str = "cpu") -> Scene:
        """Load the scene of a run folder written by :func:`scgs_warp.fit` or ``apps/train.py``.

        Args:
            run: the folder, which holds ``checkpoint.safetensors``.
            device: device of the scene's tensors and of rendering, ``cpu`` or ``cuda``.

        Returns:
            The scene of the newest checkpoint, ready to render.

        Raises:
            UserError: the checkpoint is missing or damaged, training has not reached its main stage, or there is no
                such device.
        """
        check_device(device)
        folder = Path(run)
        if folder.is_file():
            raise UserError(f"{folder}: is a file; give the folder of the run, such as {folder.parent}")
        if not folder.is_dir():
            raise UserError(f"{folder}: no such run folder; apps/train.py --output makes one")
        tensors, metadata = checkpoint.read(folder, ("gaussians.", "motion."))
        scene = scene_from(tensors, metadata, device, str(folder / checkpoint.FILE))
        scene.folder = folder.absolute()  # also after the program has changed its directory
        settings_path = folder / "config.json"
        if settings_path.exists():
            try:
                scene.settings = parse_json(read_text(settings_path))
            except (OSError, ValueError) as error:
                raise UserError(f"{settings_path}: cannot be read ({error}); restore it or train again") from error
        check_settings(scene.settings, str(settings_path))
        scene.motion.eval()
        if metadata.get("stage") != "main":
            raise UserError(
                f"{folder}: step {scene.step:,} of {scene.config.steps:,} is in stage 1, which has no Gaussians to "
                "show; continue it with apps/train.py --resume"
            )
        scene.freeze_binding()
        check_motion(scene, str(folder / checkpoint.FILE), scene.config.motion.chunks)
        return scene

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the renderer of frames, which copies make anew."""
        return {**self.__dict__, "_frames": None}

    def freeze_binding(self) -> None:
        """Compute every Gaussian's control points once, since they do not depend on time."""
        self.motion.cache_binding(self.gaussians)

    @unaffected
    def prepare_playback(
        self, tolerance: float = 3e-4, tell: Callable[[int, int], None] = lambda done, total: None
    ) -> bool:
        """Sample the motion once, so that later frames on a CPU interpolate it and need no network.

        This evaluates the network at up to 2,049 instants: worthwhile if a scene is played again and again, but not for
        a single film. The samples take 40 to 70 bytes for each instant and control point.

        Args:
            tolerance: largest error of a control point's position, as a share of the control points' extent, measured
                in the middle between samples. The default is a third of a pixel where the subject is 1,000 pixels high.
            tell: called as ``tell(done, total)`` while instants are sampled.

        Returns:
            Whether the motion is interpolated. False: frames are as before, because the scene is on a GPU, its model
            has no control points, or the tolerance is not met.
        """
        return self.motion.keep_poses(self.gaussians, tolerance, tell)

    @property
    def device(self) -> torch.device:
        """Device of the scene's tensors and of rendering."""
        return self.gaussians.means.device

    @property
    def motion_name(self) -> str:
        """``control-points``, ``per-gaussian``, ``hexplane`` or ``static``."""
        return self.motion.name

    @property
    def unfinished(self) -> str | None:
        """``step 3,304 of 7,000, unfinished`` for the scene of a run that has not reached its last step, else None."""
        if self.folder is None or self.step >= self.config.steps:
            return None
        return f"step {self.step:,} of {self.config.steps:,}, unfinished"

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians, N."""
        return len(self.gaussians)

    @property
    def control_point_count(self) -> int:
        """Number of control points, M; 0 for motion models without control points."""
        return self.control_points_at(0.0).shape[0]

    @property
    def background_color(self) -> tuple[float, float, float]:
        """Background of the training images; black if it was random."""
        return BACKGROUND_COLORS[self.config.data.background]

    @unaffected
    @torch.no_grad()
    def gaussians_at(self, time: float) -> Gaussians:
        """Return the posed, activated Gaussians at one time, in the form that other renderers take.

        Args:
            time: clamped to [0, 1].

        Returns:
            N Gaussians in world units on the scene's device. Row i is the same Gaussian at every time. Those with a
            sharpness above 0 are approximated by plain Gaussians (``Gaussians.plain``). Some tensors share memory with
            the scene: copy them before you change them.

        Raises:
            UserError: the time is non-finite.
        """
        posed = self.motion.gaussians_at(self.gaussians, clamped_time(time))
        undo = self.normalisation
        return Gaussians(
            undo.undo(posed.means).detach(),
            posed.quats.detach(),
            undo.undo_scale(posed.scales).detach(),
            posed.opacities.detach(),
            posed.sh_dc.detach(),
            posed.sh_rest.detach(),
            posed.sharpness,
        ).plain()

    @unaffected
    @torch.no_grad()
    def render(
        self, camera: Camera, time: float, background: tuple[float, float, float] | Tensor | None = None
    ) -> Image:
        """Render the scene at ``time`` from a camera in world units.

        Args:
            camera: on any device; arrays and lists of any kind of number are taken.
            time: clamped to [0, 1].
            background: colour in [0, 1]; None: ``background_color``.

        Returns:
            ``rgb`` [H, W, 3], ``alpha`` and ``depth`` [H, W] in world units, float32 on the scene's device; ``rgb`` may
            slightly exceed [0, 1].

        Raises:
            UserError: the time is non-finite.
            ValueError: the camera or the background cannot be drawn.
        """
        time = clamped_time(time)
        color = given_color(self.background_color if background is None else background)
        view = self.normalisation.apply_camera(given_camera(camera))
        if self.device.type == "cuda" and self.motion.takes_time_tensor:
            return self.frame_graph().render(view, time, color)
        posed = self.motion.gaussians_at(self.gaussians, time)
        drawn = posed, view.to(self.device), color.to(self.device)
        return render(*drawn, antialiased=self.config.antialiased, depth_unit=self.normalisation.scale)

    def turntable(self, path: str | Path, **options: Any) -> Path:
        """Write a film in which the camera goes round the moving scene.

        If the subject is cut out, the camera stands where all of it stays in the picture at all times; otherwise the
        film shows what the training cameras saw.

        Args:
            path: a name that ends in .mp4 or .gif, or a folder for numbered PNGs.
            options: ``frames`` (120), ``size`` (512: longer side in pixels; an .mp4 has even sides), ``fps`` (30),
                ``time`` (None: the scene moves; else the time at which it stands), ``show`` (``rgb``, ``depth``,
                ``alpha``, ``nodes``, ``trajectories``).

        Returns:
            The path.

        Raises:
            UserError: an option is out of range, or the film cannot be written.
        """
        return film_maker.film(self, path, **options)

    def _repr_html_(self) -> str | None:
        """Return the scene's page, which notebooks show; None if it has none (docs/page.md)."""
        return page_maker.page(self)

    def frame_graph(self) -> FrameGraph:
        """Return the renderer of this scene's frames on CUDA, which takes cameras in normalised units. It is kept until
        ``gaussians`` or ``motion`` is replaced."""
        frames = self._frames
        if frames is None or frames.gaussians is not self.gaussians or frames.motion is not self.motion:
            frames = self._frames = FrameGraph(
                self.gaussians,
                self.motion,
                antialiased=self.config.antialiased,
                depth_unit=self.normalisation.scale,
            )
        return frames

    @unaffected
    @torch.no_grad()
    def control_points_at(self, time: float) -> Tensor:
        """Return the control points [M, 3] at ``time``, clamped to [0, 1], in world units; [0, 3] for motion models
        without control points.

        Raises:
            UserError: the time is non-finite.
        """
        return self.normalisation.undo(self.motion.control_points_at(clamped_time(time)))

    def tensors(self) -> dict[str, Tensor]:
        """Return the scene's tensors by name, for a checkpoint."""
        tensors = {f"gaussians.{name}": getattr(self.gaussians, name) for name in GaussianParameters.NAMES}
        tensors.update({f"motion.{name}": value for name, value in self.motion.state_dict().items()})
        return tensors

    def metadata(self) -> dict[str, Any]:
        return {
            "config": lasting(to_dict(self.config)),
            "normalisation": {"centre": self.normalisation.centre.tolist(), "scale": self.normalisation.scale},
            "overview": self.overview.to_dict(),
            "step": self.step,
            "motion": self.motion.name,
        }


def scene_from(tensors: dict[str, Tensor], metadata: dict[str, Any], device: str, source: str) -> Scene:
    """Make a scene from the results of :meth:`Scene.tensors` and :meth:`Scene.metadata`.

    Raises:
        UserError: tensors are missing or inconsistent.
    """
    check_tensors(tensors, source)
    check_metadata(metadata, source)
    try:
        config = from_dict(with_newer_fields(metadata["config"], recorded=True), source)
        check_sizes(config, f"{source}: ")
        rows = checkpoint.strip(tensors, "gaussians.")
        count = len(rows["means"])
        for name in ("shading", "correctives"):  # Absent from checkpoints of older versions.
            rows.setdefault(name, torch.zeros(count, 0))
        sharpness = config.sharpness if metadata["motion"] != Spheres.name else 0.0  # none in stage 1
        shaded, corrected = (rows[name].shape[1] > 0 for name in ("shading", "correctives"))
        gaussians = GaussianParameters.empty(
            count, rows["sh_rest"].shape[1], rows["hyper"].shape[1], shaded, corrected, "cpu", sharpness
        )
        gaussians.load_state_dict(rows)
        columns = config.motion.hyper_columns
        if metadata["motion"] == ControlPoints.name and gaussians.hyper.shape[1] != columns:
            raise ValueError(f"gaussians.hyper has {gaussians.hyper.shape[1]} columns, not {columns}")
        state = checkpoint.strip(tensors, "motion.")
        motion = build_motion(metadata["motion"], config, state)
        motion.load_state_dict(state)
        unit = metadata["normalisation"]
        normalisation = Normalisation(np.asarray(unit["centre"], dtype=np.float64), float(unit["scale"]))
        overview = Overview.from_dict(metadata["overview"])
        step = int(metadata["step"])
    except (KeyError, IndexError, RuntimeError, ValueError, TypeError) as error:
        raise UserError(
            f"{source}: not a complete checkpoint ({reason(error)}); train again or use the previous one"
        ) from error
    return Scene(gaussians.to(device), motion.to(device), normalisation, config, overview, step=step)
