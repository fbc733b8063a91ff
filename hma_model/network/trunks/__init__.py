"""Define the trunks: what each embodiment shares, from embedded frames and actions to features of the frames.

`contract` states what a trunk takes and gives; `transformer` is the paper's. In come frames, their times and
the conditioning by actions, out go features. Next: `hma_model.network.network`, which holds one of them.
"""
