"""Offer the loader under its public name; the code is in `hma_data.loading`."""

from hma_data.loading.dataset import Batch, MixtureDataset, WindowDataset, open_sets

__all__ = ["Batch", "MixtureDataset", "WindowDataset", "open_sets"]
