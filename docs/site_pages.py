"""MkDocs hook: add the pages that the repository keeps outside ``docs/`` (README, contributing, code of conduct,
security, changelog, examples)."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the site."""
    pages = {
        "index.md": with_live_scene(from_docs((ROOT / "README.md").read_text(encoding="utf-8"))),
        "contributing.md": from_docs((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")),
        "code-of-conduct.md": from_docs((ROOT / "CODE_OF_CONDUCT.md").read_text(encoding="utf-8")),
        "security.md": from_docs((ROOT / "SECURITY.md").read_text(encoding="utf-8")),
        "changelog.md": from_docs((ROOT / "CHANGELOG.md").read_text(encoding="utf-8")),
        "examples.md": examples_page(),
    }
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, **known: Any) -> str:
    """Link to the site's pages of what the repository keeps outside ``docs/``."""
    return markdown.replace("](../examples/)", "](examples.md)").replace("](../CONTRIBUTING.md)", "](contributing.md)")


def on_page_content(html: str, **known: Any) -> str:
    """Remove reStructuredText roles such as :class: before names: Markdown does not render them."""
    return re.sub(r":(?:class|func|meth|mod):(?=<code>)", "", html)


def from_docs(text: str) -> str:
    """Rewrite links relative to the repository's root as links of the site; ``mkdocs build --strict`` checks them."""
    text = re.sub(r"(\]\()docs/", r"\1", text)
    text = text.replace("](SECURITY.md)", "](security.md)").replace("](CONTRIBUTING.md)", "](contributing.md)")
    return re.sub(r"(\]\()examples/?(?:tutorial\.ipynb)?(?=\))", r"\1examples.md", text)


def with_live_scene(text: str) -> str:
    """Put a scene whose parts can be pulled in the place of the first film. It is an exported page:

    python apps/train.py --max-gaussians 15000 --steps 5000 --output runs/live
    python apps/export.py --run runs/live --output docs/live/figure.html --pose --max-mib 1.5 --title Figure
    """
    frame = (
        '<iframe src="live/figure.html" title="The built-in scene: pull an arm or a leg, or turn the view" '
        'style="width: 100%; height: 26rem; border: 0"></iframe>\n\n'
        "*Pull an arm or a leg; drag beside the figure to turn the view.*"
    )
    shown, count = re.subn(r"!\[[^\]]*\]\(images/turntable\.gif\)", frame, text, count=1)
    if not count:
        raise ValueError("README.md: there is no film in the place of which the live scene could stand")
    return shown


def examples_page() -> str:
    """Build a page of all scripts in examples/ from their docstrings and code."""
    parts = [
        "# Examples\n\nShort scripts in `examples/`, to be read and changed. Each explains its options with `--help`.\n"
    ]
    for path in sorted((ROOT / "examples").glob("*.py")):
        code = path.read_text(encoding="utf-8")
        about = ast.get_docstring(ast.parse(code)) or ""
        title, _, rest = about.partition("\n")
        body = code.split('"""', 2)[2].strip()
        rest = re.sub(r"(?m)^    (.*)$", r"\1", re.sub(r"(?ms)^(    .*?)(?=\n\n|\Z)", r"```bash\n\1\n```", rest))
        name, _, tail = title.partition(": ")
        heading = f"{path.stem[:2]} {name.rstrip('.')}"
        lead = f"{tail[:1].upper()}{tail[1:]}\n" if tail else ""
        parts.append(f"## {heading}\n\n{lead}{rest}\n\n`examples/{path.name}`:\n\n```python\n{body}\n```\n")
    return "\n".join([*parts, notebook()])


def notebook() -> str:
    """Build a section of the tutorial notebook from its cells."""
    content = json.loads((ROOT / "examples/tutorial.ipynb").read_text(encoding="utf-8"))
    parts = ["## Notebook\n\n`examples/tutorial.ipynb` leads from images to an edit.\n"]
    for cell in content["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "code":
            parts.append(f"```python\n{text}\n```\n")
        else:
            parts.append(re.sub(r"(?m)^#+ ", "### ", text).replace("](../docs/", "](") + "\n")
    return "\n".join(parts)
