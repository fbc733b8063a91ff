"""Make episodes with a model: generated ones, and film whose actions it infers."""
