"""Build a report as one self-contained HTML page: text, tables, pictures and plots in sections.

Pictures are embedded, so opening the page fetches nothing. The page is readable in light and dark mode.
"""

import base64
import html
from collections.abc import Sequence
from typing import Any

_STYLE = """
:root { --ink:#1d2430; --soft:#5b6675; --paper:#ffffff; --card:#f5f7fa; --line:#d9dfe7; --accent:#0072b2 }
@media (prefers-color-scheme: dark) {
  :root { --ink:#e6eaf0; --soft:#9aa6b5; --paper:#12161c; --card:#1b212a; --line:#323b48; --accent:#56b4e9 }
}
* { box-sizing:border-box }
body { margin:0 auto; max-width:1080px; padding:2rem 1.25rem 4rem; background:var(--paper);
  color:var(--ink); font:16px/1.55 system-ui, sans-serif }
h1 { font-size:1.9rem; margin:0 0 .3rem } h2 { font-size:1.25rem; margin:2.6rem 0 .4rem }
p { max-width:48rem } .soft, figcaption, th { color:var(--soft) } a { color:var(--accent) }
.figures { display:grid; grid-template-columns:repeat(auto-fit, minmax(160px, 1fr)); gap:.75rem;
  margin:1.4rem 0 }
.figures div { background:var(--card); border:1px solid var(--line); border-radius:10px;
  padding:.7rem .9rem }
.figures b { display:block; font-size:1.3rem; white-space:nowrap; font-variant-numeric:tabular-nums }
.figures span { color:var(--soft); font-size:.86rem }
.scroll { overflow-x:auto }
table { border-collapse:collapse; margin:.6rem 0; font-variant-numeric:tabular-nums }
th, td { text-align:left; padding:.34rem .9rem .34rem 0; border-bottom:1px solid var(--line);
  white-space:nowrap }
td.n, th.n { text-align:right } th { font-weight:600; font-size:.86rem }
figure { margin:1rem 0 } figcaption { font-size:.9rem; margin-top:.3rem; max-width:48rem }
img { max-width:100%; height:auto; border-radius:8px; border:1px solid var(--line) }
.plot img { background:#fff; padding:.5rem } img.pixels { image-rendering:pixelated }
pre { background:var(--card); border:1px solid var(--line); border-radius:10px; padding:.8rem 1rem;
  overflow-x:auto; font:13.5px/1.5 ui-monospace, monospace }
"""


class Page:
    """A page; every method but `html` adds to its end.

    Args:
        title: the title of the page.
        lead: a sentence below the title.
    """

    def __init__(self, title: str, lead: str) -> None:
        self._title = title
        self._parts = [f"<h1>{_text(title)}</h1><p class=soft>{_text(lead)}</p>"]

    def figures(self, values: Sequence[tuple[str, str]]) -> None:
        """Add key figures as tiles: (value, description)."""
        tiles = "".join(
            f"<div><b>{_text(value)}</b><span>{_text(name)}</span></div>" for value, name in values
        )
        self._parts.append(f"<div class=figures>{tiles}</div>")

    def section(self, title: str, text: str = "") -> None:
        """Add a heading and a paragraph."""
        self._parts.append(f"<h2>{_text(title)}</h2>" + (f"<p>{_text(text)}</p>" if text else ""))

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Add a table; columns of numbers are aligned to the right."""
        right = [all(isinstance(row[i], int | float) for row in rows) for i in range(len(columns))]
        head = "".join(
            f"<th{' class=n' * r}>{_text(name)}</th>" for name, r in zip(columns, right, strict=True)
        )
        body = "".join(
            "<tr>"
            + "".join(f"<td{' class=n' * r}>{_cell(v)}</td>" for v, r in zip(row, right, strict=True))
            + "</tr>"
            for row in rows
        )
        self._parts.append(f"<div class=scroll><table><tr>{head}</tr>{body}</table></div>")

    def picture(
        self, data: bytes, kind: str, caption: str, *, plot: bool = False, pixels: bool = False
    ) -> None:
        """Add an embedded picture.

        Args:
            data: the file's bytes.
            kind: png, webp or svg+xml.
            caption: the text below it, which is also its alternative text.
            plot: the picture needs a white background.
            pixels: keep its pixels sharp.
        """
        source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
        style = " class=pixels" if pixels else ""
        words = html.escape(caption, quote=True)
        self._parts.append(
            f'<figure{" class=plot" * plot}><img{style} src="{source}" alt="{words}">'
            f"<figcaption>{_text(caption)}</figcaption></figure>"
        )

    def commands(self, text: str) -> None:
        """Add lines for a shell."""
        self._parts.append(f"<pre>{_text(text.strip())}</pre>")

    def html(self) -> str:
        """Return the whole page."""
        head = (
            "<meta charset=utf-8>"
            '<meta name=viewport content="width=device-width, initial-scale=1">'
            f"<title>{_text(self._title)}</title><style>{_STYLE}</style>"
        )
        body = "".join(self._parts)
        return f"<!doctype html><html lang=en><head>{head}</head><body>{body}</body></html>\n"


def _text(value: str) -> str:
    return html.escape(value, quote=False)


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else _text(str(value))
