"""Sphinx configuration of the documentation; `make docs` builds it into build/docs."""

from aomgen.version import __version__

project = "AOMGen"
author = copyright = "The AOMGen developers"
release = version = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence"]
# Links to a heading of another page use the slugs that GitHub uses.
myst_heading_anchors = 3
# A single backtick in a docstring means code.
default_role = "code"
html_theme = "furo"
html_title = "AOMGen"
exclude_patterns = ["figures"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_class_signature = "separated"
napoleon_use_rtype = False
# Names of other packages and of private modules have no page here.
nitpick_ignore_regex = [("py:.*", r".*")]
suppress_warnings = ["myst.strikethrough"]
