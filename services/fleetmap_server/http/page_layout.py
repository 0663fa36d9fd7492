"""What all pages share: the frame, the style, and how figures are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from urllib.parse import urlencode

from fastapi.responses import HTMLResponse

from fleetmap import __version__
from fleetmap_server.http.footprint_figure import STYLE as _ROAD_STYLE
from fleetmap_server.http.html import Child, Html, content_security_policy, document, element

_STYLE = (
    """
:root { color-scheme: light dark; --text: #1d2328; --quiet: #56616b; --page: #fff; --panel: #f6f8f9;
  --line: #d5dbe0; --accent: #0b5fad; --good: #1b7837; --bad: #c02317; --cell: #dbe9d8; --cell-line: #a9c7a2; }
@media (prefers-color-scheme: dark) { :root { --text: #e4e8eb; --quiet: #9aa6b0; --page: #14181b; --panel: #1c2226;
  --line: #39424a; --accent: #6db3f2; --good: #6cc285; --bad: #f28a80; --cell: #24382a; --cell-line: #3c5a44; } }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--text); background: var(--page); max-width: 70rem;
  margin: 0 auto; padding: 0 1rem 3rem; }
header { display: flex; flex-wrap: wrap; gap: .3rem 1.4rem; align-items: baseline; padding: .9rem 0;
  border-bottom: 1px solid var(--line); }
header strong { font-size: 1.15rem; } nav a { margin-right: 1rem; }
a { color: var(--accent); } a[aria-current] { color: inherit; font-weight: 600; text-decoration: none; }
:focus-visible { outline: 3px solid var(--accent); outline-offset: 2px; }
h1 { font-size: 1.6rem; margin: 1.4rem 0 .4rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2rem 0 .4rem; }
.scroll { overflow-x: auto; margin-top: 1rem; }
table { border-collapse: collapse; } caption { text-align: left; color: var(--quiet); padding-bottom: .3rem; }
th, td { text-align: left; padding: .3rem 1.1rem .3rem 0; vertical-align: top;
  border-bottom: 1px solid var(--line); }
thead th { white-space: nowrap; } td.number, th.number { text-align: right; white-space: nowrap; }
td.number { font-variant-numeric: tabular-nums; } time, .keep { white-space: nowrap; }
.good { color: var(--good); font-weight: 600; } .bad { color: var(--bad); font-weight: 600; }
.quiet { color: var(--quiet); } .hash { font-family: ui-monospace, monospace; font-size: .9em; }
pre { background: var(--panel); border: 1px solid var(--line); border-radius: .4rem; padding: .7rem .9rem;
  white-space: pre-wrap; overflow-wrap: anywhere; }
.warnings { border-left: 4px solid var(--bad); padding: .3rem 0 .3rem 1rem; margin: 1rem 0; }
.warnings ul { margin: 0; padding-left: 1.1rem; }
form { display: flex; flex-wrap: wrap; gap: .6rem 1rem; align-items: end; margin: 1rem 0; }
label { display: block; font-size: .9rem; color: var(--quiet); }
input, button { font: inherit; color: inherit; background: var(--panel); border: 1px solid var(--line);
  border-radius: .3rem; padding: .35rem .6rem; } button { cursor: pointer; }
@media print { header a, form, nav { display: none; } body { max-width: none; padding: 0; } a { color: inherit; }
  h2, figure, tr { break-inside: avoid; } h2 { break-after: avoid; } .scroll { overflow: visible; } }
"""
    + _ROAD_STYLE
)

_HEADERS = {
    "Content-Security-Policy": content_security_policy(_STYLE),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
    "Vary": "Accept, Authorization",
}
_PLACES = (("/maps", "Maps"), ("/drives", "Survey drives"), ("/jobs", "Mapping jobs"))


def page(title: str, *body: Child, here: str = "", status: int = 200) -> HTMLResponse:
    """A whole page; ``here`` is the path of the place in the navigation that it belongs to."""
    places = [
        element("a", name, href=path, aria_current="page" if path == here else None) for path, name in _PLACES
    ]
    name = element("strong", element("a", "fleetmap", href="/"))
    head = element("header", name, element("nav", _spaced(places), aria_label="places"))
    foot = element("p", f"fleetmap {__version__}", class_="quiet")
    whole = document(f"{title} - fleetmap", _STYLE, head, element("main", *body), element("footer", foot))
    return HTMLResponse(str(whole), status, _HEADERS)


def next_page(path: str, after: str | None, asked: Mapping[str, str] | None = None) -> Html | None:
    """A link to the page after this one, where there is one; ``asked`` is what this one was asked with."""
    if after is None:
        return None
    link = element("a", "Next page", href=f"{path}?{urlencode({**(asked or {}), 'after': after})}", rel="next")
    return element("nav", link, aria_label="pages")


def table(headings: Sequence[str], rows: Sequence[Sequence[Child]], caption: str = "") -> Html:
    """A table; headings that begin with ``#`` stand over columns of numbers."""
    heads = [
        element("th", name.removeprefix("#"), scope="col", class_="number" if name[:1] == "#" else None)
        for name in headings
    ]
    kinds = ["number" if name[:1] == "#" else None for name in headings]
    body = [
        element("tr", [element("td", cell, class_=kind) for cell, kind in zip(row, kinds, strict=True)])
        for row in rows
    ]
    return element(
        "div",
        element(
            "table",
            element("caption", caption) if caption else None,
            element("thead", element("tr", heads)),
            element("tbody", body),
        ),
        class_="scroll",
        tabindex=0,
        role="region",
        aria_label=caption or ", ".join(name.removeprefix("#") for name in headings if name),
    )


def facts(rows: Sequence[tuple[str, Child]]) -> Html:
    """A table of names and what they are."""
    lines = [element("tr", element("th", name, scope="row"), element("td", value)) for name, value in rows]
    return element("table", element("tbody", lines))


def verdict(fit: bool) -> Html:
    """Whether a map is fit to publish, in words and colour."""
    words, kind = ("fit to publish", "good") if fit else ("not fit to publish", "bad")
    return element("span", words, class_=f"{kind} keep")


def utc(stamp_ns: int | None) -> Html | str:
    """A time to the minute."""
    if stamp_ns is None:
        return "unknown"
    time = datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC)
    return element("time", f"{time:%Y-%m-%d %H:%M} UTC", datetime=f"{time:%Y-%m-%dT%H:%M:%SZ}")


def size(size_bytes: int) -> str:
    """Bytes in the unit that suits them."""
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size_bytes >= unit:
            return f"{size_bytes / unit:.1f} {name}"
    return f"{size_bytes} bytes"


def length(length_m: float | None) -> str:
    """Metres, or kilometres where they are many."""
    if length_m is None:
        return "unknown"
    return f"{length_m / 1000.0:.1f} km" if length_m >= 2000.0 else f"{length_m:.0f} m"


def short_hash(sha256: str) -> Html:
    """The first digits, the whole of it in a tooltip."""
    return element("span", sha256[:12], class_="hash", title=sha256)


def _spaced(items: Sequence[Html]) -> list[Child]:
    return [child for item in items for child in (item, " ")]
