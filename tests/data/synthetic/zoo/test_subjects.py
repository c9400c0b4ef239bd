"""What holds for every built-in subject: its extent, its tracks, its bytes, its options."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.paths import ROOT
from scgs_warp.apps.synthesize import main
from scgs_warp.data import load
from scgs_warp.data.synthetic import from_mesh
from scgs_warp.data.synthetic.from_mesh import SynthesisRequest, plan_synthesis, synthesize
from scgs_warp.data.synthetic.orbit_cameras import FilmingSettings, camera_at, camera_of
from scgs_warp.data.synthetic.renderer import ROOM_RADIUS
from scgs_warp.data.synthetic.shading import Shading
from scgs_warp.data.synthetic.zoo import SUBJECTS
from scgs_warp.errors import UserError
from scgs_warp.evaluation.motion_metrics import load_ground_truth
from scgs_warp.runtime import environment

NAMES = ("robot", "rods", "rods-dark", "balls", "balls-steady", "cloth", "fan", "touch", "opening", "still")
TIMES = np.linspace(0.0, 1.0, 101).tolist()


@pytest.fixture(scope="module", params=NAMES)
def subject(request: pytest.FixtureRequest):
    return SUBJECTS[request.param]("cpu", Shading())


def distance_to(point: np.ndarray, corners: np.ndarray) -> float:
    """Return the least distance of a point [3] to the triangles [F, 3, 3] whose prisms contain it."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    usable = area > 1e-12
    unit = normal / np.where(usable, area, 1.0)[:, None]
    sides = [np.einsum("fi,fi->f", np.cross(q - p, point - p), unit) for p, q in ((a, b), (b, c), (c, a))]
    inside = usable & (np.min(sides, axis=0) > -1e-6)
    return float(np.abs(np.einsum("fi,fi->f", point - a, unit))[inside].min(initial=np.inf))


def test_names_are_those_of_the_docs():
    assert tuple(SUBJECTS) == NAMES
    page = (ROOT / "docs" / "synthesis.md").read_text()
    assert all(f"`{name}`" in page for name in NAMES)


def test_stays_in_the_room_with_unit_normals(subject):
    for time in TIMES:
        vertices, normals = subject.surface.posed(time)
        assert np.linalg.norm(vertices, axis=1).max() < ROOM_RADIUS
        assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-6


def test_motion_is_steady(subject):
    """The surface moves at every instant of 100, and no vertex jumps."""
    poses = np.stack([subject.surface.posed(time)[0] for time in np.linspace(0, 1, 100)])
    steps = np.linalg.norm(np.diff(poses, axis=0), axis=-1)
    assert steps.max() < 0.27 and (steps.max(1) > 1e-5).mean() > 0.85
    assert np.abs(np.diff(poses, 2, axis=0)).max() < 0.12


def test_tracks_lie_on_the_surface_that_is_rendered(subject):
    points = subject.sample(40, np.random.default_rng(0))
    for time, track in zip((0.37, 1.0), subject.track(points, [0.37, 1.0])):
        corners = subject.pose(time).vertices.numpy().astype(np.float64)[subject.surface.faces]
        assert max(distance_to(point, corners) for point in track) < 1e-5


def request(name: str | None, **fields) -> SynthesisRequest:
    filming = fields.pop("filming", FilmingSettings(width=32, height=32, train=3, test=2, val=0))
    return SynthesisRequest(subject=name, filming=filming, samples=2, **fields)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("name", ["rods", "balls", "cloth"])
def test_same_bytes_for_any_number_of_threads(tmp_path, all_threads, name):
    found = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        found.append(contents(synthesize(plan_synthesis(tmp_path / str(threads), request(name)))))
    assert found[0] == found[1] and len(found[0]) == 5 + 5 + (name == "rods")


def test_a_made_folder_is_a_data_set(tmp_path):
    planned = plan_synthesis(tmp_path / "balls", request("balls"))
    folder = synthesize(planned)
    truth, train = load_ground_truth(folder), load(folder, "train")
    assert truth is not None and truth.points.shape == (51, 2000, 3) and len(train) == 3
    for view, index in enumerate((0, 25, 50)):
        camera, alpha = train[view].camera, train[view].alpha
        points = truth.points[index][truth.visible[view]] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        x, y = (points @ camera.K.T / points[:, 2:])[:, :2].long().T
        assert alpha is not None and len(x) > 300 and (alpha[y, x] > 0).float().mean() > 0.98
    assert plan_synthesis(folder, request("balls")).made
    for other in (request("cloth"), request("balls", shading=Shading((0.0, 0.0, 1.0)))):
        with pytest.raises(UserError, match="holds something else"):
            plan_synthesis(folder, other)


def test_robot_is_the_figure_without_a_name(tmp_path):
    folder = synthesize(plan_synthesis(tmp_path / "robot", request("robot")))
    assert plan_synthesis(folder, request(None)).made


@pytest.mark.parametrize("name", ["robot", "balls"])
def test_light_comes_from_where_it_is_set(name):
    """A light from the left and one from the right brighten opposite sides."""
    view = camera_of(camera_at(-math.pi / 2, 0.3, 4.03), 0.69, 48, 48)
    columns = torch.arange(48).double()
    centres = []
    for x in (-1.0, 1.0):
        subject = SUBJECTS[name]("cpu", Shading((x, -0.2, 0.2), ambient=0.0))
        light = subject.render(subject.pose(0.0), view, 2)[..., :3].sum((0, 2)).double()
        centres.append(float((light * columns).sum() / light.sum()))
    assert centres[1] - centres[0] > 2.0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"name": "cat"},
            f"--subject cat: give one of: {', '.join(NAMES)}",
        ),
        ({"name": "balls", "mesh": Path("x.glb")}, "--subject balls: give either --subject or --mesh"),
        ({"name": "balls", "clip": "Walk"}, "--clip: is for glTF files"),
        ({"name": "balls", "start": 1.0}, "--start: is for glTF files"),
        ({"name": "balls", "end": 1.0}, "--end: is for glTF files"),
        ({"name": "balls", "shading": Shading((0.0, 0.0, 0.0))}, "--light: give a direction that is not zero"),
    ],
)
def test_wrong_requests_are_explained(tmp_path, fields, message):
    with pytest.raises(UserError) as caught:
        plan_synthesis(tmp_path / "scene", request(**fields))
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "scene").exists()


def test_a_subject_has_a_hundred_training_times(tmp_path, monkeypatch, capsys):
    """And the figure without a name has 150, as before."""
    monkeypatch.setattr(from_mesh, "synthesize", lambda planned, progress: planned.folder)
    main(["--subject", "rods", "--output", str(tmp_path / "rods"), "--device", "cpu"])
    assert "100 train, 20 test, 10 val; ground_truth.npz, rods.npz, contact_sheet.png" in capsys.readouterr().out
    main(["--output", str(tmp_path / "robot"), "--device", "cpu"])
    assert "150 train, 20 test, 10 val; ground_truth.npz, contact_sheet.png" in capsys.readouterr().out


def app(*arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "apps" / "synthesize.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def test_the_app_makes_a_subject_and_explains(tmp_path):
    few = ["--device", "cpu", "--size", "16", "--train", "2", "--test", "1", "--val", "0", "--samples", "1"]
    done = app("--subject", "rods", "--output", str(tmp_path / "rods"), *few)
    assert done.returncode == 0, done.stderr
    assert "the built-in subject rods" in done.stdout and "rods.npz" in done.stdout
    assert "train.py --data" in done.stdout and (tmp_path / "rods" / "rods.npz").is_file()
    wrong = app("--subject", "cat", "--output", str(tmp_path / "cat"), "--device", "cpu")
    assert wrong.returncode == 2 and wrong.stdout == "" and wrong.stderr.count("\n") == 1
    shown = " ".join(app("--help").stdout.replace("│", " ").split())
    assert ", ".join(NAMES).replace("robot", "robot (the default)") in shown
