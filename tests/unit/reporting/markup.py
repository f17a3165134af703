"""A page taken apart."""

from html.parser import HTMLParser

FETCHED = {"src", "href", "xlink:href", "srcset", "action", "data", "poster"}
VOID = {"meta", "link", "rect", "br"}


class Markup(HTMLParser):
    """Checks that elements nest, and collects what a browser would fetch."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.outside: list[str] = []
        self.anchors: list[str] = []
        self.ids: set[str | None] = set()
        self.headings: list[str] = []
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
        assert tag not in {"script", "iframe", "object", "embed", "img"}

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass  # of an SVG

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)
