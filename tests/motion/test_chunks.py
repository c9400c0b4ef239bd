"""Long films: one network per chunk of time, blended where chunks meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.export_files import gltf_arrays
from helpers.page_reader import pose_of, read_page
from helpers.tiny import tiny_config, tiny_dataset, trained_pose
from scgs_warp.config.presets import from_dict, to_dict
from scgs_warp.config.validation import check
from scgs_warp.edit import EditSession
from scgs_warp.errors import UserError
from scgs_warp.export import page_scene
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.run import export
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion import ControlPoints, PerGaussian, Spheres, build_motion
from scgs_warp.motion.chunks import OVERLAP, ChunkedNetwork, empty_chunk, shares_at
from scgs_warp.motion.network import DeformationNetwork
from scgs_warp.scene.scene import Scene
from scgs_warp.scene.validation import check_motion
from scgs_warp.storage import checkpoint
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState


def chunked_motion(chunks: int, seed: int = 3) -> ControlPoints:
    """Control points at random, whose networks all move them differently."""
    config = tiny_config(60, motion={"chunks": chunks})
    motion = build_motion("control-points", config)
    assert isinstance(motion, ControlPoints)
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        motion.positions.copy_(torch.randn(motion.positions.shape, generator=random))
        for name, parameter in motion.named_parameters():
            if ".head." in name:
                parameter.copy_(0.3 * torch.randn(parameter.shape, generator=random))
    motion.eval()
    return motion


def network_of(motion: ControlPoints, chunk: int) -> DeformationNetwork:
    network = motion.network
    assert isinstance(network, ChunkedNetwork)
    found = network.chunks[chunk]
    assert isinstance(found, DeformationNetwork)
    return found


@pytest.mark.parametrize("chunks", [2, 4, 7])
def test_shares_sum_to_one_and_have_no_step_nor_kink(chunks):
    times = np.linspace(0.0, 1.0, 40_001)
    table = np.zeros((len(times), chunks))
    for row, time in enumerate(times):
        for chunk, share in shares_at(float(time), chunks).items():
            table[row, chunk] = share
    assert np.abs(table.sum(1) - 1.0).max() < 1e-12 and table.min() >= 0.0
    speed = np.diff(table, axis=0) / (times[1] - times[0])
    assert np.abs(speed).max() < 1.01 * 1.5 * chunks / (2 * OVERLAP)
    acceleration = np.abs(np.diff(speed, axis=0)).max() / (times[1] - times[0])
    assert acceleration < 1.01 * 6.0 * (chunks / (2 * OVERLAP)) ** 2
    for border in range(1, chunks):
        assert shares_at(border / chunks, chunks)[border] == pytest.approx(0.5)
        for side, own in ((-1, border - 1), (1, border)):
            assert shares_at((border + 1.01 * side * OVERLAP) / chunks, chunks) == {own: 1.0}


def test_the_film_begins_and_ends_with_one_network():
    assert shares_at(0.0, 4) == {0: 1.0} and shares_at(1.0, 4) == {3: 1.0}
    assert shares_at(-0.01, 4) == {0: 1.0} and shares_at(1.01, 4) == {3: 1.0}  # a time with noise


@torch.no_grad()
def test_away_from_borders_a_chunk_has_the_bits_of_its_own_network():
    motion = chunked_motion(4)
    found = motion.poses(torch.tensor([0.375]))[0]
    alone = network_of(motion, 1)(motion.positions, torch.tensor([0.5]))
    assert torch.equal(found.translations, alone["translations"][0])
    assert not torch.equal(found.translations, motion.poses(torch.tensor([0.625]))[0].translations)


@torch.no_grad()
def test_blended_as_the_definition_says():
    motion = chunked_motion(4)
    time, across = 0.5 + 0.6 * OVERLAP / 4, 0.5 + 0.5 * 0.6
    share = 3 * across**2 - 2 * across**3
    before, after = (
        network_of(motion, chunk)(motion.positions, torch.tensor([4 * time - chunk]))["translations"][0].double()
        for chunk in (1, 2)
    )
    expected = (1 - share) * before + share * after
    torch.testing.assert_close(motion.poses(torch.tensor([time]))[0].translations.double(), expected, rtol=0, atol=2e-5)


@torch.no_grad()
def test_no_jump_where_chunks_meet():
    motion, step = chunked_motion(3), 2e-5
    for border in (1 / 3, 2 / 3):
        for place in (border, border - OVERLAP / 3, border + OVERLAP / 3):
            times = place + step * torch.tensor([-1.5, -0.5, 0.5, 1.5], dtype=torch.float64)
            tracks = motion.trajectories(times.float())
            moves = (tracks[1:] - tracks[:-1]).norm(dim=2)
            assert moves[1].max() < 2.0 * max(moves[0].max(), moves[2].max()) + 1e-5
    apart = network_of(motion, 0)(motion.positions, torch.ones(1))["translations"]
    apart = apart - network_of(motion, 1)(motion.positions, torch.zeros(1))["translations"]
    assert apart.norm(dim=2).max() > 0.1, "the networks agree anyway: the test shows nothing"


def test_several_times_at_once_are_those_one_by_one():
    motion = chunked_motion(3)
    times = torch.tensor([0.9, 0.1, 1 / 3, 0.34, 0.5, 0.05])
    together = motion.poses(times)
    for index, time in enumerate(times):
        alone = motion.poses(time[None])[0]
        torch.testing.assert_close(together[index].translations, alone.translations)
        torch.testing.assert_close(together[index].rotations, alone.rotations)
    assert motion.poses(torch.zeros(0)) == []


def test_a_step_trains_the_networks_of_its_times_only():
    config = tiny_config(60, motion={"chunks": 4}, loss={"arap": 0.0, "arap_end": 0.0})
    motion = chunked_motion(4)
    motion.train()
    gaussians = gaussians_from_points(torch.randn(30, 3), None, sh_degree=0, hyper_columns=config.motion.hyper_columns)
    trained_pose(motion, gaussians, 0.5, config.freeze, config).gaussians.means.sum().backward()
    learnt = [network_of(motion, chunk).head.weight.grad is not None for chunk in range(4)]
    assert learnt == [False, True, True, False]


def test_one_chunk_is_the_network_of_a_short_film():
    assert isinstance(chunked_motion(1).network, DeformationNetwork) and chunked_motion(1).takes_time_tensor
    for name, kind in (("per-gaussian", PerGaussian), ("spheres", Spheres), ("control-points", ControlPoints)):
        motion = build_motion(name, tiny_config(60, motion={"chunks": 3}))
        assert isinstance(motion, kind) and isinstance(motion.network, ChunkedNetwork) and not motion.takes_time_tensor
    first = [network_of(chunked_motion(2), chunk).state_dict()["layers.0.weight"] for chunk in range(2)]
    assert not torch.equal(*first)


def test_older_runs_have_one_chunk():
    values = to_dict(tiny_config(60))
    del values["motion"]["chunks"]
    assert from_dict(values).motion.chunks == 1


def test_trained_in_chunks_saved_loaded_and_shown(tmp_path):
    config = tiny_config(60, motion={"chunks": 3})
    fit(config, tiny_dataset(12), output=tmp_path / "run")
    scene = Scene.load(tmp_path / "run")
    assert isinstance(scene.motion, ControlPoints) and isinstance(scene.motion.network, ChunkedNetwork)
    assert all(network_of(scene.motion, chunk).head.bias.detach().any() for chunk in range(3)), "one was not trained"
    assert scene.render(tiny_dataset(1)[0].camera, 1 / 3).rgb.isfinite().all()


def test_exported_and_edited_as_any_scene(tmp_path):
    config = tiny_config(60, motion={"chunks": 3})
    config = replace(config, pretrain=replace(config.pretrain, steps=0))
    scene = TrainState.begin(config, tiny_dataset(6), "cpu").scene()
    scene.motion = motion = chunked_motion(3)
    scene.freeze_binding()
    (tmp_path / "run").mkdir()
    checkpoint.write(tmp_path / "run", scene.tensors(), {**scene.metadata(), "stage": "main"})
    export(ExportRequest(tmp_path / "film.html", run=tmp_path / "run"))
    facts, columns = read_page(tmp_path / "film.html")
    for time in (0.0, 0.2, 1 / 3, 0.35, 0.8):
        expected = motion.poses(torch.tensor([time]))[0].translations
        torch.testing.assert_close(pose_of(facts, columns, time).translations, expected, rtol=0, atol=2e-2)
    export(ExportRequest(tmp_path / "film.glb", run=tmp_path / "run", frames=31))
    gltf = gltf_arrays(tmp_path / "film.glb")[1]["gltf"]
    instants = {gltf.accessors[sampler.input].count for sampler in gltf.animations[0].samplers}
    assert len(gltf.animations[0].channels) == 2 * len(motion) and instants == {31}
    session = EditSession(Scene.load(tmp_path / "run"))
    before = session.gaussians_at(1 / 3).means
    session.add_handle(np.arange(4), 1 / 3, "end")
    session.move("end", [0.0, 0.0, 0.4])
    assert (session.gaussians_at(1 / 3).means - before).abs().max() > 0.1


def test_a_page_may_take_as_many_times_for_each_chunk():
    samples = [len(page_scene.sample_poses(chunked_motion(chunks))["translation"]) for chunks in (1, 3)]
    assert samples[0] == page_scene.MAX_SAMPLES < samples[1]


def test_every_chunk_is_checked_when_a_scene_is_loaded():
    data, config = tiny_dataset(10), tiny_config(60, motion={"chunks": 5}, pretrain={"with_points": False})
    scene = TrainState.begin(config, data, "cpu").scene()
    scene.motion = chunked_motion(5)
    gaussians = gaussians_from_points(torch.randn(30, 3), None, sh_degree=0, hyper_columns=config.motion.hyper_columns)
    scene.gaussians = gaussians
    check_motion(scene, "run", 5)
    with torch.no_grad():
        network_of(scene.motion, 1).head.bias.fill_(float("inf"))
    scene.motion.eval()
    with pytest.raises(UserError, match=r"run: at time 0\.2"):
        check_motion(scene, "run", 5)


def test_what_cannot_be_chunked_is_refused(tmp_path):
    assert empty_chunk([0.0, 0.1, 0.6, 1.0], 4) == 1 and empty_chunk([0.2, 0.45, 0.7, 0.95], 4) is None
    with pytest.raises(UserError, match=r"motion\.chunks is 4; no training frame lies at times 0\.25 to 0\.5"):
        fit(tiny_config(60, motion={"chunks": 4}), tiny_dataset(3), output=tmp_path / "run")
    for changes, message in (
        ({"chunks": 0}, "chunks"),
        ({"chunks": 65}, r"motion\.chunks is 65; it must be at most 64"),
        ({"chunks": 64, "width": 2048, "layers": 64}, "too large"),
        ({"chunks": 2, "model": "hexplane"}, "hexplane has no network"),
    ):
        with pytest.raises(UserError, match=message):
            check(tiny_config(60, motion=changes))
