"""The documentation as a site: `make docs` builds it in `build/docs`.

What other folders hold, and what is made of the sources, goes to `docs/generated`: the notebooks, which are
not run (they are kept with their outputs), the list of benchmarks, the changelog, the API, the list of
messages.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
GENERATED = HERE / "generated"
COLON = "\N{RATIO}"
sys.path[:0] = [str(ROOT), str(HERE)]  # this checkout's bcppl, and the modules beside this file

import all_messages  # noqa: E402
import api  # noqa: E402
import kernel_tables  # noqa: E402

project = "bcppl"
copyright = "the authors of bcppl, Apache-2.0"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["generated/notebooks/.ipynb_checkpoints"]

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "off"
highlight_language = "none"
default_role = "py:obj"  # docstrings have code between single backticks: a link where that is documented

autodoc_type_aliases = api.aliases()
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = "bcppl"
html_copy_source = False
html_show_sphinx = False
html_show_search_summary = False  # a page that is opened as a file cannot read others
html_math_renderer = "mathml"


def _brought() -> None:
    """Write the pages that are not in this folder."""
    api.write(GENERATED / "api")
    _written("messages.md", all_messages.page())
    _written("kernels.md", kernel_tables.page())
    _written("benchmarks.md", (ROOT / "benchmarks/README.md").read_text(encoding="utf-8"))
    _written("changelog.md", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    (GENERATED / "notebooks").mkdir(exist_ok=True)
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        shutil.copy2(notebook, GENERATED / "notebooks")


def _written(name: str, text: str) -> None:
    file = GENERATED / name
    if not file.is_file() or file.read_text(encoding="utf-8") != text:
        file.write_text(text, encoding="utf-8")


# What a page names, and what the site has of that name: not in the folder, so a page has no link to it.
LINKED = {
    r"`notebooks/(\w+\.ipynb)`": r"[`\1`](generated/notebooks/\1)",
    r"`benchmarks/README\.md`": "[`benchmarks/README.md`](generated/benchmarks.md)",
    r"\*\*All messages\*\*": "[All messages](generated/messages.md)",
    r"\*\*(Kernels on problems with exact answers)\*\*": r"[\1](generated/kernels.md)",
}


def _with_links(app: Any, document: str, source: list[str]) -> None:
    """Link what a page names and this site has."""
    if not document.startswith("generated"):
        for name, link in LINKED.items():
            source[0] = re.sub(name, link, source[0])


def _reread(app: Any, what: str, name: str, documented: Any, options: Any, lines: list[str]) -> None:
    """Docstrings as bcppl writes them, in reStructuredText, before Google's sections are read."""
    lines[:] = api.reread(lines)
    if what in ("attribute", "property"):  # what stands before a colon would be read as the type
        lines[:] = [line.replace(":", COLON) for line in lines]


def _with_colons(app: Any, what: str, name: str, documented: Any, options: Any, lines: list[str]) -> None:
    """The colons of properties again, once Google's sections are read."""
    lines[:] = [line.replace(COLON, ":") for line in lines]


def _skipped(app: Any, what: str, name: str, documented: Any, skip: bool, options: Any) -> bool | None:
    """Leave out fields of named tuples, which the class describes."""
    return True if (getattr(documented, "__doc__", None) or "").startswith("Alias for field") else None


ALIAS = re.compile(r"TypeAliasForwardRef\('([\w.]+)'\)")


def _named(
    app: Any, what: str, name: str, documented: Any, options: Any, signature: str | None, returns: str
) -> tuple[str, str] | None:
    """Signatures with the names of types that have one, which autodoc does not write in a union."""
    if signature is None or not ALIAS.search(signature + (returns or "")):
        return None
    return ALIAS.sub(r"\1", signature), ALIAS.sub(r"\1", returns or "")


def _math(self: Any, node: nodes.Element) -> None:
    """An equation as MathML, which browsers show without a script."""
    block = isinstance(node, nodes.math_block)
    try:
        made = tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        logging.getLogger(__name__).warning("equation %r: %s", node.astext(), error, location=node)
        made = ""
    self.body.append(f'<div class="math">{made}</div>' if block else made)
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Connect what is above."""
    _brought()
    app.add_html_math_renderer("mathml", (_math, None), (_math, None))
    app.connect("source-read", _with_links)
    app.connect("autodoc-process-docstring", _reread, priority=100)
    app.connect("autodoc-process-docstring", _with_colons, priority=900)
    app.connect("autodoc-process-signature", _named)
    app.connect("autodoc-skip-member", _skipped)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
