"""Format values for the hub's model and data cards: licences, and text that cannot become markup.

Cards may come from untrusted authors, so every value becomes one plain line before it enters a page.
"""

import re
from collections.abc import Iterable
from typing import Any

# The identifiers that the hub accepts in a card's front matter; it refuses any other.
LICENCES = frozenset(
    [
        "apache-2.0",
        "mit",
        "cc0-1.0",
        "cc-by-2.0",
        "cc-by-2.5",
        "cc-by-3.0",
        "cc-by-4.0",
        "cc-by-sa-3.0",
        "cc-by-sa-4.0",
        "cc-by-nc-2.0",
        "cc-by-nc-3.0",
        "cc-by-nc-4.0",
        "cc-by-nd-4.0",
        "cc-by-nc-nd-3.0",
        "cc-by-nc-nd-4.0",
        "cc-by-nc-sa-2.0",
        "cc-by-nc-sa-3.0",
        "cc-by-nc-sa-4.0",
        "cdla-permissive-1.0",
        "cdla-permissive-2.0",
        "cdla-sharing-1.0",
        "odc-by",
        "odbl",
        "pddl",
        "bsd",
        "bsd-2-clause",
        "bsd-3-clause",
        "isc",
        "gpl",
        "gpl-2.0",
        "gpl-3.0",
        "lgpl",
        "lgpl-2.1",
        "lgpl-3.0",
        "agpl-3.0",
        "mpl-2.0",
        "epl-2.0",
        "eupl-1.2",
        "unlicense",
        "wtfpl",
        "zlib",
        "bsl-1.0",
        "ecl-2.0",
        "artistic-2.0",
        "openrail",
        "creativeml-openrail-m",
    ]
)


def licence(stated: Iterable[Any]) -> dict[str, str]:
    """Return the licence fields of the front matter; empty if the embodiments state no licence."""
    names = sorted({line(value) for value in stated} - {"", "unknown"})
    if not names:
        return {}
    if len(names) == 1 and names[0].lower() in LICENCES:
        return {"license": names[0].lower()}
    shown = re.sub(r"[^a-z0-9.+-]+", "-", names[0].lower()).strip("-")[:60] if len(names) == 1 else "several"
    return {"license": "other", "license_name": shown or "stated-below"}


def line(value: Any) -> str:
    """Return a value as one line that cannot leave its cell, become markup or change the text direction."""
    text = "".join(c if c.isprintable() else " " for c in str("" if value is None else value))
    text = " ".join(text.split())[:200]
    if re.fullmatch(r"[\w.-]*", text, re.ASCII):
        return text
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"([|`\[\]\\*_~!#(){}$])", r"\\\1", text)
    return re.sub(r"(?i)(\w)(://|@)", r"\1&#8203;\2", text)  # prevents automatic links


def number(value: Any) -> str:
    """Return a float with four digits, or any other value as `line` does."""
    return f"{value:.4g}" if isinstance(value, float) else line(value)
