"""Show one table as text, Markdown or HTML, and fill HTML templates.

Cells may hold names out of strangers' files. HTML is escaped by the templates, and in Markdown a cell cannot
leave its column.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from hma_data.console import cell_text, is_numeric, print_table

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

MANY_COLUMNS = 10  # HTML shows wider tables in smaller type


@dataclass(frozen=True)
class Table:
    """Rows of cells below their headings.

    A cell is a text, a number (a Decimal shows all its digits), or None for what is absent. HTML shows the
    second line of a text small.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]

    def print(self, title: str = "") -> None:
        """Print it to standard output below a title; see `print_table`."""
        print_table(self.columns, self.rows, title)

    def markdown(self) -> str:
        """Return it as Markdown; texts may hold markup."""
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        return "\n".join(f"| {' | '.join(_markdown(cell) for cell in line)} |" for line in lines)

    def html(self) -> "Markup":
        """Return it as HTML; columns of numbers are aligned to the right."""
        from markupsafe import Markup

        numeric = [is_numeric([row[column] for row in self.rows]) for column in range(len(self.columns))]
        lines = [[_shown(cell).partition("\n")[::2] for cell in line] for line in (self.columns, *self.rows)]
        dense = len(self.columns) > MANY_COLUMNS
        return Markup(fill("hma_data", "table.html", lines=lines, numeric=numeric, dense=dense))


def fill(package: str, template: str, **values: Any) -> str:
    """Return a template out of a package's folder `templates` with its values, which HTML escapes."""
    return _environment(package).get_template(template).render(values)


@cache
def _environment(package: str) -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader(package),
        autoescape=lambda name: name is not None and name.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _shown(cell: Any) -> str:
    return "–" if cell is None else cell_text(cell, digits=3)


def _markdown(cell: Any) -> str:
    text = " ".join(_shown(cell).split())
    return re.sub(r"(?<!\\)\|", r"\\|", text)  # a bar begins the next column, unless it is escaped already
