"""Measure a long film: memory against that of its first quarter, and quality against runs on its quarters.

    python benchmarks/long_film.py memory --work runs/long --json benchmarks/results/long-film-memory.json
    python benchmarks/long_film.py quality --work runs/long --json benchmarks/results/long-film-quality.json

The film shows the built-in figure, which never repeats a pose (``long_film_data.py``).

``memory`` reads every frame once, as training does, in a process of its own: rows hold ``frames``; ``bounded``, with
the cache of images at ``cache_mib`` and silhouettes kept within their room, or with the usual cache and all silhouettes
kept; ``images_mib``, what the cache holds; ``before_mib`` and ``peak_mib``, the peak of resident memory after loading,
which fills the cache, and in the end. Its pictures repeat, which memory does not notice.

``quality`` trains, each run in a process of its own: rows hold ``run``, ``frames``, ``chunks``, ``time_frequencies``,
``steps``, ``peak_mib``, ``cpu_seconds``; ``psnr``, the mean over held-out frames spread over the film; and
``at_borders`` and ``elsewhere``, the means over the same cameras near the borders of the quarters and a quarter of one
away from them. ``apart`` are the runs on quarters.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import statistics
import sys
from pathlib import Path
from typing import Any

from long_film_data import ACTS, FRAMES, SEAM_CAMERAS, SEAM_OFFSETS, SIZE, TEST_PER_ACT, make_film, make_part, repeat
from provenance import ROOT

from scgs_warp.benchmark.memory import peak_mib
from scgs_warp.config import presets
from scgs_warp.config.fields import CACHE_MIB
from scgs_warp.config.presets import PresetName, from_dict, with_steps
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.training.frames import Frames
from scgs_warp.training.run import load_splits, train_and_evaluate

Row = dict[str, Any]
PICTURES = 20
"""Number of pictures that the film of ``memory`` repeats."""
TESTS = ACTS * TEST_PER_ACT
FAR = 0.1
"""Distance from a border, in acts, from which a held-out frame is ``elsewhere``."""


def train(data: Path, output: Path, steps: int, options: argparse.Namespace, **motion: int) -> Row:
    """Train in a process of its own, unless the run exists; return what it took."""
    kept = output / "took.json"
    if not kept.exists():
        child = multiprocessing.get_context("spawn").Process(
            target=run, args=(data, output, steps, options.preset, options.cache_mib, motion)
        )
        child.start()
        child.join()
    return json.loads(kept.read_text())


def run(data: Path, output: Path, steps: int, preset: PresetName, cache_mib: int, motion: dict[str, int]) -> None:
    configure(1)
    changes = {"motion": motion, "data": {"cache_mib": cache_mib}, "evaluate_every": 10**6}
    config = from_dict(changes, "options", with_steps(presets.preset(preset), steps))
    train_and_evaluate(config, data, output, resume=output.exists(), frames=0)
    used = resource.getrusage(resource.RUSAGE_SELF)
    took = {"steps": steps, "peak_mib": round(used.ru_maxrss / 1024, 1), "cpu_seconds": round(used.ru_utime, 1)}
    (output / "took.json").write_text(json.dumps(took))


def scores(run: Path) -> dict[str, float]:
    """Return the PSNR of each held-out frame, by name."""
    return {row["name"]: row["psnr"] for row in json.loads((run / "metrics.json").read_text())["per_image"]}


def summary(psnr: dict[str, float]) -> Row:
    """Average over the frames spread over the film, and over those at borders and elsewhere."""
    rows = list(psnr.values())  # in the order of the data set
    seams = rows[TESTS:]
    sides: dict[bool, list[float]] = {False: [], True: []}
    for index, value in enumerate(seams):
        sides[abs(SEAM_OFFSETS[index % len(SEAM_OFFSETS)]) < FAR].append(value)
    assert len(rows) == TESTS + (ACTS - 1) * SEAM_CAMERAS * len(SEAM_OFFSETS)
    names = {"psnr": rows[:TESTS], "at_borders": sides[True], "elsewhere": sides[False]}
    return {name: round(statistics.mean(values), 3) for name, values in names.items()}


def memory(options: argparse.Namespace) -> list[Row]:
    """Read the film and a quarter of it frame by frame, with what is kept bounded and unbounded."""
    seed, rows = options.work / "pictures", []
    make_film(seed, PICTURES, tuple(options.size))
    for bounded in (True, False):
        for frames in (options.frames // ACTS, options.frames):
            data = options.work / f"repeated-{frames}"
            repeat(seed, frames, data)
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                rows.append(pool.apply(visit, (data, options.cache_mib, bounded)))
    return rows


def visit(data: Path, cache_mib: int, bounded: bool) -> Row:
    """Read every frame once, as a step of stage 1 does, and return how much memory the process took."""
    configure(1)
    mib = cache_mib if bounded else CACHE_MIB
    config = from_dict({"data": {"cache_mib": mib}}, "options", presets.preset("cpu"))
    train, _ = load_splits(config, data)
    frames = Frames(train, Normalisation.fit(train.cameras, train.points), config, "cpu")
    if not bounded:
        frames.silhouettes.room = 2**40
    before = peak_mib("cpu")
    for index in range(len(frames)):
        frames.load(index, 0, random_background=True, sought=True)
    peak = peak_mib("cpu")
    assert before is not None and peak is not None
    kept = {"bounded": bounded, "cache_mib": mib, "images_mib": round(train.cache.used / 2**20, 1)}
    return {"frames": len(frames), **kept, "before_mib": round(before, 1), "peak_mib": round(peak, 1)}


def quality(options: argparse.Namespace) -> list[Row]:
    """Train on the film in chunks and with a single network, and on its quarters, for equally many steps per frame."""
    work, film = options.work, options.work / "film"
    make_film(film, options.frames, tuple(options.size))
    rows, apart = [], {}
    total: Row = {"steps": 0, "cpu_seconds": 0.0}
    for act in range(ACTS):
        make_part(film, act, work / f"part-{act}")
        took = train(work / f"part-{act}", work / f"apart-{act}", options.steps // ACTS, options)
        total = {name: total[name] + took[name] for name in total}
        apart |= scores(work / f"apart-{act}")
    rows.append({"run": "apart", "frames": options.frames, "chunks": 1, "time_frequencies": 6, **total})
    rows[0] |= summary(dict(sorted(apart.items())))
    for name, chunks, frequencies in (("chunks", ACTS, 6), ("one", 1, 6), ("one-finer", 1, 8)):
        took = train(film, work / name, options.steps, options, chunks=chunks, time_frequencies=frequencies)
        row = {"run": name, "frames": options.frames, "chunks": chunks, "time_frequencies": frequencies, **took}
        rows.append({**row, **summary(dict(sorted(scores(work / name).items())))})
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("memory", "quality"))
    parser.add_argument("--work", type=Path, required=True, help="folder for data and runs")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--steps", type=int, default=24_000, help="steps on the whole film")
    parser.add_argument("--preset", default="cpu")
    parser.add_argument("--cache-mib", type=int, default=512, help="cache of images, which a quarter fits into")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = (memory if options.part == "memory" else quality)(options)
    for row in rows:
        print(json.dumps(row))
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/long_film.py", sys.argv[1:])}
        content = {**origin, **provenance("cpu"), "size": list(options.size), "preset": options.preset, "rows": rows}
        (ROOT / options.json).write_text(json.dumps(content, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
