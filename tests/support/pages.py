"""Pages of a report: one taken apart, and figures that are only drawn for a test that looks at them."""

from html.parser import HTMLParser

import pytest

import ccatp.report.html as pictures

FETCHED = {"src", "href", "xlink:href", "srcset", "action", "data", "poster"}
VOID = {"meta", "link", "rect", "br"}


class Markup(HTMLParser):
    """Checks that elements nest, and collects what a browser would fetch."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.outside: list[str] = []
        self.anchors: list[str] = []
        self.scripts: list[str] = []
        self.ids: set[str | None] = set()
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name in FETCHED and not (value or "").startswith(("#", "data:")):
                self.outside.append(f"{tag} {name}={value}")
            if name == "id":
                assert value not in self.ids
                self.ids.add(value)
                if tag == "section":
                    self.anchors.append(value or "")
            assert not name.startswith("on"), f"a script: {name}"
        assert tag not in {"iframe", "object", "embed", "img"}
        if tag == "script":
            assert attrs == []
            self.scripts.append("")

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass  # of an SVG

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


@pytest.fixture
def drawn() -> None:
    """For a test that looks at the pictures of a page."""


@pytest.fixture(autouse=True)
def undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests make each figure, but do not draw it, which takes seconds for a page."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(pictures, "svg_of", lambda *_: "<svg></svg>")
        monkeypatch.setattr(pictures, "save_figure", lambda _figure, path, *_: path.touch())
