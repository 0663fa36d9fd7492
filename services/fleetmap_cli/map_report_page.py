"""The report as one HTML page that needs nothing else: no script, no font, no picture from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from fleetmap.files import write_text_atomically
from fleetmap.manifest import WeakStretch
from fleetmap_cli.map_report import MapReport, summary
from fleetmap_cli.map_report_picture import draw_report

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1240px; margin: 2em auto; padding: 0 1em; }
h1 { margin: 0 0 .3em; } h2 { margin: 1.6em 0 .4em; font-size: 1.2em; }
.verdict { display: inline-block; padding: .2em .8em; border-radius: .3em; color: #fff; font-weight: 600; }
.good { background: #1b7837; } .bad { background: #d7301f; }
table { border-collapse: collapse; } th, td { text-align: left; padding: .25em .9em .25em 0; vertical-align: top; }
tr { border-bottom: 1px solid #ddd; } th { font-weight: 600; white-space: nowrap; }
td.number { text-align: right; white-space: nowrap; } img { width: 100%; height: auto; } .note { color: #555; }
"""
_NOTE = (
    "Uncertainties are 1 sigma and come from the final joint adjustment of images and fixes. What all fixes of "
    "the drive err by together, such as the slow bias of one receiver, is not in them: one drive cannot see it. "
    "How large that may be, the receiver's own claim tells."
)


def write_report(report: MapReport, folder: Path) -> list[Path]:
    """Write page and picture into a folder, made where there is none; older ones are replaced.

    Raises:
        StorageError: the disk is full or refuses.
    """
    written, picture = folder / "report.html", folder / "report.png"
    draw_report(report, picture)
    write_text_atomically(written, page(report, picture.read_bytes()))
    return [written, picture]


def page(report: MapReport, picture_png: bytes) -> str:
    """The whole page."""
    manifest, quality = report.manifest, report.manifest.quality
    title = f"Map {escape(manifest.map_id)}"
    verdict = ("good", "fit to publish") if quality.publishable else ("bad", "not fit to publish")
    image = base64.b64encode(picture_png).decode("ascii")
    blocks = [
        f"<h1>{title}</h1>",
        f'<p><span class="verdict {verdict[0]}">{verdict[1]}</span></p>',
        _list((*quality.warnings, *quality.remarks)),
        f'<p><img alt="The road from above and the figures along it" src="data:image/png;base64,{image}"></p>',
        "<h2>Figures</h2>",
        _table([(escape(label), escape(text)) for label, text in summary(report) if _is_figure(label)]),
        f'<p class="note">{_NOTE}</p>',
        "<h2>Weak stretches</h2>",
        _stretches(quality.weak_stretches) if quality.weak_length_m is not None else "<p>Unknown.</p>",
        "<h2>Limits the map was judged by</h2>",
        _limits(report.limits),
    ]
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n" + "\n".join(blocks) + "\n</body>\n</html>\n"
    )


def _is_figure(label: str) -> bool:
    """Verdict, warnings and the single stretches have places of their own on the page."""
    return label not in ("verdict", "warning", "remark") and not label.startswith(" ")


def _list(texts: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>" if texts else ""


def _table(rows: Iterable[tuple[str, str]]) -> str:
    return "<table>" + "".join(f"<tr><th>{label}</th><td>{text}</td></tr>" for label, text in rows) + "</table>"


def _stretches(stretches: Sequence[WeakStretch]) -> str:
    if not stretches:
        return "<p>None.</p>"
    heads = "".join(f"<th>{head}</th>" for head in ("", "from (m)", "to (m)", "latitude, longitude", "why"))
    return f"<table><tr>{heads}</tr>{''.join(map(_stretch_row, range(1, len(stretches) + 1), stretches))}</table>"


def _stretch_row(number: int, stretch: WeakStretch) -> str:
    ends = " to<br>".join(f"{lat:.6f}, {lon:.6f}" for lon, lat in (stretch.start_lonlat, stretch.end_lonlat))
    reasons = "<br>".join(escape(reason.text) for reason in stretch.reasons)
    return (
        f'<tr><th>{number}</th><td class="number">{stretch.from_m:.1f}</td>'
        f'<td class="number">{stretch.to_m:.1f}</td><td>{ends}</td><td>{reasons}</td></tr>'
    )


def _limits(limits: dict[str, float]) -> str:
    if not limits:
        return "<p>The map does not say.</p>"
    rows = "".join(
        f'<tr><th>{escape(name)}</th><td class="number">{value:g}</td></tr>' for name, value in limits.items()
    )
    return f"<table>{rows}</table>"
