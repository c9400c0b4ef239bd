"""Sixty mistakes and habits of newcomers, each with the answer that it should get.

Every command is one that somebody who has read the README might type. ``{tiny}`` stands for the options of a run of a
few steps; ``given`` names a function of ``places.py`` that prepares the working folder, which holds

- ``data/blobs``: a D-NeRF scene; ``data/room``: a nerfstudio scene of 20 frames with points;
- ``runs/blobs``: a finished run on ``data/blobs``.

A refusal is one line on stderr with exit status 2 that contains every word of ``says``. Nothing that was there before
may change, except below the paths in ``may_change``.
"""

from __future__ import annotations

from typing import NamedTuple


class Mistake(NamedTuple):
    """A command, and the answer that it should get."""

    name: str
    habit: str
    """What the newcomer does or believes."""
    command: str
    """Words after ``scgs-warp``."""
    status: int
    """Exit status."""
    says: tuple[str, ...]
    """Parts of the answer: of the one line on stderr for a refusal, otherwise of all that is printed."""
    given: str = "nothing"
    """Function of ``places.py`` that prepares the folder."""
    may_change: tuple[str, ...] = ()
    trains: bool = False
    """Whether it is refused only after training: then the run is kept, and all that is printed is the answer."""


REFUSED, DONE = 2, 0

COMMAND_LINE = (
    Mistake("no-command", "types the name alone", "", DONE, ("usage: scgs-warp COMMAND", "train", "view", "edit")),
    Mistake("help-command", "asks as git is asked", "help train", DONE, ("usage: scgs-warp train", "--data")),
    Mistake("command-typo", "mistypes a command", "trian --data data/blobs", REFUSED, ("'trian'", "train")),
    Mistake("option-typo", "mistypes an option", "train --datta data/blobs", REFUSED, ("--datta", "--data")),
    Mistake("bare-folder", "gives the folder without --data", "train data/blobs", REFUSED, ("--data data/blobs",)),
    Mistake("bare-run", "gives the run without --run", "view runs/blobs", REFUSED, ("--run runs/blobs",)),
    Mistake("space-in-path", "does not quote a name", "train --data data/my film", REFUSED, ("film", "quot")),
    Mistake("preset-name", "guesses a preset", "train --preset fast", REFUSED, ("fast", "quick, cpu, best, paper")),
    Mistake("motion-name", "guesses a motion model", "train --motion dynamic", REFUSED, ("dynamic", "static")),
    Mistake("thousand", "writes 30k", "train --steps 30k", REFUSED, ("--steps", "30k", "whole number")),
    Mistake("no-value", "forgets a value", "train --data data/blobs --steps", REFUSED, ("--steps", "value")),
    Mistake("few-steps", "tries one step", "train --data data/blobs --steps 1", REFUSED, ("--steps 1", "10")),
    Mistake("device-gpu", "calls CUDA gpu", "train --device gpu", REFUSED, ("gpu", "auto, cpu, cuda")),
    Mistake("no-threads", "asks for no thread", "train --threads 0", REFUSED, ("--threads 0", "at least 1")),
    Mistake("set-space", "separates by a space", "train --set freeze 0", REFUSED, ("--set freeze", "NAME=VALUE")),
    Mistake("set-typo", "mistypes a field", "train --set motion.hyperdim=8", REFUSED, ("hyperdim", "hyper_dim")),
    Mistake("set-steps", "sets the steps as a field", "train --set steps=100", REFUSED, ("--steps",)),
    Mistake("no-config", "names no file", "train --config my.json", REFUSED, ("my.json", "config.json")),
    Mistake(
        "checkpoint-as-config",
        "gives the checkpoint as settings",
        "train --config runs/blobs/checkpoint.safetensors",
        REFUSED,
        ("checkpoint.safetensors", "config.json"),
    ),
)

OWN_DATA = (
    Mistake("no-folder", "mistypes the folder", "train --data data/blob", REFUSED, ("data/blob", "data/blobs")),
    Mistake(
        "empty-folder", "gives an empty folder", "train --data data/empty", REFUSED, ("data/empty", "empty"), "empty"
    ),
    Mistake("film", "trains on a video", "train --data film.mp4", REFUSED, ("scgs-warp capture film.mp4",), "film"),
    Mistake("zip", "does not unpack", "train --data scene.zip", REFUSED, ("scene.zip", "unpack"), "zipped"),
    Mistake(
        "json-as-data",
        "gives the file of cameras",
        "train --data data/room/transforms.json",
        REFUSED,
        ("--data data/room",),
    ),
    Mistake(
        "splats-as-data",
        "trains on a file of splats",
        "train --data cloud.ply",
        REFUSED,
        ("cloud.ply", "scgs-warp view --ply cloud.ply"),
        "splats",
    ),
    Mistake("run-as-data", "trains on a run", "train --data runs/blobs", REFUSED, ("runs/blobs", "--run", "--data")),
    Mistake("photos", "gives photos alone", "train --data photos", REFUSED, ("scgs-warp capture photos",), "photos"),
    Mistake(
        "folder-above", "gives the folder above", "train --data outer", REFUSED, ("--data outer/inner/room",), "nested"
    ),
    Mistake(
        "folder-below",
        "gives the folder of images",
        "train --data data/blobs/train",
        REFUSED,
        ("--data data/blobs",),
    ),
    Mistake(
        "some-missing",
        "has lost three of 20 images",
        "train --data data/room --output runs/new {tiny}",
        DONE,
        ("3 of 20 frames are left out", "f_3.png"),
        "some_missing",
    ),
    Mistake(
        "most-missing",
        "has lost 12 of 20 images",
        "train --data data/room --output runs/new {tiny}",
        REFUSED,
        ("12 of 20", "--min-frames"),
        "most_missing",
    ),
    Mistake(
        "upper-case",
        "has .PNG where the file says .png",
        "train --data data/room --output runs/new {tiny}",
        DONE,
        ("18 frames of 40 x 30",),
        "upper_case",
    ),
    Mistake(
        "backslashes",
        "made the cameras on Windows",
        "train --data data/room --output runs/new {tiny}",
        DONE,
        ("18 frames of 40 x 30",),
        "backslashes",
    ),
    Mistake(
        "foreign-paths",
        "made the cameras on another machine",
        "train --data data/room --output runs/new {tiny}",
        DONE,
        ("'C:/Users/me/f_0.png' is not there", "images are taken from data/room", "18 frames of 40 x 30"),
        "foreign_paths",
    ),
    Mistake(
        "byte-order-mark",
        "has saved the JSON in Notepad",
        "train --data data/room --output runs/new {tiny}",
        DONE,
        ("18 frames of 40 x 30",),
        "byte_order_mark",
    ),
    Mistake("comma", "leaves a comma", "train --data data/room", REFUSED, ("transforms.json", "line"), "comma"),
    Mistake("lfs", "has cloned without LFS", "train --data data/room", REFUSED, ("f_0.png", "git lfs pull"), "lfs"),
    Mistake("web-page", "has saved a page", "train --data data/room", REFUSED, ("f_0.png", "web page"), "web_page"),
    Mistake("cut-off", "has half an image", "train --data data/room", REFUSED, ("f_0.png", "save it again"), "cut_off"),
    Mistake(
        "resized",
        "has reduced the images alone",
        "train --data data/room --output runs/new {tiny}",
        DONE,
        ("transforms.json", "images are 20 x 15 pixels, the cameras 40 x 30 pixels"),
        "resized",
    ),
    Mistake(
        "seconds",
        "gives seconds as times",
        "train --data data/room --output runs/new {tiny}",
        DONE,
        ("times from 0 to 10 are scaled to go from 0 to 1",),
        "seconds",
    ),
    Mistake("few-times", "gives some times", "train --data data/room", REFUSED, ("time", "every frame"), "few_times"),
    Mistake(
        "scaled-pose",
        "exports a scaled camera",
        "train --data data/room --output runs/new {tiny}",
        DONE,
        ("18 frames of 40 x 30",),
        "scaled_pose",
    ),
    Mistake("no-lens", "has no intrinsics", "train --data data/room", REFUSED, ("fl_x", "camera_angle_x"), "no_lens"),
    Mistake(
        "opencv-poses",
        "gives OpenCV poses",
        "train --data data/room --output runs/new {tiny}",
        REFUSED,
        ("look away", "OpenCV", "OpenGL", "nothing is left", "check cameras"),
        "opencv_poses",
        trains=True,
    ),
    Mistake(
        "no-test-split",
        "has no test frames",
        "train --data data/blobs --output runs/new {tiny}",
        DONE,
        ("7 frames of 48 x 48",),
        "no_test_split",
    ),
    Mistake(
        "colmap-alone",
        "has a model without images",
        "train --data data/model",
        REFUSED,
        ("data/model", "images"),
        "colmap_alone",
    ),
    Mistake(
        "no-frames", "chooses past the end", "train --data data/room --frames 90:", REFUSED, ("--frames 90:", "20")
    ),
    Mistake(
        "no-camera",
        "names no camera",
        "train --data data/room --only-cameras left",
        REFUSED,
        ("--only-cameras left",),
    ),
)

RUNS = (
    Mistake(
        "again",
        "trains twice",
        "train --data data/blobs --output runs/blobs {tiny}",
        REFUSED,
        ("runs/blobs", "--resume"),
    ),
    Mistake("resume-nothing", "resumes nothing", "train --output runs/none --resume", REFUSED, ("runs/none",)),
    Mistake(
        "resume-otherwise",
        "resumes with other settings",
        "train --output runs/blobs --resume --nodes 32",
        REFUSED,
        ("motion.nodes", "16", "32"),
    ),
    Mistake(
        "resume-longer",
        "wants more steps",
        "train --output runs/blobs --resume --steps 80",
        DONE,
        ("80",),
        may_change=("runs/blobs",),
    ),
    Mistake("score-data", "scores the data", "evaluate --run data/blobs", REFUSED, ("data/blobs", "--run")),
    Mistake("moved-data", "has moved the data", "evaluate --run runs/blobs", REFUSED, ("--data",), "moved"),
    Mistake("no-film", "names no film", "view --run runs/blobs", REFUSED, ("--output", ".mp4")),
    Mistake("avi", "wants .avi", "view --run runs/blobs --output film.avi", REFUSED, ("film.avi", ".mp4")),
    Mistake("no-format", "wants .fbx", "export --run runs/blobs --output scene.fbx", REFUSED, ("scene.fbx", "glb")),
    Mistake(
        "other-scene",
        "plays the edit of another scene",
        "edit --run runs/blobs --script edit.json --output film.gif",
        DONE,
        ("edit.json", "another scene"),
        "other_scene",
    ),
    Mistake("no-such-film", "mistypes the film", "capture fillm.mp4 --output d", REFUSED, ("fillm.mp4",), "film"),
)

MISTAKES = (*COMMAND_LINE, *OWN_DATA, *RUNS)
