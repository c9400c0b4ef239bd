"""The layers stay layers, and files and functions stay readable: what imports what, and how long things are."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers.paths import ROOT

SOURCES = sorted(path for folder in ("kernels", "scgs_warp", "apps") for path in (ROOT / folder).rglob("*.py"))

MAX_FILE = 400
MAX_FUNCTION = 60
MAX_KERNEL = 120


def _name(path: Path) -> str:
    """Dotted name under which a source file is imported."""
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    if parts[0] != "scgs_warp":
        parts.insert(0, "scgs_warp")
    return ".".join(parts)


def _imports(path: Path) -> Iterator[str]:
    """Absolute names of all modules a file imports, wherever in the file it does."""
    package = _name(path).split(".")
    package = package[:-1]  # of a module: its folder; of ``x.__init__``: x
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *([node.module] if node.module else [])]
            yield ".".join(base)
            yield from (".".join([*base, alias.name]) for alias in node.names)


def _violations(folder: str, *forbidden: str) -> list[str]:
    found = []
    for path in SOURCES:
        if _name(path).startswith(folder):
            for name in _imports(path):
                if any(name == f or name.startswith(f + ".") for f in forbidden):
                    found.append(f"{path.relative_to(ROOT)} imports {name}")
    return found


def test_imports_are_resolved():
    """The checks below can see both a relative and an absolute import."""
    op = ROOT / "scgs_warp" / "ops" / "ssim.py"
    assert {"torch", "scgs_warp.kernels.ssim", "scgs_warp.runtime.launch"} <= set(_imports(op))


def test_kernels_leave_torch_alone():
    """Importing every kernel module brings no torch; the package above is stubbed, as it may import what it likes."""
    code = (
        "import importlib, pkgutil, sys, types\n"
        "package = types.ModuleType('scgs_warp'); package.__path__ = []; sys.modules['scgs_warp'] = package\n"
        "import importlib.util as u\n"
        f"spec = u.spec_from_file_location('scgs_warp.kernels', {str(ROOT / 'kernels' / '__init__.py')!r},\n"
        f"    submodule_search_locations=[{str(ROOT / 'kernels')!r}])\n"
        "kernels = u.module_from_spec(spec); sys.modules['scgs_warp.kernels'] = kernels\n"
        "spec.loader.exec_module(kernels)\n"
        "names = [m.name for m in pkgutil.iter_modules(kernels.__path__)]\n"
        "for name in names: importlib.import_module('scgs_warp.kernels.' + name)\n"
        "assert len(names) > 3\n"
        "print('torch' in sys.modules)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    assert result.stdout.split()[-1] == "False"


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        ("scgs_warp.kernels", ["torch", "numpy", "scgs_warp.ops", "scgs_warp.types", "scgs_warp.runtime.launch"]),
        (
            "scgs_warp.ops",
            [f"scgs_warp.{m}" for m in ("scene", "train", "motion", "data", "render", "losses", "densify", "apps")],
        ),
        ("scgs_warp.motion", [f"scgs_warp.{m}" for m in ("scene", "train", "render", "apps")]),
    ],
)
def test_lower_layers_do_not_know_upper_ones(folder, forbidden):
    assert _violations(folder, *forbidden) == []


def test_the_library_does_not_know_its_apps():
    found = [v for v in _violations("scgs_warp", "scgs_warp.apps", "apps") if not v.startswith("apps/")]
    assert found == []


def _body_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of code: a contract (arguments, docstring) may be as long as it needs to be."""
    first = node.body[1] if ast.get_docstring(node) is not None and len(node.body) > 1 else node.body[0]
    return (node.end_lineno or first.lineno) - first.lineno + 1


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_sizes(path):
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") < MAX_FILE
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            in_warp = any(ast.unparse(d).startswith(("wp.kernel", "wp.func")) for d in node.decorator_list)
            limit = MAX_KERNEL if in_warp else MAX_FUNCTION
            length = _body_lines(node)
            assert length < limit, f"{path.name}:{node.lineno} {node.name} has {length} lines"


@pytest.mark.parametrize("path", sorted((ROOT / "kernels").rglob("*.py")), ids=lambda path: path.name)
def test_native_code_does_not_depend_on_the_width_of_long(path: Path):
    """It has 32 bits on Windows: 64-bit numbers are ``long long``."""
    narrow = r"\((?:unsigned )?long\)|^\s*long (?!long\b)\w+\s*[=;,]|\b(?:const|unsigned) long (?!long\b)|\b\d+u?l\b"
    assert not re.findall(narrow, path.read_text(encoding="utf-8"), re.MULTILINE)
