"""Run work units: in this process, in several, or on a cluster. Units and outputs are the same in each."""
