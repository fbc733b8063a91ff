"""Tests. A thread each: several workers of pytest share the cores, and waiting threads sleep."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OMP_NUM_THREADS", "1")
