"""docs/licences.md names the licence of every package that users install."""

from __future__ import annotations

import re

from helpers.paths import ROOT

NAME = re.compile(r'^\s*"([A-Za-z0-9_.-]+)', re.M)


def listed() -> dict[str, str]:
    """The table of docs/licences.md: package -> licence."""
    text = (ROOT / "docs/licences.md").read_text(encoding="utf-8")
    return dict(re.findall(r"^\| ([a-z0-9-]+) \| (.+) \|$", text, re.M))


def test_every_package_that_users_install_is_listed():
    text = re.sub(r"#.*", "", (ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    needed = re.search(r"^dependencies = \[(.*?)^\]", text, re.M | re.S)
    extras = re.search(r"^\[project.optional-dependencies\](.*?)^\[", text, re.M | re.S)
    assert needed is not None and extras is not None
    names = set(NAME.findall(needed[1]))
    for extra, packages in re.findall(r"^(\w+) = \[(.*?)\]", extras[1], re.M | re.S):
        if extra not in ("dev", "docs"):
            names |= set(re.findall(r'"([A-Za-z0-9_.-]+)', packages))
    found = listed()
    assert len(names) > 14 and {name.lower() for name in names} - found.keys() == set()
    assert "not stated" not in found.values()


def test_licences_that_ask_for_more_than_a_notice_are_explained():
    text = (ROOT / "docs/licences.md").read_text(encoding="utf-8")
    notes = text[text.rindex("|") :]
    copyleft = {name for name, licence in listed().items() if re.search(r"\bA?GPL|General Public", licence)}
    assert copyleft == {"plyfile"} and all(f"`{name}`" in notes for name in copyleft)
