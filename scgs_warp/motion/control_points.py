"""Sparse control points moved by a network: the model of SC-GS (paper section 4.1, Eq. 5-7)."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config.presets import LossConfig, MotionConfig, TrainConfig
from ..gaussians import GaussianParameters
from ..ops.activations import sigmoid
from ..ops.correctives import correct
from ..ops.finishing import finish
from ..ops.neighbors import NeighborSearch, rbf_weights
from ..ops.posing import pose_gaussians, unit_pose
from ..ops.skinning import skin, skin_rbf
from ..runtime.device_copies import sent
from ..seeding import Purpose, generator
from ..types import Gaussians, Pose
from .base import Motion, MotionStep, TrainingPose, network_rate
from .chunks import ChunkedNetwork
from .network import DeformationNetwork
from .pose_track import PoseTrack
from .rigidity import (
    Graph,
    arap_times,
    arap_weight,
    build_graph,
    graph_is_old,
    graph_of_state,
    graph_state,
    rigidity,
)
from .tensor_states import NetworkModules, TensorState, same_states, states_of

WITHIN_REACH = 0.999
"""Share of the pairs of a Gaussian and one of its control points that are no farther apart than a turn's reach."""
NODE_NAMES = ("positions", "log_radii", "hyper", "strength_logits")
"""Parameters with one row per control point."""


def heads_of(config: MotionConfig) -> dict[str, int]:
    """Return the number of output channels of the network per control point for each head, by name."""
    heads = {"rotations": 4, "translations": 3}
    if config.shape_rotation:
        heads["shape_rotations"] = 4
    if config.scale_residual:
        heads["log_scales"] = 3
    if config.has_tints:
        heads["tints"] = 3
    return heads


def make_network(config: MotionConfig, heads: dict[str, int], seed: int) -> DeformationNetwork | ChunkedNetwork:
    """Make a network that does not move anything yet: one, or one per chunk of time."""

    def make(chunk: int) -> DeformationNetwork:
        return DeformationNetwork(
            heads,
            layers=config.layers,
            width=config.width,
            skip=config.skip,
            position_frequencies=config.position_frequencies,
            time_frequencies=config.time_frequencies,
            bfloat16=config.bfloat16,
            bfloat16_adjoint=config.bfloat16_adjoint,
            generator=generator(seed, Purpose.NETWORK, chunk) if chunk else generator(seed, Purpose.NETWORK),
        )

    return make(0) if config.chunks == 1 else ChunkedNetwork(make, config.chunks)


def _posed(
    gaussians: GaussianParameters,
    moved: tuple[Tensor, Tensor, Tensor | None],
    pose: Pose,
    masked: bool,
    quats_own: Tensor | None = None,
) -> Gaussians:
    """Activate the moved Gaussians.

    Args:
        moved: means, quats, and log scales or tints, from skinning.
        pose: of the control points that moved them.
        masked: the last hyper-coordinate is the logit of the share of the motion that a Gaussian takes.
        quats_own: [N, 4] rotations that shading and correctives follow in place of the moved ones: those of the trained
            motion, under an edit.
    """
    means, quats, extras = moved
    rest = gaussians.rest()
    if masked:
        if gaussians.correctives.shape[1]:
            means = correct(means, gaussians.correctives, gaussians.quats, quats, quats_own)
            rest = *rest[:5], gaussians.correctives.detach()[:, :0], rest[6]
        share = sigmoid(gaussians.hyper[:, -1:])
        still = F.normalize(gaussians.quats, dim=1)
        still = torch.where((still * quats).sum(1, keepdim=True) < 0, -still, still)
        means = gaussians.means + share * (means - gaussians.means)
        quats = still + share * (quats - still)
        if quats_own is not None:
            quats_own = torch.where((still * quats_own).sum(1, keepdim=True) < 0, -quats_own, quats_own)
            quats_own = still + share * (quats_own - still)
        extras = None if extras is None else share * extras
    log_scales, tints = (extras, None) if pose.tints is None else (None, extras)
    means, scales, opacities, sh_dc = finish(means, quats, rest, log_scales, tints, quats_own)
    return Gaussians(means, quats, scales, opacities, sh_dc, gaussians.sh_rest, gaussians.sharpness)


class ControlPoints(Motion):
    """Positions [M, 3], radii [M], optional hyper-coordinates [M, H] and weights [M], and the network."""

    name = "control-points"

    def __init__(
        self, positions: Tensor, radii: Tensor, network: DeformationNetwork | ChunkedNetwork, config: MotionConfig
    ) -> None:
        super().__init__()
        count, device = positions.shape[0], positions.device
        self.config = config
        self.positions = nn.Parameter(positions.clone())
        self.log_radii = nn.Parameter(radii.log())
        self.hyper = nn.Parameter(torch.full((count, config.hyper_dim), 1e-2 * config.hyper_stretch, device=device))
        self.strength_logits = nn.Parameter(torch.zeros(count if config.node_weight else 0, device=device))
        self.network = network
        self.takes_time_tensor = isinstance(network, DeformationNetwork)
        self.graph: Graph | None = None
        self._cached: tuple[Tensor, Tensor] | None = None
        self._cached_for: list[TensorState] | None = None
        self._search = NeighborSearch()
        self._kept: tuple[PoseTrack, list[TensorState]] | None = None
        self._network_modules: NetworkModules | None = None

    def __len__(self) -> int:
        return self.positions.shape[0]

    def poses(self, times: Tensor) -> list[Pose]:
        """Return one :class:`Pose` per time, from one network evaluation. The network's input is detached, because
        gradients through the encoding's high octaves would make the control points oscillate."""
        positions, times = self.positions.detach(), sent(times, self.positions.device)
        return [unit_pose(motion, self.network.heads) for motion in self.network.motion(positions, times).unbind()]

    def _hyper(self, gaussians: GaussianParameters) -> Tensor:
        """Return the Gaussians' hyper-coordinates [N, H], without the mask's logit."""
        return gaussians.hyper[:, : self.config.hyper_dim].contiguous()

    def neighbors(self, gaussians: GaussianParameters) -> Tensor:
        """Find the nearest control points [N, K] int32 of every Gaussian at rest, exactly and anew at every call: in
        space, with hyper-coordinates appended if the model has them."""
        points, nodes = gaussians.means.detach(), self.positions.detach()
        if self.config.hyper_dim:
            points = torch.cat([points, self._hyper(gaussians).detach()], dim=1)
            nodes = torch.cat([nodes, self.hyper.detach()], dim=1)
        return self._search(points, nodes, self.config.neighbors)

    def binding(self, gaussians: GaussianParameters) -> tuple[Tensor, Tensor]:
        """Compute neighbours and their RBF weights (Eq. 5): indices [N, K], weights [N, K]. They do not depend on
        time."""
        indices = self.neighbors(gaussians)
        points, nodes = gaussians.means, self.positions
        if self.config.hyper_dim:
            points = torch.cat([gaussians.means, self._hyper(gaussians)], dim=1)
            nodes = torch.cat([self.positions, self.hyper], dim=1)
        strengths = self.strength_logits.sigmoid() if self.config.node_weight else None
        return indices, rbf_weights(points, nodes, self.log_radii.exp(), indices, strengths)

    def apply_pose(
        self,
        gaussians: GaussianParameters,
        pose: Pose,
        binding: tuple[Tensor, Tensor],
        own_pose: Pose | None = None,
    ) -> Gaussians:
        """Move all Gaussians by linear blend skinning (Eq. 6-7). Editing replaces only ``pose``; shading and
        correctives follow the rotations of ``own_pose`` if given, those of the trained motion."""
        rotations = None
        if own_pose is not None:
            rotations = skin(gaussians.means, gaussians.quats, self.positions, own_pose, *binding)[1]
        if not (torch.is_grad_enabled() or self.config.mask):
            moved = pose_gaussians(gaussians.rest(), self.positions, pose, *binding, rotations)
            return Gaussians(*moved, gaussians.sh_rest, gaussians.sharpness)
        moved = skin(gaussians.means, gaussians.quats, self.positions, pose, *binding)
        return _posed(gaussians, moved, pose, self.config.mask, rotations)

    def bind_and_pose(self, gaussians: GaussianParameters, pose: Pose, frozen: bool) -> Gaussians:
        """Bind and pose all Gaussians in one pass; ``frozen`` control points receive no gradient."""
        hyper = self.config.hyper_dim > 0
        rows = (
            self.positions,
            self.log_radii.exp(),
            self.strength_logits.sigmoid() if self.config.node_weight else None,
            self.hyper if hyper else None,
        )
        if frozen:
            rows = tuple(None if row is None else row.detach() for row in rows)
        nodes, radii, strengths, hyper_nodes = rows
        assert nodes is not None and radii is not None
        hyper_points = self._hyper(gaussians) if hyper else None
        indices = self.neighbors(gaussians)
        moved = skin_rbf(
            gaussians.means, gaussians.quats, nodes, radii, pose, indices, strengths, hyper_points, hyper_nodes
        )
        return _posed(gaussians, moved, pose, self.config.mask)

    def cache_binding(self, gaussians: GaussianParameters | None) -> None:
        """Keep the Gaussians' neighbours and weights, which do not depend on time; with None, discard them."""
        with torch.no_grad():
            self._cached = None if gaussians is None else self.binding(gaussians)
        self._cached_for = None if gaussians is None else self._binding_state(gaussians)

    def _binding_state(self, gaussians: GaussianParameters) -> list[TensorState]:
        """Identify the inputs of :meth:`binding`."""
        own = self.positions, self.log_radii, self.hyper, self.strength_logits
        return states_of((gaussians.means, gaussians.hyper, *own))

    def _cache_holds(self, gaussians: GaussianParameters) -> bool:
        return self._cached_for is not None and same_states(self._cached_for, self._binding_state(gaussians))

    def keep_poses(
        self,
        gaussians: GaussianParameters,
        tolerance: float,
        tell: Callable[[int, int], None] = lambda done, total: None,
    ) -> bool:
        """Sample the motion once, so that later poses are interpolated: on a CPU, without gradients.

        As soon as a parameter or a layer is replaced, or a parameter is changed in place, poses are the network's
        again. Changes through ``.data`` are not noticed.

        Returns:
            Whether poses are kept. False: on a GPU, for parameters that count no changes (inference tensors), if a
            parameter changed meanwhile, and if the tolerance is not met.
        """
        self._kept = None
        if self.positions.is_cuda or any(x.is_inference() for x in self.parameters()):
            return False
        state = self._motion_state()
        with torch.no_grad():
            extent = float((self.positions.amax(0) - self.positions.amin(0)).max()) or 1.0
            offsets = gaussians.means[:, None] - self.positions[self.neighbors(gaussians).long()]
            distances = offsets.norm(dim=-1).flatten()
            reach = float(distances.kthvalue(max(1, int(WITHIN_REACH * len(distances)))).values)
            track = PoseTrack.of(self.poses, reach, tolerance * extent, tell)
        if track is not None and same_states(state, self._motion_state()):
            self._kept = track, state
        return self._kept is not None

    @property
    def kept_poses(self) -> PoseTrack | None:
        return None if self._kept is None else self._kept[0]

    def _motion_state(self) -> list[TensorState]:
        """Identify the parameters of :meth:`poses`. Walking over all modules would take as long as interpolating."""
        known = self._network_modules
        if known is None or known.network is not self.network or not known.hold():
            known = self._network_modules = NetworkModules(self.network)
        return states_of([self.positions, self.log_radii, *known.parameters()])

    def pose_at(self, time: float | Tensor) -> Pose:
        """Return the pose at a time in [0, 1]: interpolated if poses are kept and the host knows the time."""
        kept = self._kept
        if kept is not None and not isinstance(time, Tensor) and not torch.is_grad_enabled():
            track, state = kept
            if same_states(state, self._motion_state()):
                return track.at(time)
            self._kept = None
        return self.poses(time if isinstance(time, Tensor) else torch.tensor([time]))[0]

    def gaussians_at(self, gaussians: GaussianParameters, time: float | Tensor) -> Gaussians:
        pose = self.pose_at(time)
        if self._cached is None or torch.is_grad_enabled():
            return self.bind_and_pose(gaussians, pose, frozen=False)
        if not self._cache_holds(gaussians):
            self.cache_binding(gaussians)
        return self.apply_pose(gaussians, pose, self._cached)

    def plan(
        self, gaussians: GaussianParameters, time: float, step: int, config: TrainConfig, view: int = 0
    ) -> MotionStep:
        if step < config.freeze:
            return MotionStep((time,), phase="frozen")
        weight = arap_weight(step, config.loss)
        if weight == 0.0:
            return MotionStep((time,))
        self.refresh_graph(step, config.loss)
        others = arap_times(config.loss, generator(config.seed, Purpose.ARAP_TIMES, step * config.batch + view))
        return MotionStep((time, *others), 0.0 if self.graph is None else weight)

    def refresh_due(self, step: int, config: TrainConfig) -> bool:
        compares = step >= config.freeze and arap_weight(step, config.loss) > 0.0
        return compares and graph_is_old(self.graph, step, config.loss)

    def train_at(
        self,
        gaussians: GaussianParameters,
        plan: MotionStep,
        times: Tensor,
        weight: float | Tensor,
        config: TrainConfig,
    ) -> TrainingPose:
        frozen = plan.phase == "frozen"
        with torch.set_grad_enabled(not frozen):
            poses = self.poses(times)
        posed = self.bind_and_pose(gaussians, poses[0], frozen)
        if plan.weight == 0.0 or self.graph is None:
            return TrainingPose(posed, None)
        instants = [self.positions.detach() + pose.translations for pose in poses]
        return TrainingPose(posed, weight * rigidity(instants, self.graph))

    def refresh_graph(self, step: int, loss: LossConfig) -> None:
        if graph_is_old(self.graph, step, loss):
            self.graph = build_graph(self.trajectories, loss, self.graph, loss.arap_slack)

    def trajectories(self, times: Tensor) -> Tensor:
        """Return the control points [T, M, 3] at ``times`` [T]."""
        return torch.stack([self.positions.detach() + pose.translations for pose in self.poses(times)])

    def control_points_at(self, time: float) -> Tensor:
        with torch.no_grad():
            return self.trajectories(torch.tensor([time]))[0]

    def rates(self, step: int, config: TrainConfig) -> dict[str, float]:
        optim = config.optim
        network = network_rate(step, config.freeze, optim)
        decay = network / (optim.network * (optim.network_scale or 1.0)) if optim.network > 0 else 1.0
        rates = {name: network for name, _ in self.named_parameters() if name.startswith("network.")}
        positions = optim.node_positions * decay if config.motion.train_positions else 0.0
        nodes = optim.nodes * (decay if optim.nodes_decay else 1.0)
        hyper = nodes * config.motion.hyper_stretch
        return {**rates, "positions": positions, "log_radii": nodes, "hyper": hyper, "strength_logits": nodes}

    def extra_state(self) -> dict[str, Tensor]:
        return graph_state(self.graph)

    def load_extra_state(self, tensors: dict[str, Tensor]) -> None:
        self.graph = graph_of_state(tensors, self.graph)
