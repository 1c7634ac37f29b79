"""How `make docs` makes the site: Sphinx reads the pages where they lie.

The sources begin at the root of the repository, so that a link between pages, to a result or to a
file of the package is the same here and on a forge. Nothing is loaded from the network, neither
when the site is built nor when it is read.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "docs/_site"), str(ROOT)]

project = "wlplan"
author = "the authors of wlplan"
root_doc = "docs/index"
include_patterns = [
    "docs/**.md",
    "experiments/README.md",
    "experiments/results/*.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "SECURITY.md",
]
exclude_patterns = [".*", "**/.*", "out", "demo", "build", "dist", "wlplan", "tests"]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "commands",
    "contents",
    "docstrings",
]

# Anchors as a forge makes them, of all headings that are linked to.
myst_heading_anchors = 4
myst_enable_extensions = ["attrs_block", "deflist"]

# Names in single backticks of a docstring are links where the site knows them, and code elsewhere.
default_role = "py:name"
nitpicky = True
nitpick_ignore_regex = [("py:(obj|name)", ".*"), ("py:.*", r"(?!wlplan\b).*")]

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
add_module_names = False
maximum_signature_line_length = 80
napoleon_use_ivar = True

smartquotes = False
html_show_copyright = False
html_theme = "furo"
html_title = "wlplan"
html_static_path = ["_site/static"]
html_css_files = ["site.css"]
html_additional_pages = {"index": "forward.html"}
templates_path = ["_site/templates"]
html_copy_source = False
