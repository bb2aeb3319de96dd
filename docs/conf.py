"""The manual: `make docs` builds it to docs/_build/html."""

import sys
from collections.abc import Callable
from importlib.metadata import version as package_version
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert as latex_to_mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

sys.path.insert(0, str(Path(__file__).parent))
from reference_pages import write_pages

project = "undulog"
author = "the undulog developers"
copyright = "the undulog developers, Apache-2.0"  # noqa: A001 - the name that Sphinx reads
release = version = package_version("undulog")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "**/_*.md"]
html_theme = "furo"
html_math_renderer = "mathml"
html_title = f"undulog {version}"
html_static_path = ["_static"]
html_css_files = ["undulog.css"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_mock_imports: list[str] = []
napoleon_google_docstring = True
napoleon_numpy_docstring = False


def _write_notebook_pages() -> None:
    """Write the page of each notebook beside it, run anew."""
    sys.path.insert(0, str(Path(__file__).parent))
    from notebook_page import GALLERY, NOTEBOOK, executed_page

    for notebook in (NOTEBOOK, *GALLERY):
        notebook.with_suffix(".md").write_text(executed_page(notebook))


write_pages()
_write_notebook_pages()


def setup(app: Sphinx) -> None:
    """Set formulas as MathML: every browser draws it, without a script from elsewhere."""

    def visit(display: str) -> Callable[[HTML5Translator, nodes.Element], None]:
        def write(translator: HTML5Translator, node: nodes.Element) -> None:
            translator.body.append(latex_to_mathml(node.astext(), display=display))
            raise nodes.SkipNode

        return write

    app.add_html_math_renderer("mathml", (visit("inline"), None), (visit("block"), None))
