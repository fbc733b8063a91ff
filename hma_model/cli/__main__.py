"""Run `python -m hma_model.cli` as the command `hma`."""

import sys

from hma_model.cli import main

sys.exit(main())
