"""Tests. A thread each, since several workers share the cores; threads wait as they do under the command."""

import os

from hma_data.cpu import bound_spinning

bound_spinning()
os.environ.setdefault("OMP_NUM_THREADS", "1")
