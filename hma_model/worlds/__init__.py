"""Drive a world model: sessions in pictures and commands, and gymnasium environments of them.

In come a checkpoint, a prompt and commands, out come pictures.
`hma_model.simulate` registers the environments.
"""
