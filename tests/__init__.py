"""Tests. Threads wait for one another as they do under the command: see hma_data.threads."""

from hma_data.threads import bound_spinning

bound_spinning()
