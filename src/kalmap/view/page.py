"""The bones of a page: one HTML file with everything in it, light and dark, screen and paper.

Every text that comes from outside goes through `text`; what returns HTML says so in its docstring.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from kalmap.view.style import png_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CSS = """
:root { color-scheme: light dark; --ink: #1c2330; --soft: #5b6575; --line: #dfe3ea; --paper: #ffffff;
  --card: #f6f8fb; --accent: #0072b2; --warn: #fff4e0; --warn-line: #e69f00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e7ebf2; --soft: #a2adbd; --line: #323b49;
  --paper: #141a22; --card: #1d2530; --accent: #56b4e9; --warn: #3a2f16; --warn-line: #e69f00; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 15px/1.55 system-ui, "Segoe UI", "Liberation Sans", "DejaVu Sans", sans-serif; }
main { max-width: 1060px; margin: 0 auto; padding: 2.2rem 1.4rem 4rem; }
header { border-bottom: 3px solid var(--accent); padding-bottom: .9rem; margin-bottom: 1.4rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .7rem; }
h3 { font-size: 1rem; margin: 1.4rem 0 .5rem; }
p { margin: .4rem 0 .8rem; max-width: 46rem; }
.soft, figcaption { color: var(--soft); }
.lead { color: var(--soft); margin: 0; overflow-wrap: anywhere; }
nav { font-size: .88rem; margin-top: .6rem; } nav a { color: var(--accent); margin-right: 1.1rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(230px, 1fr)); gap: .8rem; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .8rem 1rem; }
.card .label { font-size: .82rem; color: var(--soft); }
.card .value { font-size: 1.5rem; font-weight: 650; line-height: 1.3; font-variant-numeric: tabular-nums; }
.card .value small { font-size: .85rem; font-weight: 400; color: var(--soft); }
.card .says { font-size: .85rem; }
.warning { background: var(--warn); border-left: 4px solid var(--warn-line); border-radius: 4px;
  padding: .55rem .9rem; margin: .5rem 0; overflow-wrap: anywhere; }
figure { margin: 0 0 1.8rem; }
figure img { display: block; width: 100%; height: auto; background: #fff; border: 1px solid var(--line);
  border-radius: 8px; padding: 6px; }
figcaption { font-size: .9rem; margin-top: .45rem; max-width: 52rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { color: var(--soft); font-weight: 600; white-space: nowrap; }
tbody th { color: var(--ink); font-weight: 500; }
td.n, th.n { text-align: right; white-space: nowrap; }
td.best { font-weight: 700; color: var(--accent); }
td .paper { color: var(--soft); font-weight: 400; }
code, .mono { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .85em;
  overflow-wrap: anywhere; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .8rem 1rem;
  overflow-x: auto; font-size: .82rem; line-height: 1.45; white-space: pre-wrap; overflow-wrap: anywhere; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: .7rem; color: var(--soft);
  font-size: .85rem; }
@media print { :root { color-scheme: light; --ink: #000; --soft: #444; --line: #ccc; --paper: #fff;
    --card: #fff; --accent: #0072b2; --warn: #fff; }
  body { font-size: 10.5pt; } main { padding: 0; max-width: none; } nav { display: none; }
  figure, .card, tr, .warning { break-inside: avoid; } h2, h3 { break-after: avoid; } }
"""


def text(value: Any) -> str:
    """Any value as harmless HTML text."""
    return html.escape(str(value), quote=True)


def page(title: str, lead: str, sections: Sequence[tuple[str, str, str]], foot: str) -> str:
    """A whole HTML document. title, lead, foot: plain text.

    sections: (anchor, heading, body); heading is plain text, body HTML, and empty bodies are left out.
    """
    kept = [section for section in sections if section[2]]
    links = "".join(f'<a href="#{text(anchor)}">{text(heading)}</a>' for anchor, heading, _ in kept)
    bodies = "\n".join(
        f'<section id="{text(anchor)}"><h2>{text(heading)}</h2>\n{body}\n</section>'
        for anchor, heading, body in kept
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n<main>\n"
        f'<header><h1>{text(title)}</h1>\n<p class="lead">{text(lead)}</p>\n<nav>{links}</nav></header>\n'
        f"{bodies}\n<footer>{text(foot)}</footer>\n</main>\n</body>\n</html>\n"
    )


def picture(figure: Figure | bytes, name: str, caption: str) -> str:
    """HTML of a figure, or of a PNG, with the PNG inside it. name is the alternative text."""
    data = base64.b64encode(figure if isinstance(figure, bytes) else png_bytes(figure)).decode()
    image = f'<img alt="{text(name)}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{text(caption)}</figcaption></figure>"


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]], numeric: Sequence[int] = ()) -> str:
    """HTML of a table of plain texts; the columns numbered in `numeric` are set flush right."""
    kinds = [' class="n"' if index in numeric else "" for index in range(len(columns))]
    head = "".join(f"<th{kind}>{text(column)}</th>" for kind, column in zip(kinds, columns, strict=True))
    lines = (
        "<tr>"
        + "".join(f"<td{kind}>{text(cell)}</td>" for kind, cell in zip(kinds, row, strict=True))
        + "</tr>"
        for row in rows
    )
    return framed_table(f"<tr>{head}</tr>", "\n".join(lines))


def framed_table(head: str, body: str) -> str:
    """HTML of a table from HTML rows; a wide one scrolls by itself instead of stretching the page."""
    return f'<div class="scroll"><table><thead>{head}</thead>\n<tbody>{body}</tbody></table></div>'


def cards(items: Iterable[tuple[str, str, str, str]]) -> str:
    """HTML of cards: (label, value, unit, what it says), all plain text."""
    return (
        '<div class="cards">'
        + "".join(
            f'<div class="card"><div class="label">{text(label)}</div>'
            f'<div class="value">{text(value)} <small>{text(unit)}</small></div>'
            f'<div class="says">{text(says)}</div></div>'
            for label, value, unit, says in items
        )
        + "</div>"
    )


def warnings_html(warnings: Iterable[str]) -> str:
    """HTML of warnings, one box each."""
    return "".join(f'<div class="warning">{text(warning)}</div>' for warning in warnings)
