"""Runs the cells of a notebook without Jupyter, and prints what each cell shows, one JSON object a line.

Usage: notebook_cells.py NOTEBOOK
"""

import ast
import json
import sys
from pathlib import Path
from typing import Any


def shown(source: str, names: dict[str, Any]) -> dict[str, str]:
    """Runs one cell; the text and the HTML of its last expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    if not isinstance(last, ast.Expr):
        return {"text": "", "html": ""}
    value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    html = getattr(value, "_repr_html_", str)()
    return {"text": repr(value), "html": html}


def main(notebook: Path) -> None:
    """Runs all cells in one namespace, as a kernel does."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            source = "".join(cell["source"])
            print(json.dumps({"source": source, **shown(source, names)}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
