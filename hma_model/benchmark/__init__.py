"""Measure a checkpoint by a named protocol with fixed seeds: `hma benchmark`."""
