"""Layers and budgets of the source tree: who imports whom, how long files and functions are, where C++ stands."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers.paths import ROOT

SOURCES = sorted(path for folder in ("kernels", "scgs_warp", "apps") for path in (ROOT / folder).rglob("*.py"))
KERNELS = sorted((ROOT / "kernels").rglob("*.py"))
HEADERS = sorted((ROOT / "kernels" / "native").glob("*.h"))

MAX_FILE = 400
MAX_FUNCTION = 60
MAX_KERNEL = 120
MAX_ROOT_MODULES = 8
MAX_TEXT = 5
"""Lines of a string in kernels/ that is no docstring: C++ belongs in kernels/native."""


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def dotted_name(path: Path) -> str:
    """Return the name under which a source file is imported."""
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    if parts[0] != "scgs_warp":
        parts.insert(0, "scgs_warp")
    return ".".join(parts)


def imports_of(path: Path) -> Iterator[str]:
    """Yield the absolute names of all modules a file imports, wherever in the file it does."""
    package = dotted_name(path).split(".")[:-1]  # of ``x.__init__``: x
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *([node.module] if node.module else [])]
            yield ".".join(base)
            yield from (".".join([*base, alias.name]) for alias in node.names)


def violations(paths: list[Path], *forbidden: str) -> list[str]:
    """Return "file imports module" for every import of ``forbidden`` modules or of what lies below them."""
    return [
        f"{relative(path)} imports {name}"
        for path in paths
        for name in imports_of(path)
        if any(name == f or name.startswith(f + ".") for f in forbidden)
    ]


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the package in ``folder``, with the contracts of pyproject.toml."""
    command = shutil.which("lint-imports") or str(Path(sys.executable).with_name("lint-imports"))
    if not Path(command).is_file():
        pytest.skip("import-linter is not installed")
    code = "import sys; from importlinter.cli import lint_imports_command as run; sys.path.insert(0, '.'); run()"
    environ = {**os.environ, "PYTHONPATH": str(folder)}
    arguments = [sys.executable, "-c", code, "--config", str(ROOT / "pyproject.toml"), "--no-cache"]
    return subprocess.run(arguments, cwd=folder, env=environ, capture_output=True, text=True, timeout=120, check=False)


BROKEN = {
    "a circle of two modules": ("seeding.py", "from . import types", "types.py", "from . import seeding"),
    "a circle within a folder, inside a function": (
        "edit/solver.py",
        "def circle():\n    from .session import EditSession",
        None,
        None,
    ),
    "an import upward, for type checkers only": (
        "storage/files.py",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..scene.scene import Scene",
        None,
        None,
    ),
    "an import of a sibling on the same floor": ("data/dataset.py", "from ..scene import scene", None, None),
    "a module that stands in no layer": ("stray.py", "", None, None),
}


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    """A folder with a copy of the package's Python files."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(ROOT / "scgs_warp", folder / "scgs_warp", ignore=shutil.ignore_patterns("__pycache__", "web"))
    return folder


def test_layers_hold_and_nothing_imports_in_a_circle(package):
    """The floors and their order stand in pyproject.toml, [tool.importlinter]."""
    result = lint_imports(package)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_layer_is_noticed(name, package):
    first, line, second, other = BROKEN[name]
    added = {first: line, **({second: other} if second else {})}
    saved = {file: (package / "scgs_warp" / file) for file in added}
    before = {file: path.read_bytes() if path.is_file() else None for file, path in saved.items()}
    try:
        for file, path in saved.items():
            path.write_bytes((before[file] or b"") + f"\n\n{added[file]}\n".encode())
        result = lint_imports(package)
        assert result.returncode == 1 and "BROKEN" in result.stdout, result.stdout + result.stderr
    finally:
        for file, path in saved.items():
            content = before[file]
            path.unlink() if content is None else path.write_bytes(content)


def test_imports_are_resolved():
    """The checks below see relative and absolute imports."""
    op = ROOT / "scgs_warp" / "ops" / "ssim.py"
    assert {"torch", "scgs_warp.kernels.ssim", "scgs_warp.runtime.launch"} <= set(imports_of(op))


def test_kernels_are_warp_only():
    """No torch, no NumPy, nothing of the package above; portable forms do not know the fast ones."""
    above = sorted({dotted_name(path).rpartition(".")[0] for path in SOURCES} - {"scgs_warp"})
    above = [name for name in above if not name.startswith("scgs_warp.kernels")]
    assert "scgs_warp.ops" in above and violations(KERNELS, "torch", "numpy", *above) == []
    portable = [path for path in KERNELS if path.parent.name == "kernels"]
    assert len(portable) > 10 and violations(portable, "scgs_warp.kernels.cpu", "scgs_warp.kernels.cuda") == []


def test_importing_kernels_brings_no_torch():
    """The package above is stubbed, as it may import what it likes."""
    code = (
        "import importlib, importlib.util as u, pkgutil, sys, types\n"
        "package = types.ModuleType('scgs_warp'); package.__path__ = []; sys.modules['scgs_warp'] = package\n"
        f"folder = {str(ROOT / 'kernels')!r}\n"
        "spec = u.spec_from_file_location('scgs_warp.kernels', folder + '/__init__.py',\n"
        "    submodule_search_locations=[folder])\n"
        "kernels = u.module_from_spec(spec); sys.modules['scgs_warp.kernels'] = kernels\n"
        "spec.loader.exec_module(kernels)\n"
        "names = [m.name for m in pkgutil.walk_packages(kernels.__path__, 'scgs_warp.kernels.')]\n"
        "for name in names: importlib.import_module(name)\n"
        "print(len(names), 'torch' in sys.modules)\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    count, torch_came = result.stdout.split()[-2:]
    assert int(count) == len([path for path in KERNELS if path.parent.name != "kernels" or path.stem != "__init__"])
    assert torch_came == "False"


def test_the_library_does_not_know_its_apps():
    """``python -m scgs_warp`` is the one exception."""
    outside = ("apps/", "scgs_warp/__main__.py")
    library = [path for path in SOURCES if not relative(path).startswith(outside)]
    assert violations(library, "scgs_warp.apps", "apps") == []


def test_few_modules_stand_directly_in_the_package():
    assert len(list((ROOT / "scgs_warp").glob("*.py"))) <= MAX_ROOT_MODULES


def body_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count lines of code: a contract (arguments, docstring) may be as long as it needs to be."""
    first = node.body[1] if ast.get_docstring(node) is not None and len(node.body) > 1 else node.body[0]
    return (node.end_lineno or first.lineno) - first.lineno + 1


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_sizes(path):
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") < MAX_FILE
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            in_warp = any(ast.unparse(d).startswith(("wp.kernel", "wp.func")) for d in node.decorator_list)
            limit = MAX_KERNEL if in_warp else MAX_FUNCTION
            length = body_lines(node)
            assert length < limit, f"{path.name}:{node.lineno} {node.name} has {length} lines"


def is_text_of_a_system(call: ast.Call) -> bool:
    """Return whether a call reads or writes text without naming its encoding, which differs from system to system."""
    named = {keyword.arg for keyword in call.keywords}
    if isinstance(call.func, ast.Attribute):
        return call.func.attr in ("read_text", "write_text") and "encoding" not in named
    if not isinstance(call.func, ast.Name) or call.func.id != "open" or "encoding" in named:
        return False
    mode = call.args[1] if len(call.args) > 1 else ast.Constant("r")
    return isinstance(mode, ast.Constant) and "b" not in str(mode.value)


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_text_has_an_encoding(path):
    """Programs run with ``PYTHONWARNDEFAULTENCODING`` and warnings as errors, too."""
    calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    assert [call.lineno for call in calls if is_text_of_a_system(call)] == []


@pytest.mark.parametrize("path", HEADERS, ids=relative)
def test_sizes_of_headers(path):
    assert path.read_text(encoding="utf-8").count("\n") < MAX_FILE


@pytest.mark.parametrize("path", KERNELS, ids=relative)
def test_native_code_stands_in_files(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    statements = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    long = [
        f"{relative(path)}:{node.lineno}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant | ast.JoinedStr) and id(node) not in statements
        if (node.end_lineno or node.lineno) - node.lineno >= MAX_TEXT
    ]
    assert long == []


@pytest.mark.parametrize("path", [*KERNELS, *HEADERS], ids=relative)
def test_native_code_does_not_depend_on_the_width_of_long(path):
    """It has 32 bits on Windows: 64-bit numbers are ``long long``."""
    narrow = r"\((?:unsigned )?long\)|^\s*long (?!long\b)\w+\s*[=;,]|\b(?:const|unsigned) long (?!long\b)|\b\d+u?l\b"
    assert not re.findall(narrow, path.read_text(encoding="utf-8"), re.MULTILINE)
