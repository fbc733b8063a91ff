"""Build a report as one self-contained HTML page: text, tables, pictures and plots in sections.

Pictures are embedded, so that opening the page fetches nothing. The page is readable in light and dark mode.
"""

import base64
from collections.abc import Sequence
from typing import Any

from hma_data.tables import Table, fill


class Page:
    """A page; every method but `html` adds a block to its end.

    Args:
        title: the title of the page.
        lead: a sentence below the title.
    """

    def __init__(self, title: str, lead: str) -> None:
        self._title, self._lead = title, lead
        self._blocks: list[dict[str, Any]] = []

    def figures(self, values: Sequence[tuple[str, str]]) -> None:
        """Add key figures as tiles: (value, description)."""
        self._add("figures", values=values)

    def section(self, title: str, text: str = "") -> None:
        """Add a heading and a paragraph."""
        self._add("section", title=title, text=text)

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._add("text", text=text)

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Add a table; columns of numbers are aligned to the right. A second line of a cell is small."""
        self._add("table", table=Table(columns, rows).html())

    def picture(self, data: bytes, kind: str, caption: str, dark: bytes | None = None) -> None:
        """Add an embedded picture.

        Args:
            data: the file's bytes.
            kind: png, webp or svg+xml; an SVG is a plot and gets a white background.
            caption: the text below it, which is also its alternative text.
            dark: the bytes of the same picture for dark mode.
        """
        self._add(
            "picture",
            source=_data_uri(data, kind),
            dark=None if dark is None else _data_uri(dark, kind),
            plot=kind == "svg+xml",
            caption=caption,
        )

    def definitions(self, pairs: Sequence[tuple[str, str]]) -> None:
        """Add a list of terms with what they mean."""
        self._add("definitions", pairs=pairs)

    def strips(self, title: str, text: str, rows: Sequence[tuple[str, bytes]]) -> None:
        """Add wide WebP pictures below each other, each beside its name."""
        sources = [(name, _data_uri(data, "webp")) for name, data in rows]
        self._add("strips", title=title, text=text, rows=sources)

    def commands(self, text: str) -> None:
        """Add lines for a shell."""
        self._add("commands", text=text.strip())

    def html(self) -> str:
        """Return the whole page."""
        blocks = self._blocks
        return fill("hma_model.evaluation", "page.html", title=self._title, lead=self._lead, blocks=blocks)

    def _add(self, kind: str, **values: Any) -> None:
        self._blocks.append({"kind": kind, **values})


def as_sentence(words: str) -> str:
    """Return words with a capital and a full stop."""
    return f"{words[:1].upper()}{words[1:]}."


def _data_uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
