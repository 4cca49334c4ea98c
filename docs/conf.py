"""Settings of Sphinx for the site, which ``python -m docs.build site`` builds from generated sources."""

import re
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml

import bench

HERE = Path(__file__).parent
ADDRESSES = tomllib.loads((HERE.parent / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]["hooks"]["custom"]

project = "bench"
author = "The bench authors"
copyright = "The bench authors, Apache License 2.0"
version = release = bench.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["repo", "data"]
suppress_warnings = ["myst.header"]
myst_enable_extensions = ["colon_fence", "attrs_block", "dollarmath"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True

html_theme = "pydata_sphinx_theme"
html_math_renderer = "mathml"  # needs neither a script nor a network
html_context = {"default_mode": "auto"}
html_title = "bench: which gradient can I trust?"
html_static_path = [str(HERE / "site.css"), str(HERE / "site.js")]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_extra_path = [str(HERE / "switcher.json")]
html_copy_source = False
html_show_sourcelink = False
html_show_search_summary = False  # it needs a server
html_sidebars: dict[str, list[str]] = {"index": []}
html_theme_options = {
    "github_url": ADDRESSES["repository"],  # no link while it is empty
    "logo": {"text": "bench"},
    "header_links_before_dropdown": 5,
    "collapse_navigation": True,
    "show_toc_level": 2,
    "navbar_align": "left",
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
if ADDRESSES["site"]:  # the switcher of versions needs a server
    html_theme_options |= {
        "navbar_end": ["version-switcher", "theme-switcher", "navbar-icon-links"],
        "switcher": {"json_url": f"{ADDRESSES['site']}/switcher.json", "version_match": version},
        "check_switcher": False,
    }


def escape_bars(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Escape the bars of norms in docstrings, such as |x|, which reStructuredText takes for substitutions."""
    lines[:] = [re.sub(r"(``.*?``)|\|", lambda match: match[1] or r"\|", line) for line in lines]


def write_math(self: Any, node: Any) -> None:
    """Write a formula as MathML."""
    self.body.append(latex2mathml.tex2mathml(node.astext(), isinstance(node, nodes.math_block)))
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Connect the functions above to Sphinx."""
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    app.connect("autodoc-process-docstring", escape_bars)
