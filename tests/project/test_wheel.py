"""The wheel and the source distribution are complete, and an installed wheel works without a checkout."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

import scgs_warp
from helpers.paths import ROOT

PLACES = {"scgs_warp": "scgs_warp", "kernels": "scgs_warp/kernels", "apps": "scgs_warp/apps"}
"""Folders of the checkout, and where they are installed."""
BUILD = "import sys; import build_backend as b; print(getattr(b, 'build_' + sys.argv[1])(sys.argv[2]))"


def build(kind: str, source: Path, output: Path) -> Path:
    output.mkdir(exist_ok=True)
    environ = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, "-c", BUILD, kind, str(output)]
    done = subprocess.run(command, cwd=source, env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-2000:]
    return output / done.stdout.split()[-1]


def belongs(path: Path) -> bool:
    hidden = any(part.startswith(".") for part in path.parts)
    return not hidden and "__pycache__" not in path.parts and path.suffix not in (".pyc", ".pyo")


def files(folder: Path) -> set[str]:
    """Return the relative names of a folder's files, without Python's caches."""
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and belongs(path.relative_to(folder))
    }


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory) -> Path:
    """The source distribution of the checkout, unpacked."""
    pytest.importorskip("setuptools.build_meta", reason="setuptools, which builds the wheel, is not installed")
    work = tmp_path_factory.mktemp("build")
    skip = shutil.ignore_patterns(".*", "build", "dist", "*.egg-info", "runs", "data", "site", "venv", "__pycache__")
    for name in os.listdir(ROOT):
        if (ROOT / name).is_file():
            shutil.copy(ROOT / name, work / name)
    for name in (*PLACES, "tests", "docs", "examples", "benchmarks"):
        keep = skip if name not in (*PLACES, "tests") else shutil.ignore_patterns(".*", "__pycache__")
        shutil.copytree(ROOT / name, work / name, ignore=keep)
    archive = build("sdist", work, work / "dist")
    shutil.unpack_archive(archive, work / "sdist")
    (source,) = (work / "sdist").iterdir()
    return source


@pytest.fixture(scope="module")
def wheel(unpacked, tmp_path_factory) -> Path:
    """Built from the source distribution, as an installer does it."""
    return build("wheel", unpacked, tmp_path_factory.mktemp("wheel"))


def test_the_same_sources_give_the_same_bytes(unpacked, wheel, tmp_path):
    """Whenever and wherever they are built: in another folder, from files with other time stamps."""
    again = tmp_path / "elsewhere"
    shutil.copytree(unpacked, again, ignore=shutil.ignore_patterns("build", "*.egg-info"))
    for path in again.rglob("*"):
        os.utime(path, (1_000_000_000, 1_000_000_000))
    second = build("wheel", again, tmp_path / "wheel")
    sums = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (wheel, second)]
    assert wheel.name == second.name and sums[0] == sums[1]


def test_the_source_distribution_has_everything(unpacked):
    for name in (*PLACES, "tests", "docs", "examples", "benchmarks"):
        missing = {n for n in files(ROOT / name) - files(unpacked / name) if not n.startswith("results/.")}
        assert not missing, f"{name}: MANIFEST.in leaves out {sorted(missing)}"
    for name in (
        "README.md",
        "CHANGELOG.md",
        "CONTRIBUTING.md",
        "SECURITY.md",
        "LICENSE",
        "pyproject.toml",
        "build_backend.py",
        "mkdocs.yml",
    ):
        assert (unpacked / name).is_file(), name


def test_the_wheel_has_all_packages_and_data(wheel):
    with zipfile.ZipFile(wheel) as archive:
        found = {name for name in archive.namelist() if ".dist-info/" not in name}
    wanted = {f"{inside}/{name}" for folder, inside in PLACES.items() for name in files(ROOT / folder)}
    missing = sorted(wanted - found)
    assert not missing, f"add to packages or package-data in pyproject.toml: {missing}"
    assert sorted(found - wanted) == []
    assert "scgs_warp/py.typed" in found


def test_name_version_and_extras(wheel):
    assert wheel.name == f"scgs_warp-{scgs_warp.__version__}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        lines = archive.read(metadata).decode().splitlines()
        (scripts,) = (n for n in archive.namelist() if n.endswith("entry_points.txt"))
        assert "scgs-warp = scgs_warp.apps.__main__:main" in archive.read(scripts).decode()
    extras = {line.split(": ")[1] for line in lines if line.startswith("Provides-Extra")}
    assert {"edit", "gltf", "tensorboard", "docs", "dev"} <= extras


CLIENT = """
import torch, scgs_warp
scene: scgs_warp.Scene = scgs_warp.Scene.load("run", device="cpu")
image: torch.Tensor = scene.render(scgs_warp.Camera(torch.eye(4), torch.eye(3), 8, 8), time=0.5).rgb
count: int = scene.gaussian_count
"""
WRONG = '\nname: str = scene.gaussian_count\nscene.render(time="noon")\n'


@pytest.mark.slow
def test_installed_into_an_empty_environment(wheel, tmp_path):
    """Train, view and edit from a folder outside the checkout; takes minutes, most of them pip's."""
    home, work = tmp_path / "venv", tmp_path / "work"
    work.mkdir()
    venv.create(home, with_pip=True)
    programs = home / ("Scripts" if os.name == "nt" else "bin")
    environ = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(program: str, *arguments: str, status: int = 0) -> str:
        command = [str(programs / program), *arguments]
        done = subprocess.run(command, cwd=work, env=environ, capture_output=True, text=True, timeout=1800)
        assert done.returncode == status, f"{command}: {done.stdout[-1000:]}{done.stderr[-2000:]}"
        return done.stdout

    run("python", "-m", "pip", "install", "-q", f"{wheel}[edit,gltf,tensorboard]")
    origin = run("python", "-c", "import scgs_warp; print(scgs_warp.__file__)")
    assert str(home) in origin
    assert run("scgs-warp", "--version").split() == ["scgs-warp", scgs_warp.__version__]
    small = ["--steps", "60", "--downscale", "4", "--nodes", "32", "--set", "init_points=500", "--device", "cpu"]
    run("scgs-warp", "train", "--output", "run", "--tensorboard", *small)
    for name in ("checkpoint.safetensors", "metrics.json", "turntable.mp4", "log.jsonl", "contact_sheet.png"):
        assert (work / "run" / name).stat().st_size > 100, name
    assert len(list((work / "run").glob("events.out.tfevents.*"))) == 1
    run("scgs-warp", "view", "--run", "run", "--output", "film.mp4", "--frames", "4", "--size", "64")
    assert (work / "film.mp4").stat().st_size > 100
    assert "--script" in run("scgs-warp", "edit", "--help")
    (work / "edit.json").write_text('{"format": "scgs-warp edit", "version": 1, "playback": {"freeze": 0.5}}')
    run("scgs-warp", "edit", "--run", "run", "--script", "edit.json", "--export", "edited.ply")
    assert (work / "edited.ply").stat().st_size > 1000
    run("scgs-warp", "export", "--run", "run", "--time", "0.5", "--output", "moment.ply")
    assert (work / "moment.ply").stat().st_size > 1000
    run("scgs-warp", "view", "--run", "nowhere", "--output", "x.mp4", status=2)

    (work / "client.py").write_text(CLIENT)
    check_types(work, programs, CLIENT, 0)
    check_types(work, programs, CLIENT + WRONG, 1)


def check_types(work: Path, programs: Path, code: str, status: int) -> None:
    """A type checker finds a mistake in the use of the installed package, and no other."""
    if shutil.which("pyright") is None:
        return
    (work / "client.py").write_text(code)
    python = str(programs / "python")
    done = subprocess.run(
        ["pyright", "--pythonpath", python, "client.py"], cwd=work, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == status, done.stdout
