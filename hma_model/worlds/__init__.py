"""Offer a world model: sessions in images and actions, and gymnasium environments of them.

In come a checkpoint, a prompt and actions, out come images.
`hma_model.simulate` registers the environments.
"""
