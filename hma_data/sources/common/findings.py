"""What a look at a recording or a shard set found, in a form programs can read."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Severity = Literal["error", "warn", "info"]
SEVERITIES: tuple[Severity, ...] = ("info", "warn", "error")


@dataclass(frozen=True)
class Finding:
    """One thing a check found.

    Attributes:
        check: its name, stable for programs.
        severity: error: unusable or wrong; warn: look before training; info: good to know.
        message: what was met, with the numbers.
        remedy: what to do; may be empty.
        key: of the recording it is about; empty where it is about all of it.
        numbers: what the message says, as plain values.
    """

    check: str
    severity: Severity
    message: str
    remedy: str = ""
    key: str = ""
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.message} — {self.remedy}" if self.remedy else self.message
