"""The console script and what all apps share: --help, and a reader that stops reading."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from helpers.app_runs import run_app
from helpers.paths import ROOT
from scgs_warp.apps import __main__ as console
from scgs_warp.apps.cli import choose_device
from scgs_warp.errors import UserError
from scgs_warp.runtime import environment


@pytest.mark.parametrize("app", console.APPS)
def test_help(app):
    done = run_app(app, "--help")
    assert done.returncode == 0
    assert any(word in done.stdout for word in ("--device", "frame", "--preset"))


def test_programs_start_without_torch():
    """Its import takes seconds, for which --help and the refusal of an option would have to wait."""
    modules = ", ".join(f"scgs_warp.apps.{app}" for app in console.APPS)
    done = subprocess.run(
        [sys.executable, "-c", f"import sys, {modules}; print('torch' in sys.modules)"], capture_output=True, text=True
    )
    assert done.stdout.strip() == "False", done.stderr


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
        assert "did you mean export?" in said.err if status else all(name in said.out for name in console.APPS)
    folder = Path(console.__file__).parent
    assert all((folder / f"{name}.py").is_file() for name in console.APPS)


@pytest.mark.parametrize("asked", ["auto", "cuda", "cpu"])
def test_a_gpu_whose_driver_is_too_old_for_warp(asked, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(environment, "warp_finds_gpu", lambda: False)
    if asked == "cuda":
        with pytest.raises(UserError, match=r"580 or newer.*or use --device cpu"):
            choose_device(asked)
        return
    assert choose_device(asked) == "cpu"
    said = capsys.readouterr().err
    assert said.count("\n") == (asked == "auto") and ("using the CPU: torch finds a GPU" in said) == (asked == "auto")
    monkeypatch.setattr(environment, "warp_finds_gpu", lambda: True)
    assert choose_device(asked) == ("cpu" if asked == "cpu" else "cuda")
