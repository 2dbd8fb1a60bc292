"""Sphinx's settings of the documentation site, which `make site` builds from the pages that the repository shows too.

The source folder is the root of the checkout, so that links between README, docs/ and the other pages lead to pages of
the site.  The reference is read from the sources (sphinx-autoapi): nothing of the package is imported.
"""

from __future__ import annotations

import re
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
_VERSION = re.search(r'^__version__ = "(.+)"', (ROOT / "drocap_ros" / "__init__.py").read_text(), re.MULTILINE)
assert _VERSION, "drocap_ros/__init__.py has no __version__"

project = "drocap_ros"
author = "The drocap_ros authors"
copyright = author
version = release = _VERSION[1]

extensions = ["myst_parser", "sphinx.ext.napoleon", "autoapi.extension", "sphinx_copybutton"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**.md", "autoapi/**.rst"]
exclude_patterns = [".*", "**/.*", "build", "install", "log", "dist"]
myst_heading_anchors = 3  # [text](page.md#heading), as GitHub has it

#: Rooms whose functions and types a script uses; docs/api.md names the first ones.
_REFERENCE = (
    "api motion tracks clip keypoints skeleton contacts config parameters errors pipeline"
    " open_images bringup geometry evaluation export recording reconstruction/methods reconstruction/common report"
)
_PARTS = [path for path in (ROOT / "drocap_ros").rglob("*") if path.is_file() and path.suffix in (".py", ".pyi")]


def _documented(path: Path) -> bool:
    """Whether a file belongs to the reference; a package's own `__init__` stands above its modules."""
    place = path.relative_to(ROOT / "drocap_ros").with_suffix("").as_posix()
    above = place.removesuffix("__init__")
    return any(
        f"{place}/".startswith(f"{name}/") or (above != place and name.startswith(above)) for name in _REFERENCE.split()
    )


autoapi_dirs = [str(ROOT / "drocap_ros")]
autoapi_root = "autoapi"
autoapi_ignore = [str(path) for path in _PARTS if path.suffix == ".pyi" or not _documented(path)]
suppress_warnings = ["autoapi.python_import_resolution"]  # imports of modules that are no part of the reference
autoapi_options = ["members", "show-module-summary"]
autoapi_add_toctree_entry = False
autoapi_keep_files = False
autodoc_typehints = "signature"

html_theme = "furo"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
#: The colours of the report.
html_theme_options = {
    f"{theme}_css_variables": dict.fromkeys(
        ("color-brand-primary", "color-brand-content", "color-brand-visited"), colour
    )
    for theme, colour in (("light", "#0a7d78"), ("dark", "#3fbdb5"))
}
html_title = f"drocap_ros {release}"

#: Places of the pages in the site's menu; those of `figures/` stand below their own index.
MENU = {
    "Use": "tutorial install models telemetry report export batch",
    "Fly": "live station live_out first_flight flight sessions",
    "Look up": "parameters api quality_declaration figures/README",
    "Understand": "reconstruction accuracy",
}


def _toctree(caption: str, pages: list[str]) -> str:
    return "\n".join(["", "```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```", ""])


def add_menu(_: Sphinx, page: str, source: list[str]) -> None:
    """The menu is no part of the pages: a reader of the repository would see its source."""
    if page == root_doc:
        source[0] += _toctree("Start", ["Overview </README>"])
        source[0] += "".join(_toctree(name, pages.split()) for name, pages in MENU.items())
        source[0] += _toctree(
            "Develop", ["/ARCHITECTURE", "/CONTRIBUTING", "/CHANGELOG", "Reference </autoapi/drocap_ros/index>"]
        )
    elif page == "docs/figures/README":
        names = sorted(path.stem for path in (ROOT / "docs" / "figures").glob("*.md") if path.stem != "README")
        source[0] += _toctree("Figures", names)


def _escaped(line: str) -> str:
    """A bar outside of literals is no substitution of reStructuredText."""
    return "``".join(part if i % 2 else part.replace("|", r"\|") for i, part in enumerate(line.split("``")))


def list_fields(_: Sphinx, *event: object) -> None:
    """Lines `name : meaning` of a docstring become a list; in the sources they stand without marks.

    Lines of a section of numpydoc (underlined) are napoleon's.
    """
    lines = event[-1]
    assert isinstance(lines, list)
    out: list[str] = []
    in_section = in_list = False
    for line, below in zip(map(_escaped, lines), [*lines[1:], ""], strict=True):
        in_section |= bool(line.strip()) and re.fullmatch(r"-{3,}", below.strip()) is not None
        field = re.fullmatch(r"([\w.*]+(?:, [\w.*]+)*) : (.+)", line)
        if field and not in_section:
            if not in_list:
                out.append("")
            out.append(f"* ``{field[1]}``: {field[2]}")
            in_list = True
        else:
            in_list = in_list and bool(line.strip())
            out.append(f"  {line.strip()}" if in_list else line)
    lines[:] = out


def add_front_door(app: Sphinx, _: Exception | None) -> None:
    """The first page of a server or folder; the menu's page lies in `docs/`."""
    door = f'<meta http-equiv="refresh" content="0; url={root_doc}.html"><a href="{root_doc}.html">{project}</a>\n'
    (Path(app.outdir) / "index.html").write_text(door, encoding="ascii")


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.add_lexer("mermaid", TextLexer)  # GitHub draws these diagrams; the site shows their source
    app.connect("source-read", add_menu)
    app.connect("autodoc-process-docstring", list_fields, priority=400)  # before napoleon's 500
    app.connect("build-finished", add_front_door)
