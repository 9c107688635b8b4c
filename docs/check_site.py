"""Whether a built site is whole and stands alone: links lead somewhere, nothing comes from another host.

Run as `python docs/check_site.py build/docs`; it prints what is wrong, and its exit code is 1 then.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

# What a browser fetches by itself, by element and attribute; a plain link (`a`) it follows when asked to.
FETCHED = {
    ("audio", "src"),
    ("embed", "src"),
    ("iframe", "src"),
    ("image", "href"),
    ("img", "src"),
    ("img", "srcset"),
    ("input", "src"),
    ("link", "href"),
    ("object", "data"),
    ("script", "src"),
    ("source", "src"),
    ("source", "srcset"),
    ("track", "src"),
    ("use", "href"),
    ("video", "poster"),
    ("video", "src"),
}
# Links of a page that are addresses of something else, not files.
RELATED = {"canonical", "alternate", "license", "author"}
FOREIGN = re.compile(r"^(?:[a-z][a-z0-9+.-]*:)?//", flags=re.IGNORECASE)
SCHEME = re.compile(r"^[a-z][a-z0-9+.-]*:", flags=re.IGNORECASE)
STYLED = re.compile(r"(?:url\(\s*|@import\s+)['\"]?([^'\")\s;]+)")
# Of scripts: modules and pieces that they load by themselves.
SCRIPTED = re.compile(
    r"(?:\bimport\s*\(|\bimportScripts\s*\(|\bfrom\s|\.src\s*=)\s*['\"`]((?:https?:)?//[^'\"`]+)"
)
INDEX = "searchindex.js"


class Page(HTMLParser):
    """The anchors, the links and what is fetched, of one page."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.anchors = set[str]()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element refers to."""
        given = {name: value for name, value in attrs if value is not None}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and given.get("rel", "") in RELATED:
            return
        for name, value in given.items():
            if (tag, name) in FETCHED:
                each = [part.split()[0] for part in value.split(",")] if name == "srcset" else [value]
                self.fetched.extend(each)
            if name == "style":
                self.fetched.extend(STYLED.findall(value))


def problems(site: Path) -> Iterator[str]:
    """Everything that is wrong with a site, one sentence each."""
    pages = {file: Page(file.read_text(encoding="utf-8")) for file in sorted(site.rglob("*.html"))}
    if site / "index.html" not in pages:
        yield f"{site} has no index.html; build it with make docs."
        return
    if not (site / INDEX).is_file():
        yield f"{site} has no {INDEX}, so its search does not work."
    elif not (site / INDEX).read_text(encoding="utf-8").startswith("Search.setIndex("):
        yield f"{INDEX} is no script that sets the index, so a search from a file does not work."
    for file, page in pages.items():
        name = file.relative_to(site)
        for verb, addresses in (("fetches", page.fetched), ("links to", page.links)):
            for address in addresses:
                if FOREIGN.match(address) or SCHEME.match(address):
                    if verb == "fetches" and FOREIGN.match(address):
                        yield f"{name} fetches {address} from another host."
                    continue
                target, anchor = _target(site, file, address), unquote(urldefrag(address)[1])
                if not target.is_file():
                    yield f"{name} {verb} {address}, which is not there."
                elif anchor and target in pages and anchor not in pages[target].anchors:
                    yield f"{name} {verb} {address}, where there is no such place."
    for pattern, addresses in (("*.css", STYLED), ("*.js", SCRIPTED)):
        for file in sorted(site.rglob(pattern)):
            for address in addresses.findall(file.read_text(encoding="utf-8")):
                if FOREIGN.match(address):
                    yield f"{file.relative_to(site)} fetches {address} from another host."


def _target(site: Path, file: Path, address: str) -> Path:
    """The file that an address on a page means."""
    place = unquote(urldefrag(address)[0].partition("?")[0])
    if not place:
        return file
    target = ((site if place.startswith("/") else file.parent) / place.lstrip("/")).resolve()
    return target / "index.html" if target.is_dir() else target


if __name__ == "__main__":
    wrong = list(problems(Path(sys.argv[1]).resolve()))
    print(*wrong, sep="\n", end="\n" if wrong else "")
    sys.exit(bool(wrong))
