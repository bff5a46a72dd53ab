"""The notebooks, run, as pages of the site.

Notebooks are kept without outputs. `executed` runs one, and keeps what came out under the digest of
its cells and of the package, so that the tests and the site run each of them once between them.
"""

from __future__ import annotations

import base64
import hashlib
import os
from pathlib import Path

import nbformat
from mkdocs.structure.files import File
from nbclient import NotebookClient

ROOT = Path(__file__).parent.parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
KEPT = ROOT / "build" / "tutorials"


def executed(path: Path) -> nbformat.NotebookNode:
    """A notebook with the outputs of its cells, run from top to bottom unless that was done."""
    notebook = nbformat.read(path, as_version=4)
    kept = KEPT / f"{path.stem}-{_digest(notebook)}.ipynb"
    if kept.exists():
        return nbformat.read(kept, as_version=4)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": path.parent}}).execute()
    KEPT.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, kept)
    return notebook


def _digest(notebook: nbformat.NotebookNode) -> str:
    """Of everything that the outputs depend on."""
    parts = [cell.source.encode() for cell in notebook.cells]
    parts += [module.read_bytes() for module in sorted((ROOT / "reachjax").rglob("*.py"))]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


def on_files(files, config):
    """Add a page, and its figures, for each notebook."""
    for path in NOTEBOOKS:
        text, figures = _page(executed(path), path.stem)
        files.append(File.generated(config, f"tutorials/{path.stem}.md", content=text))
        for name, content in figures.items():
            files.append(File.generated(config, f"tutorials/{name}", content=content))
    return files


def _page(notebook: nbformat.NotebookNode, stem: str) -> tuple[str, dict[str, bytes]]:
    """Markdown, and the figures that it shows."""
    parts, figures = [], {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            data = output.get("data", {})
            if output.get("name") == "stdout":
                parts.append(_text(output.text))
            elif "image/png" in data:
                name = f"{stem}-{len(figures)}.png"
                figures[name] = base64.b64decode(data["image/png"])
                parts.append(f"![What the code above draws]({name})")
            elif "text/html" in data:  # one line is one block of markdown
                parts.append(data["text/html"].replace("\n", ""))
            elif output.output_type == "execute_result":
                parts.append(_text(data["text/plain"]))
    return "\n\n".join(parts), figures


def _text(printed: str) -> str:
    return f"```{{.text .output .no-copy}}\n{printed.rstrip()}\n```"
