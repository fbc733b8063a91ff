"""Define a finding: one result of a check on a recording or a shard set, readable by programs."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Severity = Literal["error", "warn", "info"]
SEVERITIES: tuple[Severity, ...] = ("info", "warn", "error")


@dataclass(frozen=True)
class Finding:
    """One result of a check.

    Attributes:
        check: its name, stable for programs.
        severity: error: unusable or wrong; warn: look before training; info: good to know.
        message: what was found, with the numbers.
        remedy: what to do; may be empty.
        key: the key of the recording that is affected; empty where the finding is about all of it.
        numbers: the numbers in the message, as plain values.
    """

    check: str
    severity: Severity
    message: str
    remedy: str = ""
    key: str = ""
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.message} — {self.remedy}" if self.remedy else self.message
