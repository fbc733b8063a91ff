"""Save and load models: a trunk, and a stem and a head for each embodiment (DESIGN section 9).

In goes a model, out comes a folder, which is also the layout of the hub. Next: `hma_model.generation`.
"""
