"""Tests. Waiting threads sleep, as they do under the command: see hma_model.cli.main."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
