"""How work units are run: here, in processes, on a cluster. The units and their outputs are the same."""
