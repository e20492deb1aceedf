"""Sphinx configuration of the documentation; `make docs` builds it into build/docs."""

from typing import Any

from aomgen.version import __version__

project = "AOMGen"
author = copyright = "The AOMGen developers"
release = version = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence"]
# The notebooks contain their outputs; `make tutorials` executes them.
nb_execution_mode = "off"
# Links to a heading of another page use the slugs that GitHub uses.
myst_heading_anchors = 3
# A fence without a language is a command or a listing of files.
highlight_language = "text"
# A single backtick in a docstring means code.
default_role = "code"
html_theme = "furo"
html_title = "AOMGen"
html_static_path = ["static"]
html_css_files = ["site.css"]
exclude_patterns = ["figures"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
napoleon_use_rtype = False
# Names of other packages and of private modules have no page here.
nitpick_ignore_regex = [("py:.*", r".*")]
suppress_warnings = ["myst.strikethrough"]


def omit_return_type(app: Any, kind: str, name: str, *_: object) -> None:
    """Omit the return type "None" of an exception, which Sphinx omits only for other classes."""
    if kind == "exception":
        app.env.current_document.autodoc_annotations.get(name, {}).pop("return", None)


def setup(app: Any) -> None:
    app.connect("autodoc-process-signature", omit_return_type, priority=900)
