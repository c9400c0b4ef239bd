"""Cases of motion: neighbours, weights, skinning, rigidity, sampling, planes and networks."""

from __future__ import annotations

import torch
from torch import Tensor

from fuzz.cases_render import leaf, on
from fuzz.fence import walled
from fuzz.poison import Draw, finite_rows
from scgs_warp.ops.arap import arap_energy, local_rotations, trajectory_graph
from scgs_warp.ops.neighbors import NeighborSearch, nearest, node_lists, rbf_weights
from scgs_warp.ops.network import network
from scgs_warp.ops.planes import PAIRS, plane_features, plane_variation
from scgs_warp.ops.sampling import farthest_points
from scgs_warp.ops.skinning import skin, skin_rbf
from scgs_warp.types import Pose

from . import laws


def nodes_count(d: Draw) -> int:
    return int(d.pick((1, 2, 4, 5, 15, 16, 17, 40, 90)))


def case_neighbors(d: Draw, device: str) -> None:
    """Indices are in range; poisoned points change no other point's neighbours; a cached search equals a new one."""
    count, total = d.count(), nodes_count(d)
    width, k = int(d.pick((1, 2, 3, 3, 3, 5, 11, 12, 20))), int(d.rng.integers(1, min(total, 16) + 1))
    points, nodes = d.normal(count, width), d.normal(total, width)
    broken_nodes = torch.zeros(total, dtype=torch.bool)
    if d.chance(0.4):
        broken_nodes = d.rows(total)
        d.poison(nodes, broken_nodes)
    clean = points.clone()
    hit = d.rows(count)
    d.poison(points, hit)
    points, nodes, clean = on(device, points, nodes, clean)
    indices, distances = nearest(points, nodes, k)
    assert indices.dtype == torch.int32 and bool(((indices >= 0) & (indices < total)).all())
    assert bool((distances >= 0).all()) and bool((distances[:, 1:] >= distances[:, :-1]).all())
    others, other_distances = nearest(clean, nodes, k)
    laws.equal("indices of the valid", indices[~hit], others[~hit])
    laws.equal("distances of the valid", distances[~hit], other_distances[~hit])
    finite = distances.isfinite()
    assert bool(finite_rows(nodes).to(device)[indices.long()][finite].all()), "a broken node is a neighbour"
    search = NeighborSearch()
    for _ in range(3):
        laws.equal("indices of the search", search(points, nodes, k), nearest(points, nodes, k)[0])
        points = points + 0.01 * d.normal(count, width).to(device)
        nodes = nodes + 0.01 * d.normal(total, width).to(device)


def case_rbf(d: Draw, device: str) -> None:
    """Weights lie in [0, 1] and rows sum to 1, for any radii."""
    count, total, width = d.count(), nodes_count(d), int(d.pick((3, 3, 5, 11)))
    k = int(d.rng.integers(1, min(total, 16) + 1))
    points, nodes, radii = d.normal(count, width), d.normal(total, width), d.uniform(total, low=0.1)
    strengths = d.uniform(total, low=0.1)
    indices = torch.from_numpy(d.rng.integers(0, total, (count, k))).int()
    hit, hit_nodes = d.rows(count), d.rows(total)
    for tensor, rows in ((points, hit), (nodes, hit_nodes), (radii, hit_nodes), (strengths, hit_nodes)):
        if d.chance(0.4):
            d.poison(tensor, rows)
    leaves = [leaf(x) for x in on(device, points, nodes, radii, strengths)]
    indices = indices.to(device)
    lists = node_lists(indices, total) if d.chance() else None
    named = d.chance()
    weights = rbf_weights(*leaves[:3], indices, leaves[3] if named else None, lists=lists)
    laws.finite("weights", weights)
    assert bool(((weights >= 0) & (weights <= 1)).all()) and bool(((weights.sum(1) - 1).abs() < 1e-5).all())
    wanted = leaves if named else leaves[:3]
    grads = torch.autograd.grad(weights, wanted, d.normal(*weights.shape).to(device))
    laws.finite("gradients of points, nodes, radii, strengths", *grads)
    laws.all_zero_where("gradients of the broken", ~finite_rows(points).to(device), grads[:1])


def moved_by(d: Draw, count: int, total: int, k: int) -> tuple[list[Tensor], list[Tensor | None], Tensor]:
    """Return unpoisoned means, quats, nodes; translations, rotations, shape rotations, log scales; indices."""
    own = [d.normal(count, 3), d.normal(count, 4), d.normal(total, 3)]
    pose: list[Tensor | None] = [d.normal(total, 3), d.normal(total, 4)]
    pose.append(d.normal(total, 4) if d.chance() else None)
    pose.append(0.1 * d.normal(total, 3) if d.chance() else None)
    return own, pose, torch.from_numpy(d.rng.integers(0, total, (count, k))).int()


def case_skin(d: Draw, device: str) -> None:
    """Valid Gaussians moved by valid control points move as without the others, in all three forms."""
    count, total, k = d.count(), nodes_count(d), int(d.rng.integers(1, 6))
    own, pose, indices = moved_by(d, count, total, k)
    weights = torch.softmax(d.normal(count, k), 1)
    clean = skinned(own, pose, indices, weights, device, None)[0]
    hit, hit_nodes = d.rows(count), d.rows(total)
    for tensor, rows in ((own[0], hit), (own[1], hit), (weights, hit), (own[2], hit_nodes)):
        if d.chance(0.3):
            d.poison(tensor, rows)
    for tensor in pose:
        if tensor is not None and d.chance(0.3):
            d.poison(tensor, hit_nodes)
    lists = node_lists(indices.to(device), total) if d.chance() else None
    outputs, leaves = skinned(own, pose, indices, weights, device, lists)
    untouched = ~hit & ~hit_nodes[indices.long()].any(1)
    check_moved(d, outputs, clean, leaves, untouched.to(device), finite_rows(own[0], own[1]).to(device))
    with torch.no_grad():
        lanes = skinned(own, pose, indices, weights, device, None)[0]
    for ours, other in zip(lanes, outputs):
        sound = untouched.to(device)
        assert torch.allclose(ours[sound], other[sound], rtol=1e-4, atol=1e-4), "forms differ"


def skinned(own, pose, indices, weights, device, lists) -> tuple[list[Tensor], list[Tensor]]:
    values = [None if x is None else leaf(x.to(device)) for x in (*own, *pose, weights)]
    means, quats, nodes, *fields, weights = values
    found = skin(means, quats, nodes, Pose(*fields), indices.to(device), weights, lists=lists)
    return [x for x in found if x is not None], [x for x in values if x is not None]


def check_moved(d: Draw, outputs, clean, leaves, untouched: Tensor, whole: Tensor) -> None:
    for name, ours, other in zip(("means", "quats", "log scales"), outputs, clean):
        laws.equal(f"{name} of the valid", ours[untouched], other[untouched])
        laws.finite(f"{name} of the valid", ours[untouched])
    incoming = [d.normal(*x.shape).to(x.device) for x in outputs]
    grads = torch.autograd.grad(outputs, leaves, incoming, allow_unused=True)
    laws.finite("gradients of means, quats, (hyper), nodes, pose, weights", *grads)
    laws.all_zero_where("gradients of the broken", ~whole, grads[:2])


def case_skin_rbf(d: Draw, device: str) -> None:
    """Check the same with weights computed from radii in one pass."""
    count, total, k = d.count(), nodes_count(d), int(d.rng.integers(1, 6))
    own, pose, indices = moved_by(d, count, total, k)
    width = int(d.pick((0, 0, 2, 8, 11)))
    more = {"radii": d.uniform(total, low=0.2)}
    if d.chance():
        more["strengths"] = d.uniform(total, low=0.1)
    if width:
        more.update(hyper_points=0.3 * d.normal(count, width), hyper_nodes=0.3 * d.normal(total, width))
    clean = skinned_rbf(own, pose, more, indices, device)[0]
    hit, hit_nodes = d.rows(count), d.rows(total)
    for tensor, rows in ((own[0], hit), (own[1], hit), (own[2], hit_nodes)):
        if d.chance(0.3):
            d.poison(tensor, rows)
    for name, tensor in (*more.items(), *enumerate(pose)):
        if tensor is not None and d.chance(0.25):
            d.poison(tensor, hit if name == "hyper_points" else hit_nodes)
    outputs, leaves = skinned_rbf(own, pose, more, indices, device)
    untouched = ~hit & ~hit_nodes[indices.long()].any(1)
    check_moved(d, outputs, clean, leaves, untouched.to(device), finite_rows(own[0], own[1]).to(device))


def skinned_rbf(own, pose, more, indices, device) -> tuple[list[Tensor], list[Tensor]]:
    means, quats, nodes = (leaf(x.to(device)) for x in own)
    fields = [None if x is None else leaf(x.to(device)) for x in pose]
    extra = {name: leaf(x.to(device)) for name, x in more.items()}
    found = skin_rbf(means, quats, nodes, pose=Pose(*fields), indices=indices.to(device), **extra)
    leaves = [x for x in (means, quats, nodes, *fields, *extra.values()) if x is not None]
    return [x for x in found if x is not None], leaves


def case_arap(d: Draw, device: str) -> None:
    """Rotations are always rotations; energies away from invalid points, and all gradients, are finite."""
    total, edges = nodes_count(d), int(d.rng.integers(0, 9))
    rest, posed = d.normal(total, 3), d.normal(total, 3)
    neighbors = torch.from_numpy(d.rng.integers(-1, total, (total, edges))).int()
    weights, hit = d.uniform(total, edges), d.rows(total)
    for tensor in (rest, posed, weights):
        if d.chance(0.4):
            d.poison(tensor, hit)
    leaves = [leaf(x) for x in on(device, rest, posed)]
    neighbors, weights = on(device, neighbors, weights)
    turns = local_rotations(*leaves, neighbors, weights)
    laws.finite("rotations", turns)
    orthogonal = turns @ turns.mT - torch.eye(3, device=device)
    assert bool((orthogonal.abs() < 1e-4).all()) and bool((torch.linalg.det(turns) > 0).all()), "no rotation"
    energies = arap_energy(*leaves, neighbors, weights)
    beside = hit[neighbors.cpu().long().clamp(min=0)].any(1) | hit if edges else hit
    laws.finite("energies away from the broken", energies[~beside.to(device)])
    grads = torch.autograd.grad(energies, leaves, d.normal(total).to(device))
    laws.finite("gradients of rest, posed", *grads)


def case_trajectories(d: Draw, device: str) -> None:
    times, total, count = int(d.rng.integers(1, 5)), nodes_count(d), int(d.rng.integers(1, 16))
    tracks = d.normal(times, total, 3)
    for one in tracks:
        if d.chance():
            d.poison(one, d.rows(total))
    neighbors, weights = trajectory_graph(tracks.to(device), count)
    laws.finite("weights", weights)
    assert bool(((neighbors >= -1) & (neighbors < total)).all()) and bool((weights >= 0).all())
    assert not bool(weights[neighbors < 0].any())
    assert not bool((neighbors == torch.arange(total, device=device)[:, None]).any()), "a node beside itself"


def case_sampling(d: Draw, device: str) -> None:
    """Samples are distinct points, invalid ones last."""
    count = d.count()
    points = d.normal(count, int(d.pick((1, 3, 3, 9))))
    d.poison(points, d.rows(count))
    chosen_count = int(d.rng.integers(0, count + 1))
    start = int(d.rng.integers(count)) if count else 0
    chosen = farthest_points(points.to(device), chosen_count, start).cpu()
    assert len(chosen.unique()) == len(chosen) == chosen_count
    broken = ~finite_rows(points)[chosen[1:]]
    assert bool((broken.int().diff() >= 0).all()), "a broken point before a good one"


def case_planes(d: Draw, device: str) -> None:
    """Any position and any time read inside the planes."""
    count, extents = d.count(), [[int(d.rng.integers(2, 9)) for _ in range(4)] for _ in range(int(d.pick((1, 2))))]
    planes = [walled(d.normal(own[b], own[a], 32).to(device)) for own in extents for a, b in PAIRS]
    planes = [plane.requires_grad_() for plane in planes]
    positions = d.uniform(count, 3, low=-1.0)
    d.poison(positions, d.rows(count))
    positions = leaf(positions.to(device))
    time = float(d.uniform(1)) if d.chance(0.6) else float(d.values(1))
    features = plane_features(positions, time, planes)
    laws.finite("features", features)
    grads = torch.autograd.grad(features, [positions, *planes], d.normal(*features.shape).to(device))
    laws.finite("gradients of positions, planes", *grads)
    laws.zero("gradients of broken coordinates", grads[0][~positions.isfinite()])
    variation = plane_variation(planes)
    laws.finite("variation", variation)
    laws.finite("gradients of the variation", *torch.autograd.grad(variation, planes))


def case_network(d: Draw, device: str) -> None:
    """Rows are independent; finite rows of moderate size have finite values."""
    if device != "cpu":
        return
    rows, times, hidden = d.count() % 70, int(d.pick((0, 1, 1, 2))), 32 * int(d.pick((1, 2)))
    a, b, depth, out = int(d.rng.integers(0, 40)), int(d.rng.integers(1, 20)), int(d.rng.integers(2, 5)), 10
    widths = [a + b, *[hidden] * (depth - 1)]
    if depth > 2 and d.chance():
        widths[2] += a + b
    weights = [walled(0.2 * d.normal(hidden if i < depth - 1 else out, w)) for i, w in enumerate(widths)]
    biases = [walled(0.1 * d.normal(len(w))).requires_grad_() for w in weights]
    weights = [weight.requires_grad_() for weight in weights]
    where, when, hit = d.normal(rows, a), d.normal(times, b), d.rows(rows)
    clean = network(where, when, weights, biases).detach()
    if a:
        d.poison(where, hit)
    where = leaf(where)
    values = network(where, when, weights, biases)
    good = (~hit).repeat(times)
    laws.equal("values of the valid", values.detach()[good], clean[good])
    laws.finite("values of the valid", values[good])
    incoming = d.normal(*values.shape)
    incoming[~good] = 0.0
    grads = torch.autograd.grad(values, [where, *weights, *biases], incoming)
    laws.finite("gradients of the valid", grads[0][~hit])
    if bool(finite_rows(where).all()) and bool((where.abs() < 1e15).all()):
        laws.finite("gradients of weights, biases", *grads[1:])


CASES = {
    "neighbors": (case_neighbors, 2),
    "rbf weights": (case_rbf, 2),
    "skin": (case_skin, 3),
    "skin rbf": (case_skin_rbf, 3),
    "arap": (case_arap, 2),
    "trajectories": (case_trajectories, 1),
    "sampling": (case_sampling, 1),
    "planes": (case_planes, 2),
    "network": (case_network, 1),
}
