"""Define the network: one trunk for all embodiments, a stem and a head for each (paper section 3).

In come tokens or latents and actions, out go logits, conditions of the diffusion head, and losses by
objective. Next: `hma_model.checkpoint`.
"""
