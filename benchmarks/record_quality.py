"""Keep the scores of a training run beside those that the pages show: benchmarks/results/quality/TABLE-ROW-SCENE.json.

    python benchmarks/record_quality.py runs/hook-cpu --table published --row cpu --scene hook

Command, commit and processor are those that apps/train.py wrote to metrics.json.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from quality_tables import WRITERS
from report import RESULTS


def main(args: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder with metrics.json")
    parser.add_argument("--table", choices=list(WRITERS), required=True)
    parser.add_argument(
        "--row", required=True, help="name of the row, as quality_tables.py or the reported runs have it"
    )
    parser.add_argument("--scene", required=True)
    parser.add_argument(
        "--white", action="store_true", help="also keep the scores of `apps/evaluate.py --run RUN --background white`"
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON files")
    options = parser.parse_args(args)
    try:
        metrics = json.loads((options.run / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        print(
            f"record_quality: {options.run}/metrics.json cannot be read ({error}); name a run folder", file=sys.stderr
        )
        return 2
    origin = metrics.pop("provenance", None)
    if not origin or not origin["command"] or not origin["commit"]:
        print(
            f"record_quality: {options.run}/metrics.json names no command and commit; train it again with apps/train.py"
            " in a clone",
            file=sys.stderr,
        )
        return 2
    machine = origin["machine"]
    processor = machine["gpu"] or f"{machine['processor']}, {machine['cores']} cores"
    run = {
        **{key: getattr(options, key) for key in ("table", "row", "scene")},
        "provenance": "measured",
        **origin,
        "processor": processor,
        **{key: value for key, value in metrics.items() if key not in ("per_image", "data")},
    }
    if options.white:
        scored = json.loads((options.run / "evaluation" / "test-white" / "metrics.json").read_text(encoding="utf-8"))
        run.update({f"{key}_white": scored[key] for key in ("psnr", "psnr_worst")})
    path = options.results / "quality" / f"{options.table}-{options.row}-{options.scene}.json"
    path.write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
