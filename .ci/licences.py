"""Print the licences of scgs_warp and of every package that it needs at run time, as a Markdown table.

``.ci/licences.py`` in an environment with the extras installed; ``docs/licences.md`` holds its output.
"""

from __future__ import annotations

import re
from importlib import metadata

from packaging.requirements import Requirement

EXTRAS = ("edit", "export", "gltf", "tensorboard", "cluster")
"""Extras for users; those for developers are not shipped."""
NORMAL = {
    "MIT License": "MIT",
    "BSD License": "BSD",
    "Apache Software License": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0",
    "Apache 2.0": "Apache-2.0",
    "Apache": "Apache-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "ISC License (ISCL)": "ISC",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "The Unlicense (Unlicense)": "Unlicense",
    "Historical Permission Notice and Disclaimer (HPND)": "HPND",
    "GNU Lesser General Public License v3 or later (LGPLv3+)": "LGPL-3.0-or-later",
}


def needed(name: str, extras: tuple[str, ...] = ()) -> dict[str, metadata.Distribution]:
    """Return the installed distributions that a distribution needs, itself included, by their normal names."""
    found: dict[str, metadata.Distribution] = {}
    waiting = [(name, extras)]
    while waiting:
        name, wanted = waiting.pop()
        key = re.sub(r"[-_.]+", "-", name).lower()
        if key in found:
            continue
        try:
            found[key] = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue
        for text in found[key].requires or []:
            requirement = Requirement(text)
            marked = requirement.marker
            if marked is None or any(marked.evaluate({"extra": extra}) for extra in (*wanted, "")):
                waiting.append((requirement.name, tuple(requirement.extras)))
    return found


def licence(distribution: metadata.Distribution) -> str:
    """Return the licence that a distribution states: an SPDX expression, a classifier, or the first line of a text."""
    about = distribution.metadata
    if expression := about.get("License-Expression"):
        return expression
    named = [line.split(" :: ")[-1] for line in about.get_all("Classifier") or [] if line.startswith("License ::")]
    named = [name for name in named if name != "OSI Approved"]
    if named:
        return ", ".join(sorted({NORMAL.get(name, name) for name in named}))
    first = (about.get("License") or "").strip().splitlines()
    return NORMAL.get(first[0], first[0])[:60] if first else "not stated"


def main() -> None:
    print("| package | licence |\n| --- | --- |")
    for key, distribution in sorted(needed("scgs-warp", EXTRAS).items()):
        print(f"| {key} | {licence(distribution)} |")


if __name__ == "__main__":
    main()
