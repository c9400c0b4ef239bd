"""Mistakes on the command line become one line; --help groups options; shells complete them."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys

import pytest

from scgs_warp.apps import __main__ as console
from scgs_warp.apps import completion
from scgs_warp.apps.arguments import option_names, program
from scgs_warp.apps.train import GROUPS, Options

CASES = {
    "train --stepz 5": "error: --stepz: no such option; did you mean --steps?; 'scgs-warp train --help' lists",
    "train --tensorboard=yes": "error: --tensorboard yes: takes no value; write --tensorboard alone, or leave it out",
    "train --progressive false": "error: --progressive false: takes no value; write --progressive alone",
    "bench frames": "error: benchmark frames: choose one of frame, ",
    "train here": "error: here: belongs to no option; write --data here",
    "view cloud.ply": "error: cloud.ply: belongs to no option; write --ply cloud.ply",
    "train --data my film": "error: film: belongs to no option; quote a name that contains spaces ('my film')",
    "train --set freeze 0": "error: --set freeze 0: write NAME=VALUE, for example --set freeze=0",
    "train --preset fast": "error: --preset fast: choose one of quick, cpu, best, paper",
    "train --steps 3k": "error: --steps 3k: give a whole number; 'scgs-warp train --help' lists the options",
    "train --memory-gib much": "error: --memory-gib much: give a number; 'scgs-warp train --help' lists the options",
    "train --steps": "error: --steps: give a value after it; 'scgs-warp train --help' lists the options",
    "bench frame --motions x": "error: --motions: no such option; did you mean --motion?; 'scgs-warp bench --help'",
    "capture film.mp4": "error: --output is missing: ",
    "train --threads 99999": "error: --threads 99999: give at most 1,024; more than the cores gain nothing",
    "train --port 9000": "error: --port: belongs to --live; give both, or neither",
    "view --run x --live --size 400": "error: --size: belongs to a film; leave it out with --live",
    "view --run x --live --path p.json": "error: --path: belongs to a film; leave it out with --live",
    "view --run x --output f.mp4 --port 9000": "error: --port: belongs to --live; leave it out for a film",
    "view --run x --output f.mp4 --share": "error: --share: belongs to --live; leave it out for a film",
    "synthesize --output x --seconds 3": "error: --seconds: belongs to a film; give --film, too",
    "synthesize --output x --maps": "error: --maps: belongs to a film; give --film, too",
    "synthesize --output x --film phone --train 9": "error: --train: belongs to images; leave it out with --film",
    "synthesize --output x --film phone --views 3": "error: --views: belongs to --film rig; leave it out for a phone",
    "synthesize --output x --film rig --shake 2": "error: --shake: belongs to --film phone; leave it out for a rig",
    "synthesize --output x --film rig --mesh m.glb": "error: --mesh m.glb: --film shows a built-in subject",
}


@pytest.mark.parametrize("command", CASES)
def test_one_line(command, capsys):
    assert console.main(command.split()) == 2
    said = capsys.readouterr()
    assert said.err.startswith(CASES[command]) and said.err.count("\n") == 1 and said.out == ""


def test_the_program_has_the_name_under_which_it_was_started(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/somewhere/apps/train.py"])
    assert program("train") == "train.py"
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/scgs-warp"])
    assert program("train") == "scgs-warp train"


def test_help_begins_with_what_people_use_first(capsys):
    with pytest.raises(SystemExit) as end:
        console.main(["train", "--help"])
    said = capsys.readouterr().out
    assert end.value.code == 0 and said.startswith("usage: scgs-warp train")
    places = [said.index(f" {title} options ") for title in GROUPS]
    assert places == sorted(places)
    assert all(said.index(f" --{name} ") < places[1] for name in ("data", "output", "preset", "steps"))
    grouped = [name for group in GROUPS.values() for name in option_names(group)]
    assert sorted(grouped) == sorted(option_names(Options)), "every option is in one group"


def test_python_m():
    done = subprocess.run([sys.executable, "-m", "scgs_warp", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("usage: scgs-warp COMMAND")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_installed(shell, tmp_path, monkeypatch, capsys):
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME", "ZDOTDIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path)
    (tmp_path / ".zshrc").write_text("alias ll='ls -l'")
    for _ in range(2):
        assert console.main(["completion", shell, "--install"]) == 0
    path = completion.place(shell, tmp_path)
    text = path.read_text()
    assert str(path) in capsys.readouterr().out
    assert all(word in text for word in ("evaluate", "--downscale", "hexplane"))
    settings = (tmp_path / ".zshrc").read_text()
    assert settings.startswith("alias ll='ls -l'") and settings.count(".zfunc") == (shell == "zsh")
    if shutil.which(shell):
        done = subprocess.run([shell, "-n", str(path)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes(tmp_path):
    script = tmp_path / "script"
    script.write_text(completion.script("bash"))

    def offered(*words: str) -> set[str]:
        lines = [
            f"source {script}",
            f"COMP_WORDS=({' '.join(words)})",
            f"COMP_CWORD={len(words) - 1}",
            "$(complete -p scgs-warp | sed 's/.*-F \\([^ ]*\\).*/\\1/')",
            'printf "%s\\n" "${COMPREPLY[@]}"',
        ]
        done = subprocess.run(["bash", "-c", "\n".join(lines)], capture_output=True, text=True)
        return {line.strip() for line in done.stdout.splitlines()}

    assert {"train", "view", "edit"} <= offered("scgs-warp", "''")
    assert offered("scgs-warp", "tr") == {"train"}
    assert "--downscale" in offered("scgs-warp", "train", "--down")
    assert {"quick", "cpu", "best", "paper"} <= offered("scgs-warp", "train", "--preset", "''")


@pytest.mark.parametrize(
    "words",
    [
        ["train", "--output", ""],
        ["train", "--data="],
        ["evaluate", "--run", " "],
        ["view", "--run", "", "--output", "x.mp4"],
        ["edit", "--run", ""],
        ["export", "--run", "a", "--output", ""],
        ["capture", "a", "--output", ""],
        ["synthesize", "--output", ""],
        ["capture", "", "--output", "x"],
        ["capture", "--output", "x", " "],
        ["capture", "a.mp4", "--masks", "", "--output", "x"],
    ],
    ids=" ".join,
)
def test_an_empty_name_is_not_the_current_folder(words, tmp_path, monkeypatch, capsys):
    """As of a variable that a script has not set."""
    monkeypatch.chdir(tmp_path)
    assert importlib.import_module(f"scgs_warp.apps.{words[0]}").cli(words[1:]) == 2
    said = capsys.readouterr().err
    assert "an empty name" in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_help_in_a_narrow_terminal():
    """Tyro does not end where a few columns leave no room for a word."""
    command = [sys.executable, "-m", "scgs_warp", "view", "--help"]
    told = subprocess.run(
        command, env={**os.environ, "COLUMNS": "1"}, capture_output=True, text=True, timeout=120, check=True
    )
    assert "--output" in told.stdout
