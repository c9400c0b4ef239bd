"""What stands around the code: workflows, templates, citation, containers, recipe."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import scgs_warp
from helpers.paths import ROOT

yaml = pytest.importorskip("yaml", reason='PyYAML is not installed: pip install -e ".[docs]"')

YAML = sorted([*ROOT.glob(".github/**/*.yml"), ROOT / "CITATION.cff", ROOT / "conda/recipe.yaml"])


def loaded(path: Path) -> dict:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def dependencies() -> dict[str, str]:
    """Return the bounds of the core dependencies by name."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    block = re.search(r"^dependencies = \[\n(.*?)^\]", text, re.M | re.S)
    assert block is not None
    return dict(re.findall(r'"([a-z-]+)(>=[^"]+)"', block[1]))


@pytest.mark.parametrize("path", YAML, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_files_are_yaml_with_content(path):
    assert isinstance(loaded(path), dict)


@pytest.mark.parametrize("path", sorted(ROOT.glob(".github/workflows/*.yml")), ids=lambda path: path.stem)
def test_workflows(path):
    """Every job has a limit of time, few rights, and steps; and runs files that exist."""
    content = loaded(path)
    assert content["permissions"].get("contents") == "read"
    for name, job in content["jobs"].items():
        assert job["timeout-minutes"] <= 180 and job["runs-on"], name
        for step in job["steps"]:
            assert ("run" in step) != ("uses" in step), step
            for script in re.findall(r"python (\S+\.py)", step.get("run", "")):
                assert (ROOT / script).is_file(), script


def test_the_checks_run_on_all_platforms_and_versions():
    matrix = loaded(ROOT / ".github/workflows/checks.yml")["jobs"]["tests"]["strategy"]["matrix"]
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert matrix["python"] == re.findall(r"Python :: (3\.\d+)", text)
    assert [name.split("-")[0] for name in matrix["os"]] == ["ubuntu", "macos", "windows"]


def test_versions_agree():
    assert loaded(ROOT / "CITATION.cff")["version"] == scgs_warp.__version__
    assert loaded(ROOT / "conda/recipe.yaml")["context"]["version"] == scgs_warp.__version__


def test_the_recipe_has_the_dependencies_of_the_package():
    other = {"torch": "pytorch", "opencv-contrib-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}
    run = loaded(ROOT / "conda/recipe.yaml")["requirements"]["run"]
    found = dict(line.split(" ", 1) for line in run if not line.startswith("python "))
    assert found == {other.get(name, name): bounds for name, bounds in dependencies().items()}


@pytest.mark.parametrize("path", sorted(ROOT.glob("docker/*.Dockerfile")), ids=lambda path: path.stem)
def test_containers_install_what_exists(path):
    text = path.read_text(encoding="utf-8")
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    extras = re.search(r"/src\[([a-z,]+)\]", text)
    assert extras is not None and 'ENTRYPOINT ["scgs-warp"]' in text
    assert all(re.search(rf"^{extra} = \[", project, re.M) for extra in extras[1].split(","))
    pinned = re.search(r'"torch(>=[^"]+)"', text)
    assert pinned is None or pinned[1] == dependencies()["torch"]
