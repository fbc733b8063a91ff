"""Run work units: in this process, in several, or on a Ray cluster. Units and outputs are the same."""
