"""Benchmarks, tiny: rows are complete and mean what they say, the timed code is the real one, mistakes are one line."""

from __future__ import annotations

import types

import pytest
import torch

from helpers.bench_rows import TINY, check_rows, report_of, rows_of
from scgs_warp.apps import bench as app
from scgs_warp.benchmark import gsplat, memory, scenes, summary, workloads
from scgs_warp.benchmark import plan as bench_plan
from scgs_warp.benchmark import run as bench
from scgs_warp.benchmark import timing as bench_clock
from scgs_warp.config.presets import MOTIONS
from scgs_warp.errors import UserError
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.ops.projection import project
from scgs_warp.rendering import render as render_module
from scgs_warp.storage.checkpoint import write as write_checkpoint
from scgs_warp.training import step as training

pytestmark = pytest.mark.usefixtures("all_threads")


def test_frames_of_every_motion_model(tmp_path, device, capsys):
    rows = rows_of(tmp_path, "frame", *TINY, "--motion", ",".join(MOTIONS), "--device", device)
    check_rows(rows, device)
    drawn = ["project", "harmonics", "bin", "composite", "rest"]
    stages = {
        motion: [row["name"].removeprefix("frame/") for row in rows if row["motion"] == motion][1:]
        for motion in MOTIONS
    }
    assert stages == {
        "control-points": ["network", "skin", *drawn],
        "per-gaussian": ["network", *drawn],
        "hexplane": ["network", *drawn],
        "static": drawn,
    }
    assert {row["motion"]: row["control_points"] for row in rows} == dict.fromkeys(MOTIONS, 0) | {"control-points": 12}
    printed = capsys.readouterr().out
    assert "frame/composite" in printed and "120 Gaussians" in printed


def test_the_paper_s_table_is_put_beside(tmp_path, capsys):
    report = report_of(tmp_path, "frame", *TINY, "--table-s2", "--device", "cpu")
    table = {row["motion"]: row for row in report["table_s2"]}
    compared = {row["motion"]: row for row in report["compared"]}
    assert set(table) == set(compared) == set(MOTIONS)
    for name, row in table.items():
        assert row["threads"] == 1 and row["fps"] == pytest.approx(1e3 / compared[name]["ms_median"])
        assert row["ratio_to_static"] == compared[name]["ratios"]["static"] > 0
        assert row["ratio_to_per_gaussian"] == compared[name]["ratios"]["per-gaussian"] > 0
    assert table["static"]["ratio_to_static"] == table["per-gaussian"]["ratio_to_per_gaussian"] == 1.0
    assert table["control-points"]["paper_ratio_to_per_gaussian"] == pytest.approx(2.61, abs=0.005)
    printed = capsys.readouterr().out
    assert "(paper: 295.4 frames/s, 0.99, 2.61 x)" in printed and "(paper: 145.8 frames/s, 0.49, 1.29 x)" in printed


def test_what_motion_costs(tmp_path, capsys):
    report = report_of(tmp_path, "frame", *TINY, "--motion", "control-points,static", "--device", "cpu")
    (cost,) = report["motion"]
    median = {row["name"]: row["ms_median"] for row in report["rows"] if row["motion"] == "control-points"}
    assert cost["ms_median"] == pytest.approx(median["frame/network"] + median["frame/skin"])
    assert cost["ratio_to_static"] == report["compared"][0]["ratios"]["static"]
    assert "of static's frames/s" in capsys.readouterr().out
    assert summary.motion_costs(report["rows"], []) == [{**cost, "ratio_to_static": None}]


def test_what_disturbs_the_machine_meets_all_models_alike(monkeypatch):
    """The second takes twice as long as the first, and the machine is ten times slower in every other turn."""
    clock = [0.0]
    monkeypatch.setattr(bench_clock.time, "perf_counter", lambda: clock[0])

    def drawer(cost: float):
        def draw(index: int) -> None:
            clock[0] += cost * (10 if index % 2 else 1)

        return draw

    first, second = summary.compare_frames({"a": drawer(1.0), "b": drawer(2.0)}, 1, 30.0, "cpu")
    assert first["ratios"] == pytest.approx({"a": 1.0, "b": 2.0}) and second["ratios"]["a"] == pytest.approx(0.5)
    assert second["ms_min"] == pytest.approx(2e3) and first["fps"] == pytest.approx(1e3 / first["ms_median"])


@pytest.mark.parametrize("what", ["frame", "raster", "step"])
def test_width_and_height(tmp_path, what):
    arguments = ["--gaussians", "120", "--nodes", "12", "--size", "70x41", "--seconds", "0", "--threads", "1"]
    rows = rows_of(tmp_path, what, *arguments, "--device", "cpu")
    assert {(row["width"], row["height"]) for row in rows} == {(70, 41)}


def test_a_wide_camera_sees_as_wide_and_the_middle():
    scene = scenes.synthetic_scene("static", 60, 12, "cpu")
    square, wide = (scenes.scene_camera(scene, size) for size in (64, (64, 36)))
    assert torch.equal(square.viewmat, wide.viewmat)
    assert wide.K.tolist() == [[square.K[0, 0], 0, 32], [0, square.K[0, 0], 18], [0, 0, 1]]
    same = scenes.scene_camera(scene, (64, 64))
    assert torch.equal(square.K, same.K) and (same.width, same.height) == (square.width, square.height)


def test_rasterisation_forward_and_both(tmp_path, device):
    rows = rows_of(tmp_path, "raster", *TINY, "--device", device)
    check_rows(rows, device)
    names = [row["name"] for row in rows]
    assert names[0] == "raster/forward" and "raster/both" in names and "raster/both/backward" in names
    median = {row["name"]: row["ms_median"] for row in rows}
    assert median["raster/both"] > median["raster/both/backward"] > 0


def test_steps_with_and_without_arap(tmp_path, device):
    rows = rows_of(tmp_path, "step", *TINY, "--motion", "control-points,static", "--device", device)
    check_rows(rows, device)
    names = [row["name"] for row in rows if row["motion"] == "control-points"]
    assert {"step/loss", "step/backward", "step/adam", "step/network", "step/skin"} < set(names)
    median = {row["name"]: row["ms_median"] for row in rows if row["motion"] == "control-points"}
    assert median["step/arap/arap"] > 0.0 and "step/arap" in names and "step/arap/adam" in names
    assert "step/arap" not in [row["name"] for row in rows if row["motion"] == "static"]


@pytest.mark.parametrize("motion", MOTIONS)
def test_frames_are_drawn_as_of_a_loaded_run_and_steps_as_in_training(motion):
    scene = scenes.synthetic_scene(motion, 60, 12, "cpu")
    assert not scene.motion.training
    assert scenes.training_state(scene, arap=False).motion.training
    plan = bench.BenchPlan(None, 60, 12, 32, (motion,), "cpu", (1,), 0.0)
    case = bench_plan.BenchCase(scene, plan, scenes.Load(1, 1.0), 1)
    names = [row["name"] for row in workloads.step_rows(case)]
    assert not scene.motion.training and ("step/network" in names) == (motion != "static")


def test_on_a_gpu_stages_are_those_of_a_frame_drawn_step_by_step(monkeypatch):
    """The whole is a recorded graph there; the steps that are timed instead draw the same picture."""
    scene = scenes.synthetic_scene("control-points", 120, 12, "cpu")
    plan = bench.BenchPlan(None, 120, 12, 48, ("control-points",), "cuda", (1,), 0.0)
    case = bench_plan.BenchCase(scene, plan, scenes.Load(1, 1.0), 1)
    given, drawn = {}, []
    monkeypatch.setattr(
        bench_plan.BenchCase, "rows", lambda self, *args, **options: given.update(options, args=args) or []
    )
    workloads.frame_rows(case)
    draw = render_module.render
    monkeypatch.setattr(render_module, "render", lambda *args, **kw: drawn.append(draw(*args, **kw)) or drawn[-1])
    given["staged"](3)
    whole = scene.render(scenes.scene_camera(scene, 48), 0.5 + 0.4 * ((0.37 * 3) % 1.0 - 0.5))
    assert len(drawn) == 1 and torch.equal(drawn[0].rgb, whole.rgb) and torch.equal(drawn[0].depth, whole.depth)
    assert "bin" in bench_clock.Stages("cpu", given["args"][2]).repeat(given["staged"], 0.0)


def test_one_and_all_threads_by_default(monkeypatch):
    monkeypatch.setattr(bench.environment, "available_threads", lambda: 6)
    assert bench.thread_counts(None, "cpu") == (1, 6)
    assert bench.thread_counts(3, "cpu") == (3,)
    assert len(bench.thread_counts(None, "cuda")) == 1


def test_a_run_s_scene(tmp_path):
    scene = scenes.synthetic_scene("control-points", 150, 12, "cpu")
    run = tmp_path / "run"
    run.mkdir()
    write_checkpoint(run, scene.tensors(), {**scene.metadata(), "stage": "main"})
    for what in ("frame", "raster", "step"):
        rows = rows_of(tmp_path, what, "--run", str(run), "--size", "48", "--seconds", "0", "--threads", "1")
        assert {(row["gaussians"], row["control_points"], row["motion"]) for row in rows} == {
            (150, 12, "control-points")
        }


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["frame", "--motion", "walk"], "'walk'"),
        (["frame", "--nodes", "3"], "--nodes 3"),
        (["frame", "--gaussians", "100"], "--gaussians 100"),
        (["step", "--size", "4"], "--size 4"),
        (["frame", "--size", "1920x"], "--size 1920x"),
        (["frame", "--size", "800x9000"], "--size 800x9000"),
        (["frame", "--size", "1x2x3"], "--size 1x2x3"),
        (["raster", "--size", "big"], "--size big"),
        (["frame", "--run", "nowhere"], "nowhere"),
        (["frame", "--run", "nowhere", "--gaussians", "1000"], "--gaussians"),
        (["frame", "--run", "nowhere", "--table-s2"], "--table-s2"),
        (["frame", "--against", "gsplat"], "raster"),
        (["raster", "--against", "gsplat", "--device", "cpu"], "CUDA"),
        (["raster", "--threads", "0"], "--threads 0"),
        (["raster", "--seconds", "-1"], "--seconds -1"),
    ],
)
def test_mistakes_are_one_line_and_status_2(arguments, said, capsys):
    assert app.cli(arguments) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(UserError, match="--json"):
        bench.write({}, tmp_path)


def test_renderers_must_agree_before_they_are_timed():
    image = torch.rand(3, 40, 50)
    gsplat.check_agreement(image, image + 5e-5)
    flipped = image.clone()
    flipped[0, 3, 4] += 1 / 255
    gsplat.check_agreement(image, flipped)
    for changed in (image + 2e-4, image.where(torch.arange(50) != 7, image + 1e-3), image * torch.nan):
        with pytest.raises(UserError, match="differ"):
            gsplat.check_agreement(image, changed)
    flipped[0, 3, 4] += 1.0
    with pytest.raises(UserError, match="differ"):
        gsplat.check_agreement(image, flipped)


def test_against_a_peer_that_is_ours_and_one_that_is_wrong():
    scene = scenes.synthetic_scene("static", 120, 12, "cpu")
    plan = bench.BenchPlan(None, 120, 12, 48, ("static",), "cpu", (1,), 0.0)
    case = bench.BenchCase(scene, plan, scenes.Load(1, 1.0), 1)
    ours = gsplat.rasterize.rasterization
    rows = gsplat.Peers(ours).rows(case)
    assert [(row["renderer"], row["name"]) for row in rows] == [
        ("scgs_warp", "raster/forward"),
        ("scgs_warp", "raster/both"),
        ("gsplat", "raster/forward"),
        ("gsplat", "raster/both"),
    ]
    with pytest.raises(UserError, match="differ"):
        gsplat.Peers(lambda *args, **kwargs: (0.5 * ours(*args, **kwargs)[0],)).rows(case)


def test_stages_unwrap_what_they_wrap_and_count_nested_ones_once():
    def busy(rounds: int) -> float:
        return sum(k**0.5 for k in range(rounds))

    owner = types.SimpleNamespace(inner=lambda: busy(20_000))
    owner.outer = lambda: (busy(20_000), owner.inner())
    before = dict(vars(owner))
    stages = bench_clock.Stages("cpu", {"outer": [(owner, "outer")], "inner": [(owner, "inner")]})
    found = stages.repeat(lambda index: (owner.outer(), busy(40_000)), 0.0)
    assert set(found) == {"outer", "rest"} and vars(owner) == before
    assert 0.2 < found["outer"][1] < 0.8
    with pytest.raises(ZeroDivisionError):
        stages.repeat(lambda index: 1 / 0, 0.0)
    assert vars(owner) == before


def test_nothing_stays_wrapped(tmp_path):
    names = [
        (render_module, "project"),
        (training, "photometric_loss"),
        (torch.Tensor, "backward"),
        (workloads, "project"),
    ]
    before = [getattr(*place) for place in names]
    rows_of(tmp_path, "step", *TINY)
    assert [getattr(*place) for place in names] == before


def test_warm_up_is_left_out_and_time_bounds_the_repeats():
    calls: list[int] = []
    timing = bench_clock.repeat(calls.append, 0.0, "cpu")
    assert calls == list(range(bench_clock.WARM_UP + bench_clock.MIN_REPEATS)) and 0 <= timing.least <= timing.median


@pytest.mark.parametrize("motion", MOTIONS)
def test_synthetic_scenes_repeat_and_move_mildly(motion):
    first, second = (scenes.synthetic_scene(motion, 400, 20, "cpu") for _ in range(2))
    early, late = first.gaussians_at(0.1), first.gaussians_at(0.9)
    assert torch.equal(late.means, second.gaussians_at(0.9).means)
    moved = float((late.means - early.means).norm(dim=1).mean())
    assert moved == 0.0 if motion == "static" else 1e-3 < moved < 0.2
    assert bool(torch.isfinite(late.scales).all())
    if motion != "static":
        layers = [layer for layer in first.motion.modules() if isinstance(layer, torch.nn.Linear)]
        assert len(layers) >= 4
    if motion in ("control-points", "per-gaussian"):
        assert [layer.out_features for layer in layers[:8]] == [256] * 8


@pytest.mark.parametrize("seed", range(3))
def test_contributors_are_those_that_compositing_blends(seed, device):
    """A channel of ones over alpha * T hides the count; twin: every splat on its own, in the order of depth."""
    scene = scenes.synthetic_scene("static", 60, 12, device, seed)
    camera = scenes.scene_camera(scene, 40)
    gaussians = scene.gaussians_at(0.5)
    load = scenes.load_of(gaussians, camera)
    with torch.no_grad():
        geometry = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
        splats = project(*geometry, camera.viewmat, camera.K, 40, 40)
        tiles = bin_splats(splats)
        assert load.pairs == len(tiles.splats)
        y, x = torch.meshgrid(torch.arange(40.0) + 0.5, torch.arange(40.0) + 0.5, indexing="ij")
        transmittance, count = torch.ones(40, 40, dtype=torch.float64), torch.zeros(40, 40)
        ended = torch.zeros(40, 40, dtype=torch.bool)
        for i in splats.depths.argsort(stable=True).tolist():
            if int(splats.radii[i].min()) == 0:
                continue
            a, b, c = splats.conics[i].cpu()
            dx, dy = x - float(splats.means2d[i, 0]), y - float(splats.means2d[i, 1])
            alpha = float(splats.opacities[i]) * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
            alpha = alpha.clamp(max=0.999).double()
            after = transmittance * (1 - alpha)
            ended |= (alpha >= 1 / 255) & (after <= 1e-4)
            blended = (alpha >= 1 / 255) & ~ended
            transmittance = torch.where(blended, after, transmittance)
            count += blended
        alpha = composite(splats, gaussians.sh_dc, tiles)[1].cpu()
    assert torch.allclose(1 - transmittance.float(), alpha, atol=1e-3)
    assert load.contributors == pytest.approx(float(count[count > 0].mean()), rel=5e-3)


def test_an_empty_picture_has_no_contributors():
    scene = scenes.synthetic_scene("static", 60, 12, "cpu")
    gaussians = scene.gaussians_at(0.0)
    camera = scenes.scene_camera(scene, 32)
    behind = type(camera)(torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])) @ camera.viewmat, camera.K, 32, 32)
    assert scenes.load_of(gaussians, behind) == scenes.Load(0, 0.0)


@pytest.mark.parametrize("count", [2_000, 8_000])
def test_what_the_figure_covers_does_not_depend_on_its_size(count):
    scene = scenes.synthetic_scene("static", count, 12, "cpu")
    camera = scenes.scene_camera(scene, 128)
    assert 0.1 < float((scene.render(camera, 0.0).alpha > 0.1).float().mean()) < 0.4


def test_two_threads_scaling_leaves_the_thread_count_alone():
    bench.environment.configure(1)
    assert 0.3 < bench_clock.two_thread_scaling() < 3.0
    assert bench.environment.thread_count() == 1


@pytest.mark.skipif(memory.resident_mib("cpu") is None, reason="the system does not say what is resident")
def test_extra_memory_is_what_measuring_takes():
    """A call that holds 64 MiB, then one that holds nothing: the peak counts anew for each row."""
    scene = scenes.synthetic_scene("static", 120, 12, "cpu")
    plan = bench.BenchPlan(None, 120, 12, 48, ("static",), "cpu", (1,), 0.0)
    before = memory.resident_mib("cpu")
    case = bench_plan.BenchCase(scene, plan, scenes.Load(1, 1.0), 1, before)
    held, idle = (
        case.rows("x", function, {})[0] for function in (lambda i: torch.ones(16, 2**20).sum(), lambda i: None)
    )
    if idle["peak_mib"] > held["peak_mib"] - 32:
        pytest.skip("the peak cannot be reset here")
    assert 60 < held["extra_mib"] < 100 and idle["extra_mib"] < 20
    assert held["model_mib"] == pytest.approx(120 * 4 * (3 + 4 + 3 + 1 + 48) / 2**20)
    assert memory.extra_mib(None, 1.0) is None and memory.extra_mib(1.0, None) is None
