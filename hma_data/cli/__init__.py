"""Offer the data verbs of `hma`, one module a verb. Each imports what it needs when it runs."""
