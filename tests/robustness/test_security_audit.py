"""Audit of the sources: no call that could run a file's contents, upper bounds for every dependency."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from helpers.paths import ROOT

SOURCES = sorted(path for folder in ("kernels", "scgs_warp", "apps") for path in (ROOT / folder).rglob("*.py"))

MODULES = {
    "pickle",
    "cPickle",
    "dill",
    "cloudpickle",
    "joblib",
    "shelve",
    "marshal",
    "yaml",
    "tarfile",
    "pty",
    "xmlrpc",
}
NAMES = {"eval", "exec", "compile", "__import__"}
"""Names of forbidden built-in functions; methods may have these names."""
ENDINGS = {
    "os.system", "os.popen", "np.load", "numpy.load", "torch.save", "torch.hub.load", "tempfile.mktemp", "json.load",
    "extractall", "joblib.load", "shutil.unpack_archive", "yaml.load", "pickle.loads", "os.execv", "os.spawnv",
}  # fmt: skip
ENDINGS_ONLY_IN = {
    ".read_text": {
        "environment.py",
        "memory.py",
        "page.py",
        "viewer.py",
        "completion.py",
        "provenance.py",
        "__init__.py",
    },
    ".read_bytes": {"files.py", "run.py", "ray_worker.py"},
}
"""Methods of paths that wait for a pipe and never end on ``/dev/zero``, and the files in which they read our own
files or the system's."""
ONLY_IN = {"json.loads": {"json_files.py", "page_data.py", "edit_file.py", "from_mesh.py", "film.py"}}
"""Functions unsafe for untrusted text, and the files in which they read our own."""


def forbidden(tree: ast.AST, name: str) -> Iterator[str]:
    """Yield the unsafe calls and imports of a source file of this name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found = {alias.name.partition(".")[0] for alias in node.names} & (MODULES | {"pycolmap"})
        elif isinstance(node, ast.ImportFrom):
            found = {(node.module or "").partition(".")[0]} & MODULES if node.level == 0 else set()
        elif isinstance(node, ast.Call):
            found = set(_of_call(node, name))
        else:
            continue
        yield from (f"{name}:{node.lineno} {what}" for what in found)


def _of_call(node: ast.Call, name: str) -> Iterator[str]:
    called = ast.unparse(node.func)
    given = {keyword.arg: keyword.value for keyword in node.keywords}
    if called in NAMES or called in ENDINGS or called.rpartition(".")[2] in ENDINGS:
        yield called
    if "shell" in given or (called.startswith("subprocess.") and not isinstance(node.args[0], ast.List)):
        yield f"{called} through a shell"
    if "allow_pickle" in given and ast.unparse(given["allow_pickle"]) != "False":
        yield "allow_pickle"
    if called.endswith("torch.load") and ast.unparse(given.get("weights_only", ast.Constant(None))) != "True":
        yield "torch.load without weights_only"
    if name not in ONLY_IN.get(called, {name}):
        yield f"{called} where parse_json belongs"
    if any(called.endswith(end) and name not in files for end, files in ENDINGS_ONLY_IN.items()):
        yield f"{called} where storage/files.py belongs"


def test_nothing_runs_what_a_file_says():
    assert len(SOURCES) > 200
    found = [list(forbidden(ast.parse(path.read_text(encoding="utf-8")), path.name)) for path in SOURCES]
    assert [line for lines in found for line in lines] == []


@pytest.mark.parametrize(
    "code",
    [
        "import pickle", "from yaml import load", "eval('1')", "exec(x)", "np.load(path)", "torch.load(path)",
        "np.fromfile(p, allow_pickle=True)", "subprocess.run('ls', shell=True)", "subprocess.Popen(command)",
        "torch.load(p, weights_only=False)", "archive.extractall()", "os.system('x')", "json.loads(text)",
        "tempfile.mktemp()", "import dill.source", "path.read_text()", "(folder / name).read_bytes()",
        "import pycolmap",
    ],
)  # fmt: skip
def test_the_audit_sees_what_it_looks_for(code):
    assert list(forbidden(ast.parse(code), "any.py"))


def test_dependencies_are_bounded():
    """Every dependency has an upper bound, since a new major version may change anything."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    needed = re.search(r"^dependencies = \[(.*?)^\]", text, re.M | re.S)
    extras = re.search(r"^\[project.optional-dependencies\](.*?)^\[", text, re.M | re.S)
    assert needed is not None and extras is not None
    listed = re.findall(r'"([^"]+)"', re.sub(r"#.*", "", needed[1] + extras[1]))
    assert len(listed) > 20
    assert [item for item in listed if not re.search(r"<|==", item)] == []
    assert [item for item in listed if not re.search(r">=|==", item)] == [], ".ci/ends lowest tests the lower bounds"


def test_secrets_are_compared_in_constant_time():
    """``==`` takes longer the more characters match."""
    tree = ast.parse((ROOT / "scgs_warp/live/access.py").read_text(encoding="utf-8"))
    compared = [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Compare)]
    secrets = [text for text in compared if re.search(r"\b(token|given|key)\b", text)]
    assert [text for text in secrets if text != "len(given) != 1"] == []
    called = [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert sum(text.startswith("hmac.compare_digest(") for text in called) == 1


def test_pages_take_text_as_text():
    """Names of parts and files come from strangers: no script of a page makes HTML or programs of a text."""
    scripts = sorted((ROOT / "scgs_warp").rglob("*.js"))
    assert len(scripts) > 15
    made = re.compile(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|srcdoc")
    assert [path.name for path in scripts if made.search(path.read_text(encoding="utf-8"))] == []
