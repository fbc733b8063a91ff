"""Let policies act in a world model and in simulators, and compare what came of both."""
