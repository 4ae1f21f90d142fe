# SPDX-License-Identifier: Apache-2.0
"""Sphinx's configuration of the documentation site; `make docs` builds it into out/site.

Nothing in the pages needs the network: the formulas are MathML, the theme brings no fonts, the search runs in the
browser. What can be generated from the code (parameters, topics, messages, commands, API, model cards) is written to
docs/generated before Sphinx reads the sources.
"""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_tools"), str(HERE.parent)]

import docstrings  # noqa: E402
import mathml  # noqa: E402
import pages  # noqa: E402
from sphinx.application import Sphinx  # noqa: E402

from flowing_puppet_ros import __version__  # noqa: E402

project = "flowing_puppet_ros"
copyright = "flowing_puppet_ros contributors, Apache-2.0"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
# Tables that pages include are no pages of their own.
exclude_patterns = [
    *("_tools", "_static"),
    *("generated/architecture", "generated/bench", "generated/method", "generated/nodes"),
]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
# Names of attributes that several classes have, in "Attributes:" of a docstring, are no references.
suppress_warnings = ["config.cache", "ref.python"]
toc_object_entries = False
add_module_names = False

# Of ROS, but not among its wheels.
autodoc_mock_imports = ["launch", "launch_ros"]
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_use_ivar = True
default_role = "literal"

html_theme = "furo"
html_title = f"flowing_puppet_ros {__version__}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False
pygments_style = "friendly"
pygments_dark_style = "github-dark"


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the generated pages and put our docstring and formula converters in place."""
    pages.write(HERE / "generated")
    docstrings.setup(app)
    mathml.setup(app)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
