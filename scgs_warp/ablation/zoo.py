"""The zoo: every built-in subject as a data set of 200 x 200 pixels, and the comparison with another table of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ..data.synthetic import builtin, from_mesh, zoo
from ..data.synthetic.orbit_cameras import FilmingSettings
from ..errors import UserError, printable
from ..runtime.progress import progress
from ..storage.files import read_text
from ..storage.json_files import as_number, parse_json
from .cells import NUMBER_LIMIT

DATA = Path("data")
SIZE, TRAIN, TEST = 200, 100, 20
"""Width and height in pixels, and numbers of training and held-out images, of every data set."""
STEPS = 6_000
"""Steps of each run, unless the options choose another schedule."""
LOSS_DB = 0.2
"""Loss of PSNR in dB from which a row is marked."""
COMPARED = {"psnr": "psnr_change", "psnr_worst": "worst_change"}
"""Metrics that are compared, and the fields of a row for their differences in dB."""


def parse_subjects(texts: Sequence[str]) -> tuple[str, ...]:
    """Parse the requested subjects; all by default, in the order of the zoo.

    Raises:
        UserError: there is no such subject.
    """
    for text in texts:
        if text not in zoo.SUBJECTS:
            raise UserError(f"--values {text!r}: zoo takes some of {', '.join(zoo.SUBJECTS)}, with commas between")
    return tuple(name for name in zoo.SUBJECTS if not texts or name in texts)


def subject_folders(names: Iterable[str]) -> dict[str, Path]:
    """Return the data folders of subjects, which need not exist yet.

    Their path has the versions of all that determines their pictures, so that a table never mixes two versions.
    """
    version = f"{from_mesh.VERSION}.{builtin.VERSION}.{zoo.VERSION}"
    return {name: DATA / f"zoo-{SIZE}-v{version}" / name for name in names}


def make_subjects(folders: dict[str, Path], device: str) -> None:
    """Make the data sets that do not exist yet.

    Args:
        folders: results of :func:`subject_folders`.
        device: device of the ray casting, ``cpu`` or ``cuda``.

    Raises:
        UserError: a folder holds something else, or cannot be written.
    """
    filming = FilmingSettings(SIZE, SIZE, train=TRAIN, test=TEST, val=0)
    for name, folder in folders.items():
        if (folder / from_mesh.MARKER).is_file():
            continue
        planned = from_mesh.plan_synthesis(folder, from_mesh.SynthesisRequest(subject=name, filming=filming), device)
        with progress(sum(planned.counts.values()), f"making {name}") as bar:
            from_mesh.synthesize(planned, lambda done, total: bar.advance())


def read_table(folder: Path) -> dict[str, Any]:
    """Read the table of another zoo folder.

    Returns:
        ``settings`` of its cells, and ``rows``: the mean of each metric in ``COMPARED``, by the name of the row.

    Raises:
        UserError: the folder holds no table, or a damaged one.
    """
    path = folder / "zoo.json"
    try:
        report = parse_json(read_text(path))
    except FileNotFoundError:
        raise UserError(f"--compare {folder}: holds no zoo.json; name the --output of another zoo") from None
    except (OSError, ValueError):
        raise UserError(f"{path}: damaged; make it again with --table-only") from None
    try:
        settings, found = report["settings"], {}
        for row in report["tables"][0]["rows"]:
            known = {key: as_number(row[key]["mean"]) for key in COMPARED if row[key] is not None}
            found[str(row["value"])] = {
                key: value for key, value in known.items() if value is not None and abs(value) < NUMBER_LIMIT
            }
        named = {key: printable(settings[key]) for key in ("preset", "steps") if key in settings}
    except (KeyError, IndexError, TypeError):
        raise UserError(f"{path}: damaged; make it again with --table-only") from None
    return {"folder": printable(folder.resolve().name), "settings": named, "rows": found}


def compare_rows(rows: list[dict[str, Any]], other: dict[str, dict[str, float]]) -> None:
    """Add to each row its differences in dB from the other table, and ``loses``, the metrics that lose more than
    ``LOSS_DB``.

    Args:
        rows: rows of the subjects, and last, of several, that of their mean; its differences are the means over the
            subjects that both tables have.
        other: ``rows`` of :func:`read_table`.
    """
    subjects = rows[:-1] if len(rows) > 1 else rows
    for row in subjects:
        known = other.get(row["value"], {})
        for key, change in COMPARED.items():
            row[change] = row[key]["mean"] - known[key] if row[key] and key in known else None
    for row in rows[len(subjects) :]:
        for change in COMPARED.values():
            values = [subject[change] for subject in subjects if subject[change] is not None]
            row[change] = sum(values) / len(values) if values else None
    for row in rows:
        row["loses"] = [key for key, change in COMPARED.items() if row[change] is not None and row[change] < -LOSS_DB]
