"""Compute Fréchet distances between sets of features: FID of frames, FVD of videos (Heusel et al. 2017).

Features are summed up batch after batch, in float64, so that no set need be held in memory. The square root
of the product of two covariances is that of a symmetric matrix, so its eigenvalues are real.

N features of D values.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass
class Moments:
    """The count, mean (D,) and sum of outer products of deviations (D, D) of features."""

    count: int = 0
    mean: Floats | None = None
    scatter: Floats | None = None

    def add(self, features: NDArray[np.floating]) -> None:
        """Add features (N, D), as Chan et al. (1979) merge two sets."""
        values = features.astype(np.float64)
        mean = values.mean(axis=0)
        scatter = (values - mean).T @ (values - mean)
        if self.mean is None or self.scatter is None:
            self.count, self.mean, self.scatter = len(values), mean, scatter
            return
        total, apart = self.count + len(values), mean - self.mean
        self.scatter = self.scatter + scatter + np.outer(apart, apart) * (self.count * len(values) / total)
        self.mean = self.mean + apart * (len(values) / total)
        self.count = total

    @property
    def covariance(self) -> Floats:
        """Return the unbiased covariance (D, D)."""
        assert self.scatter is not None
        return self.scatter / (self.count - 1)

    @property
    def needed(self) -> int:
        """Return the least number of features whose covariance can have full rank."""
        assert self.mean is not None
        return len(self.mean) + 1


def frechet_distance(one: Moments, other: Moments) -> float:
    """Return |m1 - m2|² + tr(C1 + C2 - 2 (C1 C2)^½) of two normal distributions."""
    assert one.mean is not None and other.mean is not None
    root = _root(one.covariance)
    product = np.linalg.eigvalsh(root @ other.covariance @ root)
    apart = np.square(one.mean - other.mean).sum()
    traces = np.trace(one.covariance) + np.trace(other.covariance)
    return max(float(apart + traces - 2 * np.sqrt(product.clip(min=0)).sum()), 0.0)


def _root(matrix: Floats) -> Floats:
    """Return the square root of a symmetric matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    root: Floats = (vectors * np.sqrt(values.clip(min=0))) @ vectors.T
    return root
