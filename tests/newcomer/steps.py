"""What a newcomer does in the first hour, command by command, and what each should answer and write."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from helpers.edit_scripts import SCRIPT
from helpers.layouts import write_colmap, write_nerfies, write_panoptic, write_poses_bounds
from newcomer.places import write_data


class Step(NamedTuple):
    """A command that should succeed."""

    name: str
    command: str
    says: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    may_change: tuple[str, ...] = ()


LAYOUTS = {
    "blobs": ("train/train_003.png", "1 of 8 frames are left out"),
    "room": ("f_3.png", "1 of 20 frames are left out"),
    "nerfies": ("rgb/1x/000003.png", "1 of 12 frames are left out"),
    "panoptic": ("ims/1/000002.jpg", "1 of 15 frames are left out"),
    "model": ("images/frame_3.png", "1 of 14 frames are left out"),
    "bounds": (None, "9 frames of 80 x 60"),
}
"""For every layout, the image that is missing, and what is said of it."""
WRITTEN = ("metrics.json", "contact_sheet.png", "curves.png", "turntable.mp4", "checkpoint.safetensors")
EXPORTS = {
    "ply": "moment.ply --time 0.5",
    "compressed.ply": "moment.compressed.ply --time 0.5",
    "splat": "moment.splat --time 0.5",
    "spz": "moment.spz --time 0.5",
    "ply-sequence": "moments --frames 3",
    "glb": "scene.glb --frames 3",
    "graph": "graph.glb --frames 3",
    "npz": "scene.npz --frames 3",
    "cameras": "cameras.json",
    "html": "scene.html",
    "sog": "scene.sog --time 0.5",
    "4dgs": "scene.4dgs --frames 3",
    "tracks": "tracks.npz --frames 3",
    "mesh": "mesh.obj --time 0.5 --resolution 32",
}


def prepare(place: Path) -> None:
    """Write the data of the hour: every layout with an image missing, and an edit."""
    write_data(place)
    for name, writer in {
        "nerfies": write_nerfies,
        "panoptic": write_panoptic,
        "model": write_colmap,
        "bounds": write_poses_bounds,
    }.items():
        writer(place / "data" / name)
    for name, (image, _) in LAYOUTS.items():
        if image is not None:
            (place / "data" / name / image).unlink()
    keyframes = [{"at": 0.0, "targets": {}}, {"at": 0.5, "targets": {"hand": {"translation": [0, 0, 0.2]}}}]
    handle = {"name": "hand", "nodes": {"point": [0.8, 0.2, 0.3], "rings": 1}}
    content = {key: SCRIPT[key] for key in ("format", "version")}
    content |= {"handles": [handle], "keyframes": keyframes, "film": {"seconds": 0.5, "fps": 8, "size": 40}}
    (place / "edit.json").write_text(json.dumps(content))


def _train(name: str, said: str, more: str = "") -> Step:
    run = f"runs/{name}"
    return Step(
        name,
        f"train --data data/{name} --output {run} {{tiny}}{more}",
        (said, f"{run}: metrics.json"),
        tuple(f"{run}/{file}" for file in WRITTEN),
    )


RUN = "runs/blobs"
CHAPTERS: dict[str, tuple[Step, ...]] = {
    "start": (
        Step("version", "--version", ("scgs-warp",)),
        Step("help", "--help", ("usage: scgs-warp COMMAND",)),
        Step("settings", "config nodes", ("motion.nodes",)),
        _train("blobs", LAYOUTS["blobs"][1], " --steps 300"),  # until Gaussians are opaque
    ),
    "data": (
        *(_train(name, said) for name, (_, said) in LAYOUTS.items() if name != "blobs"),
        Step("synthesis", "synthesize --subject balls --size 48 --train 8 --test 2 --val 0 --output data/balls"),
        Step("static", "train --data data/room --output runs/static --motion static --steps 40 --device cpu"),
        Step("frames", "train --data data/panoptic --only-cameras 0,2 --frames 1:4 --output runs/part {tiny}"),
        Step("frames-again", "evaluate --run runs/part", ("3 images",)),
    ),
    "film": (
        Step("score", f"evaluate --run {RUN}", ("PSNR",), (f"{RUN}/evaluation/test/metrics.json",)),
        Step("film", f"view --run {RUN} --output film.mp4 --frames 6 --size 64", ("6 frames",), ("film.mp4",)),
        Step("gif", f"view --run {RUN} --mode time --output film.gif --frames 3 --size 48", writes=("film.gif",)),
        Step("zoom", f"view --run {RUN} --target 0 0 0 --zoom 2 --frames 2 --size 48 --output zoom", writes=("zoom",)),
        Step("depth", f"view --run {RUN} --show depth --frames 2 --size 48 --output depth", writes=("depth",)),
    ),
    "edit": (
        Step("edit", f"edit --run {RUN} --script edit.json --output edit.mp4", ("4 frames",), ("edit.mp4",)),
        Step("edited", f"edit --run {RUN} --script edit.json --export edit.ply", ("last keyframe",), ("edit.ply",)),
        Step("splats", "edit --ply edit.ply --nodes 20 --script edit.json --output splats.gif", (), ("splats.gif",)),
    ),
    "export": (
        *(
            Step(name, f"export --run {RUN} --format {name} --output {words}", (), (words.split()[0],))
            for name, words in EXPORTS.items()
        ),
        Step(
            "moving-mesh",
            f"export --run {RUN} --format mesh --sequence --frames 3 --resolution 32 --output mesh.glb",
            ("control points",),
            ("mesh.glb",),
        ),
        Step("flight", f"view --run {RUN} --path cameras.json --size 48 --output flight", (), ("flight",)),
    ),
    "more": (
        Step("longer", f"train --output {RUN} --resume --steps 320", ("320",), (), (RUN,)),
        Step("seen", "view --ply moment.ply --output moment.gif --frames 2 --size 48", (), ("moment.gif",)),
    ),
}
