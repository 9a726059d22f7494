"""How Sphinx builds the documentation: Markdown by MyST, the reference of the public names by autodoc."""

import ast
import re
import typing
from pathlib import Path

from sphinx.ext.autodoc.preserve_defaults import DefaultValue
from sphinx.util import inspect

# Before the library is imported: jaxtyping then writes annotations as people read them.
typing.GENERATING_DOCUMENTATION = "rt_torchrl"  # type: ignore[attr-defined]

import rt_torchrl  # noqa: E402

project, author, copyright = "rt_torchrl", "the authors of rt_torchrl", "the authors of rt_torchrl, MIT licence"
version = release = rt_torchrl.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "first_steps.ipynb"]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring, napoleon_numpy_docstring, napoleon_use_rtype = True, False, False

html_theme = "pydata_sphinx_theme"
html_title = "rt_torchrl"
html_show_sourcelink = False
html_sidebars = {"**": ["globaltoc"]}
html_theme_options = {
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "navbar_center": [],
    "footer_end": [],
    "pygments_light_style": "tango",
}


def reference(stub):
    """The page of every public name, under the headings of the stub that lists the names."""
    text, heading, page = stub.read_text(encoding="utf-8"), "", ["# Reference", ""]
    headings = {number: line[2:] for number, line in enumerate(text.splitlines(), 1) if line.startswith("# ")}
    for node in ast.parse(text).body:
        if not isinstance(node, ast.ImportFrom):
            continue
        above = headings[max(number for number in headings if number < node.lineno)]
        if above != heading:
            heading = above
            page += [f"## {heading}", ""]
        for name in (alias.name for alias in node.names):
            value = getattr(rt_torchrl, name)
            kind = "function" if inspect.isfunction(value) else "data"
            if isinstance(value, type):
                kind = "exception" if issubclass(value, BaseException) else "class"
            hidden = ["   :no-value:"] if kind == "data" else []
            page += ["```{eval-rst}", f".. auto{kind}:: rt_torchrl.{name}", *hidden, "```", ""]
    return "\n".join(page)


(Path(__file__).parent / "api.md").write_text(
    reference(Path(rt_torchrl.__file__).with_suffix(".pyi")), encoding="utf-8"
)


def absolute_values(app, what, name, obj, options, lines):
    """|x| in a docstring is an absolute value, and not the substitution that reStructuredText takes it for."""
    for number, line in enumerate(lines):
        if "\\" not in line:
            lines[number] = re.sub(r"(?<!`)\|([^|`\s][^|`]*)\|(?!`)", r"\\|\1\\|", line)


def _readable(default):
    """A default of an argument as Python writes it, where it is a function, a class or what a factory makes."""
    if default is inspect.Parameter.empty or not (callable(default) or repr(default).startswith("<")):
        return default
    name = getattr(default, "__name__", "<factory>")
    return DefaultValue("..." if name.startswith("<") else name)


def readable_signatures(app, what, name, obj, options, signature, returns):
    """The arguments of a class itself, where its metaclass takes any, and defaults that are no objects in brackets."""
    hidden = what == "class" and signature == "(*args, **kwargs)"
    if hidden and getattr(obj, "_is_protocol", False):
        return "", returns  # nobody makes a protocol
    if what not in ("class", "method", "function") or not (hidden or "<" in (signature or "")):
        return None
    own = inspect.signature(obj.__init__ if what == "class" else obj, bound_method=what != "function")
    own = own.replace(parameters=[p.replace(default=_readable(p.default)) for p in own.parameters.values()])
    return inspect.stringify_signature(own, unqualified_typehints=True, show_return_annotation=False), returns


def setup(app):
    """Sphinx calls this when it has read the settings above."""
    app.connect("autodoc-process-docstring", absolute_values)
    app.connect("autodoc-process-signature", readable_signatures)
