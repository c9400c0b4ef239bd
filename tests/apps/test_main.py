"""The console script and what all apps share: --help, and a reader that stops reading."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.app_runs import run_app
from helpers.paths import ROOT
from scgs_warp.apps import __main__ as console


@pytest.mark.parametrize("app", console.APPS)
def test_help(app):
    done = run_app(app, "--help")
    assert done.returncode == 0
    assert "--device" in done.stdout or "frame" in done.stdout


def test_console_script():
    done = subprocess.run([sys.executable, "-m", "scgs_warp.apps", "view", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and "--output" in done.stdout
    done = subprocess.run([sys.executable, "-m", "scgs_warp.apps", "nonsense"], capture_output=True, text=True)
    assert done.returncode == 2


def test_a_reader_that_stops_reading_is_no_error():
    """``... | head -1`` closes the pipe."""
    command = f"{sys.executable} {ROOT / 'apps/train.py'} --help | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=dict(os.environ))
    assert "Traceback" not in done.stderr


def test_the_console_script_lists_its_commands(monkeypatch, capsys):
    for arguments, status in ([], 0), (["--help"], 0), (["exprot"], 2):
        monkeypatch.setattr(sys, "argv", ["scgs-warp", *arguments])
        assert console.main() == status
        said = capsys.readouterr()
        assert all(name in (said.err if status else said.out) for name in console.APPS)
    folder = Path(console.__file__).parent
    assert all((folder / f"{name}.py").is_file() for name in console.APPS)
