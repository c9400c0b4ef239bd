"""``kill -9`` of the editor at random moments of a session loses at most the gesture in flight."""

from __future__ import annotations

import random
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from helpers.edit_scenes import bar_scene
from helpers.studios import Page
from scgs_warp.formats.gaussian_ply import write_gaussian_ply

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")
ACTIONS = 60
STARTUP = 120.0


class Remote(Page):
    """Page of an editor in another process."""

    def ask(self, what: str, /, **fields: Any) -> dict[str, Any]:
        self._count += 1
        number = self._count
        self.send({"do": what, "id": number, **fields})
        self.until(lambda: self.closed.is_set() or any(message.get("id") == number for message in self.heard))
        if self.closed.is_set():
            raise ConnectionError
        return next(message for message in self.heard if message.get("id") == number)

    def saved(self) -> dict[str, Any]:
        """The state, once it is saved."""
        self.until(lambda: self.closed.is_set() or (self.state["saved"] and not self.state["dragging"]))
        if self.closed.is_set():
            raise ConnectionError
        return summary(self.state)


def summary(state: dict[str, Any]) -> dict[str, Any]:
    """What tells every moment of the session from all others."""
    handles = sorted(handle["name"] for handle in state["handles"])
    return {"handles": handles, "keys": [frame["at"] for frame in state["keyframes"]], "film": state["film"]["seconds"]}


def serve(ply: Path) -> tuple[subprocess.Popen[str], Remote]:
    command = [sys.executable, "-m", "scgs_warp.apps.edit", "--ply", str(ply), "--nodes", "24", "--port", "0"]
    process = subprocess.Popen([*command, "--threads", "1"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    said = re.search(r":(\d+)/\?token=(\S+)", process.stdout.readline())
    assert said is not None
    port = int(said[1])
    access = SimpleNamespace(token=said[2], cookie=f"scgs_{port}")
    return process, Remote(SimpleNamespace(server=SimpleNamespace(port=port, access=access)))  # type: ignore[arg-type]


def act(page: Remote, row: int) -> None:
    """Do the action of this row: pull, key, or change the film's length."""
    at = 0.05 * row
    if row % 3 == 1:
        page.ask("key", at=at)
    elif row % 3 == 2:
        page.ask("film", seconds=4.0 + 0.01 * row)
    else:
        page.ask("select", what="nodes", nodes=[row % 5, row % 5 + 1], how="replace")
        page.ask("grab", at=at)
        for share in (1, 2):
            page.send({"do": "drag", "grip": [0, 0, 0], "to": [0, 0, 0.02 * share + 0.001 * row]})
        page.ask("release", at=at)


def may_follow(old: dict[str, Any], new: dict[str, Any], row: int) -> bool:
    """Return whether a state follows another by the action of a row, which was in flight."""
    keys, new_keys, handles = set(old["keys"]), set(new["keys"]), set(old["handles"])
    return (
        keys <= new_keys <= keys | {0.05 * row}
        and handles <= set(new["handles"])
        and len(new["handles"]) <= len(handles) + 1
        and new["film"] in (old["film"], 4.0 + 0.01 * row)
    )


def kill_once(folder: Path, seconds: float) -> tuple[int, dict[str, Any], list[dict[str, Any]]]:
    """Kill a session after so many seconds; return how many actions were seen to be saved, what is restored, and what
    the page showed after each of them."""
    ply = folder / "scene.ply"
    write_gaussian_ply(ply, bar_scene(gaussians=300).gaussians_at(0.0))
    process, page = serve(ply)
    shown = [summary(page.state)]
    killer = threading.Timer(seconds, process.kill)
    killer.start()
    try:
        for row in range(ACTIONS):
            act(page, row)
            shown.append(page.saved())
        page.until(page.closed.is_set)
    except (ConnectionError, OSError, RuntimeError):
        pass
    assert process.wait(30) == -signal.SIGKILL
    again, other = serve(ply)
    restored = summary(other.state)
    other.close()
    again.kill()
    again.wait()
    return len(shown) - 1, restored, shown


def check(tmp_path: Path, kills: int, seed: int) -> None:
    choose, actions = random.Random(seed), []
    for number in range(kills):
        folder = tmp_path / str(number)
        folder.mkdir()
        count, restored, shown = kill_once(folder, choose.uniform(0.2, 4.0))
        actions.append(count)
        assert restored == shown[count] or may_follow(shown[count], restored, count), (count, restored, shown[-2:])
    print("actions before each kill:", actions)
    assert max(actions) > 0


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_killed_editor_has_lost_no_gesture(tmp_path):
    check(tmp_path, 1, 1)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_killed_at_ten_random_moments(tmp_path):
    check(tmp_path, 10, 2)
