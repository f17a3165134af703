"""Sphinx: ``make docs`` builds build/docs/index.html. Everything works without a network."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

import ccatp  # noqa: E402 - the checkout's own

project = "ccatp"
author = "The ccatp authors"
release = version = ccatp.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
# Links to files beside the documentation (configs, README), and attributes of one name in several classes.
suppress_warnings = ["myst.xref_missing", "ref.python"]
exclude_patterns = []
html_theme = "furo"
man_pages = [("commands", "ccatp", "survey telescope mirrors with a laser-tracked robot", [author], 1)]
html_title = f"ccatp {release}"
html_copy_source = False
html_static_path = []
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_use_ivar = True
napoleon_google_docstring, napoleon_numpy_docstring = True, False
add_module_names = False
nitpicky = False

# Docstrings are plain text with ``literals`` and lists; what else looks like reStructuredText in them is mathematics.
_LITERAL = re.compile(r"(``[^`]+``)")
_MARKUP = re.compile(r"([|\\]|\*(?!\s)|(?<!^)(?<!^ )(?<!^  )\*|(?<=\w)_(?!\w))")
_SECTION = re.compile(r"(Args|Attributes|Returns|Raises|Yields):$")
_BULLET, _LETTER = re.compile(r"[*-] "), re.compile(r"^([a-z])\. ")


def _as_text(_app, _what, _name, _object, _options, lines):
    """Plain text as markup: formulae as they stand, lists as lists, and nothing else that is special."""
    end = next((i for i, line in enumerate(lines) if _SECTION.match(line)), len(lines))
    found, paragraph, is_literal = [], [], False
    for line in [*lines[:end], ""]:
        if line:
            paragraph.append(line)
            continue
        found += [*_shown(paragraph, is_literal), ""]
        is_literal = bool(paragraph) and paragraph[-1].endswith("::")
        paragraph = []
    lines[:] = [*found, *map(_escaped, lines[end:])]


def _shown(paragraph, is_literal):
    if not paragraph or is_literal or paragraph[0].startswith("    "):
        return paragraph if is_literal or not paragraph else ["::", "", *paragraph]
    if any(_LETTER.match(line) for line in paragraph):
        paragraph = [_LETTER.sub(r"*  (\1) ", line) for line in paragraph]
    is_list = any(_BULLET.match(line) for line in paragraph)
    if not is_list and any(line.startswith("  ") for line in paragraph):
        return ["::", "", *(f"    {line}" for line in paragraph)]
    return [_escaped(line) for line in paragraph]


def _escaped(line):
    parts = _LITERAL.split(line)
    return "".join(part if i % 2 else _MARKUP.sub(r"\\\1", part) for i, part in enumerate(parts))


def _more_pages(app, docname, source):
    """Pages that the index does not name come at its end, so that none is lost."""
    if docname != "index":
        return
    named = set(re.findall(r"^([\w/]+)$", source[0], re.MULTILINE))
    paths = (path.relative_to(app.srcdir) for path in Path(app.srcdir).rglob("*.md"))
    here = {path.with_suffix("").as_posix() for path in paths} - {"index"}
    if more := sorted(here - named):
        source[0] += "\n```{toctree}\n:caption: More\n:maxdepth: 1\n\n" + "\n".join(more) + "\n```\n"


def _skip_member(_app, _what, _name, member, skip, _options):
    """Fields of named tuples say nothing of their own: their class has described them."""
    return True if str(getattr(member, "__doc__", "")).startswith("Alias for field number") else skip


def setup(app):
    """Hook both in; napoleon has made its sections by the time the first one runs."""
    app.connect("autodoc-process-docstring", _as_text, priority=400)
    app.connect("autodoc-skip-member", _skip_member)
    app.connect("source-read", _more_pages)
