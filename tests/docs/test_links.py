"""Links of the documentation: each page, heading and file that is named exists."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tools.generated_docs import DOCS, ROOT

BESIDE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "packaging/onboard/README.md")
PAGES = [*sorted(DOCS.rglob("*.md")), *(ROOT / name for name in BESIDE)]
HOME = re.compile(r"https://(?:github|raw\.githubusercontent)\.com/ccatobs/ccatp/(?:(?:blob|tree)/)?main/")
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)|^\[[^\]]+\]:\s*(\S+)", re.MULTILINE)
LABEL = re.compile(r"(?<![\]!\w])\[([^\]\n]+)\](?![(:\[])")
HEADING = re.compile(r"^#+ +(.*?)\s*$", re.MULTILINE)
# A path in backticks, from the root of the checkout or from ccatp/: `ccatp/core.py`, `survey/`, `configs/*.toml`.
QUOTED = re.compile(r"`([\w.-]+/(?:[\w/.*-]*(?:/|\.\w+))?)`")
# A page that a file names in its text: docs/alarms.md, docs/measurements/slam.md.
NAMED = re.compile(r"\bdocs/[\w/]+\.(?:md|png|csv)\b")


def prose(path: Path) -> str:
    return FENCED.sub("", path.read_text(encoding="utf-8"))


def anchors(path: Path) -> set[str]:
    """Fragments of the headings of a page, as GitHub and MyST make them."""
    plain = (re.sub(r"[^\w\s-]", "", title.lower()) for title in HEADING.findall(prose(path)))
    return {re.sub(r"\s", "-", title) for title in plain}


def dead_links(page: Path, text: str) -> Iterator[str]:
    """Links of a page to a file or heading that does not exist; links to other sites are not checked."""
    for inline, reference in LINK.findall(text):
        link = inline or reference
        if HOME.match(link):
            path = ROOT / HOME.sub("", link)
        elif re.match(r"\w+:", link):
            continue
        else:
            path = page.parent / link if not link.startswith("#") else Path(f"{page}{link}")
        target, _, fragment = str(path).partition("#")
        if not Path(target).exists() or (fragment and fragment not in anchors(Path(target))):
            yield link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_each_link_of_a_page_leads_to_a_file_or_heading(page: Path) -> None:
    assert not list(dead_links(page, prose(page)))


@pytest.mark.parametrize(
    ("text", "dead"),
    [
        ("[a](no_page.md)", ["no_page.md"]),
        ("[a](alarms.md#no-heading)", ["alarms.md#no-heading"]),
        ("[a](#no-heading)", ["#no-heading"]),
        ("![a](no_picture.png)", ["no_picture.png"]),
        ("[a]: https://github.com/ccatobs/ccatp/blob/main/docs/no_page.md", 1),
        ("[a](alarms.md), [b](protocols.md#axes), [c](measurements/slam.md), [d](https://example.org/none)", []),
    ],
)
def test_a_dead_link_is_found(text: str, dead: list[str] | int) -> None:
    found = list(dead_links(DOCS / "index.md", text))
    assert found == dead if isinstance(dead, list) else len(found) == dead


def test_each_label_of_the_readme_has_its_address() -> None:
    text = prose(ROOT / "README.md")
    defined = set(re.findall(r"^\[([^\]]+)\]: ", text, re.MULTILINE))
    assert {label.replace("\n", " ") for label in LABEL.findall(text)} == defined


def test_files_and_folders_in_backticks_exist() -> None:
    """A path counts if its first folder is one of the checkout or of the package; others are files of a run."""
    folders = {path.name for base in (ROOT / "ccatp", ROOT) for path in base.iterdir() if path.is_dir()}
    folders -= {"build", "runs"}  # of what programs write
    missing = [
        f"{page.relative_to(ROOT)}: {name}"
        for page in PAGES
        if page.name != "CHANGELOG.md"  # of former versions, too
        for name in QUOTED.findall(prose(page))
        if name.partition("/")[0] in folders and not any(list(base.glob(name)) for base in (ROOT, ROOT / "ccatp"))
    ]
    assert not missing


def test_pages_that_other_files_name_exist() -> None:
    kinds = (".py", ".toml", ".js", ".css", ".html", ".md", ".service", ".yml", ".yaml", ".json")
    folders = [ROOT / name for name in ("ccatp", "configs", "docs", "packaging", "tests", "tools")]
    files = [path for folder in folders for path in folder.rglob("*") if path.suffix in kinds]
    missing = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in (*files, ROOT / "Makefile", *(ROOT / name for name in BESIDE))
        if path != Path(__file__)
        for name in NAMED.findall(path.read_text(encoding="utf-8"))
        if not (ROOT / name).exists()
    ]
    assert not missing
