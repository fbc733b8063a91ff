"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings, beside the checkout or named by HMA_REAL_DATA."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("HMA_REAL_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set HMA_REAL_DATA to their folder")
    return folder
