"""Compute statistics of action and state vectors in one pass, in float64; results can be merged.

Count, mean, M2, minimum and maximum merge exactly (Chan, Golub and LeVeque 1979). Quantiles come from a
deterministic compactor sketch (the KLL family), which can be merged too. With k = 256 kept values a level,
its rank error is at most log2(n / 256) / 512 of n, and in practice a tenth of that.

N rows, A values a row.
"""

import base64
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hma_data.arrays import Array, Float32s

QUANTILES = (0.01, 0.05, 0.10, 0.25, 0.50, 0.75, 0.90, 0.95, 0.99)
LEVEL = 256


@dataclass
class QuantileSketch:
    """Samples by level: a value of level i stands for 2**i rows.

    Attributes:
        levels: level -> (m, A) float32.
        odd: level -> which of a pair the next compaction keeps; it alternates to keep the error unbiased.
    """

    levels: list[Float32s] = field(default_factory=list)
    odd: list[int] = field(default_factory=list)

    def add(self, values: Array) -> None:
        """Add rows (N, A)."""
        for start in range(0, len(values), 4 * LEVEL):
            self._extend(0, values[start : start + 4 * LEVEL].astype(np.float32))
            self._compact()

    def merge(self, other: "QuantileSketch") -> None:
        """Add another sketch."""
        for level, values in enumerate(other.levels):
            self._extend(level, values)
        self._compact()

    def _extend(self, level: int, values: Float32s) -> None:
        while len(self.levels) <= level:
            self.levels.append(np.zeros((0, values.shape[1]), np.float32))
            self.odd.append(0)
        self.levels[level] = np.concatenate([self.levels[level], values])

    def _compact(self) -> None:
        level = 0
        while level < len(self.levels):
            values = self.levels[level]
            if len(values) >= 2 * LEVEL:
                values = np.sort(values, axis=0)
                pairs = len(values) // 2 * 2
                self.levels[level] = values[pairs:]
                self._extend(level + 1, values[self.odd[level] : pairs : 2])
                self.odd[level] ^= 1
            level += 1

    def quantile(self, q: float) -> Array:
        """Return (A,) the value below which a fraction q of the rows lies."""
        values = np.concatenate(self.levels)
        weights = np.concatenate([np.full(len(v), 2.0**level) for level, v in enumerate(self.levels)])
        order = np.argsort(values, axis=0, kind="stable")
        # a value stands for the ranks around it
        reach = np.cumsum(weights[order], axis=0) - weights[order] / 2
        index = np.minimum((reach < q * weights.sum()).sum(axis=0), len(values) - 1)
        return np.take_along_axis(values, np.take_along_axis(order, index[None], 0), 0)[0].astype(np.float64)

    def to_json(self) -> dict[str, Any]:
        """Return plain values; the samples are little-endian float32, compressed by zlib, in base64."""
        width = self.levels[0].shape[1] if self.levels else 0
        packed = b"".join(np.ascontiguousarray(v, "<f4").tobytes() for v in self.levels)
        return {
            "width": width,
            "rows": [len(v) for v in self.levels],
            "odd": self.odd,
            "values": base64.b64encode(zlib.compress(packed, 6)).decode(),
        }

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "QuantileSketch":
        """Return the sketch that `to_json` wrote."""
        size = 4 * sum(values["rows"]) * values["width"]
        try:
            packed = zlib.decompressobj().decompress(base64.b64decode(values["values"]), size + 1)
        except zlib.error as fault:
            raise ValueError(f"a sketch cannot be unpacked: {fault}") from fault
        if len(packed) != size:  # no more than size + 1 bytes are ever unpacked
            raise ValueError(f"a sketch of {values['rows']} rows holds other than {size} bytes")
        flat = np.frombuffer(packed, "<f4")
        parts = np.split(flat, np.cumsum([n * values["width"] for n in values["rows"]])[:-1])
        levels: list[Float32s] = [part.reshape(-1, values["width"]).astype(np.float32) for part in parts]
        return cls(levels, list(values["odd"]))


@dataclass
class Stats:
    """Statistics over rows of A values.

    Attributes:
        count: rows seen.
        mean, m2, min, max: (A,) float64; m2 is the sum of squared deviations from the mean.
        sketch: for quantiles.
    """

    count: int
    mean: Array
    m2: Array
    min: Array
    max: Array
    sketch: QuantileSketch = field(default_factory=QuantileSketch)

    @classmethod
    def empty(cls, width: int) -> "Stats":
        """Return the statistics of no rows."""
        return cls(0, np.zeros(width), np.zeros(width), np.full(width, np.inf), np.full(width, -np.inf))

    @classmethod
    def of(cls, values: Array) -> "Stats":
        """Return the statistics of rows (N, A)."""
        rows = np.asarray(values, np.float64)
        if not len(rows):
            return cls.empty(rows.shape[1])
        shifted = rows - rows[0]  # exact for constants, and keeps precision far from zero
        offset = shifted.mean(axis=0)
        sketch = QuantileSketch()
        sketch.add(values)
        spread = ((shifted - offset) ** 2).sum(axis=0)
        return cls(len(rows), rows[0] + offset, spread, rows.min(axis=0), rows.max(axis=0), sketch)

    def merge(self, other: "Stats") -> "Stats":
        """Add other statistics to these, in place, and return these."""
        if not other.count:
            return self
        total = self.count + other.count
        delta = other.mean - self.mean if self.count else np.zeros_like(other.mean)
        base = self.mean if self.count else other.mean
        self.mean = base + delta * (other.count / total)
        self.m2 = self.m2 + other.m2 + delta**2 * (self.count * other.count / total)
        self.min, self.max = np.minimum(self.min, other.min), np.maximum(self.max, other.max)
        self.sketch.merge(other.sketch)
        self.count = total
        return self

    @property
    def std(self) -> Array:
        """Return (A,) the population standard deviation."""
        return np.sqrt(self.m2 / max(self.count, 1))

    def quantile(self, q: float) -> Array:
        """Return (A,) the value below which a fraction q of the rows lies; see QuantileSketch."""
        if not self.count:
            return np.zeros_like(self.mean)
        return np.clip(self.sketch.quantile(q), self.min, self.max)

    def to_json(self) -> dict[str, Any]:
        """Return plain values from which `from_json` makes the same object."""
        numbers = {name: getattr(self, name).tolist() for name in ("mean", "m2")}
        return {"count": self.count, **numbers, **self._range(), "sketch": self.sketch.to_json()}

    def _range(self) -> dict[str, list[float]]:
        if not self.count:
            return {"min": [0.0] * len(self.mean), "max": [0.0] * len(self.mean)}
        return {"min": self.min.tolist(), "max": self.max.tolist()}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Stats":
        """Return the statistics that `to_json` wrote."""
        if not values["count"]:
            return cls.empty(len(values["mean"]))
        numbers = {name: np.array(values[name], np.float64) for name in ("mean", "m2", "min", "max")}
        return cls(values["count"], **numbers, sketch=QuantileSketch.from_json(values["sketch"]))

    def summary(self) -> dict[str, Any]:
        """Return what people and models read: count; mean, std, min, max and quantiles as (A,) lists."""
        return {
            "count": self.count,
            "mean": self.mean.tolist(),
            "std": self.std.tolist(),
            **self._range(),
            "quantiles": {f"q{round(q * 100):02d}": self.quantile(q).tolist() for q in QUANTILES},
        }
