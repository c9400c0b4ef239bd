"""Write every table with figures in README.md and docs/*.md from the JSON files in benchmarks/results/.

    python benchmarks/report.py            # rewrite what stands between the markers
    python benchmarks/report.py --check    # write nothing; exit with status 1 where a table is not what its JSON gives

A table NAME stands between ``<!-- table: NAME -->`` and ``<!-- /table -->``, in any page, once or more. Timings come
from results/NAME.json, scores of training runs from results/quality/, figures of other projects from
results/literature/, and results/reported/NAME.json holds tables that were reported without a committed run. Rows of
reported figures are marked with a dagger. A double dagger marks rows whose code was changed after they were measured;
``--check`` ignores it, since it depends on the history and not on the result.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

from format_tables import NAMES as FORMATS
from format_tables import format_table
from gpu_table import NAME as GPU
from gpu_table import gpu_table
from kernel_tables import WRITERS as KERNELS
from kernel_tables import kernel_table
from mutation_table import NAME as MUTATION
from mutation_table import mutation_table
from provenance import ROOT, reported_table, without_older_marks
from quality_tables import WRITERS, quality_table
from repeatable_tables import REPEATABLE, repeatable_table
from timing_tables import BENCHMARKS, speed_overview, speed_ratios, timing_table

RESULTS = ROOT / "benchmarks" / "results"
MARKED = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- /table -->)", re.DOTALL)


def table_names(results: Path) -> list[str]:
    """Return the names of all tables that must stand on a page."""
    reported = {path.stem for path in (results / "reported").glob("*.json")}
    return [
        *BENCHMARKS,
        "speed-overview",
        "speed-ratios",
        *KERNELS,
        *FORMATS,
        *(f"quality-{name}" for name in WRITERS),
        *sorted(reported | set(REPEATABLE)),
        MUTATION,
        GPU,
    ]


def section(name: str, results: Path) -> str:
    """Write the table ``name``.

    Raises:
        ValueError: there is no such table.
    """
    if name in BENCHMARKS:
        return timing_table(name, results)
    if name == MUTATION:
        return mutation_table(results)
    if name == GPU:
        return gpu_table(results)
    if name == "speed-overview":
        return speed_overview(results)
    if name == "speed-ratios":
        return speed_ratios(results)
    if name in KERNELS:
        return kernel_table(name, results)
    if name in FORMATS:
        return format_table(name, results)
    if name.startswith("quality-") and name[len("quality-") :] in WRITERS:
        return quality_table(name[len("quality-") :], results)
    measured = repeatable_table(name, results) if name in REPEATABLE else None
    if measured is not None:
        return measured
    path = results / "reported" / f"{name}.json"
    if path.is_file():
        return reported_table(path)
    if name in REPEATABLE:
        return "Not measured yet."
    raise ValueError(f"<!-- table: {name} -->: no such table")


def fill(page: str, results: Path) -> str:
    """Write every table of a page anew.

    Raises:
        ValueError: a marker names a table that does not exist, or a table has no end.
    """
    if page.count("<!-- table:") != page.count("<!-- /table -->"):
        raise ValueError("the page needs a <!-- /table --> for every <!-- table: NAME -->")
    return MARKED.sub(lambda match: f"{match[1]}{section(match[2], results)}\n{match[3]}", page)


def main(args: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON files")
    parser.add_argument("--pages", type=Path, nargs="+", help="Markdown files; by default README.md and docs/*.md")
    options = parser.parse_args(args)
    paths = options.pages or [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    pages = {path: path.read_text(encoding="utf-8") for path in paths}
    homeless = set(table_names(options.results)) - {
        match[2] for page in pages.values() for match in MARKED.finditer(page)
    }
    if homeless:
        print(f"no page has <!-- table: {' --> nor <!-- table: '.join(sorted(homeless))} -->", file=sys.stderr)
        return 1
    status = 0
    for path, page in pages.items():
        try:
            filled = fill(page, options.results)
        except ValueError as error:
            print(f"{path}: {error}", file=sys.stderr)
            return 1
        if options.check and without_older_marks(filled) != without_older_marks(page):
            print(f"{path} is not what {options.results} gives: run benchmarks/report.py", file=sys.stderr)
            status = 1
        elif not options.check and filled != page:
            path.write_text(filled, encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main())
