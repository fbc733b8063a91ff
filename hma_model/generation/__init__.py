"""Generate frame after frame from a prompt and actions, with a cache over time.

In come a model, a prompt and actions, out go tokens or latents. Next: `hma_model.evaluation`.
"""
