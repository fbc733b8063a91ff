"""Export a checkpoint as ONNX graphs.

`graphs` states what a graph computes, `files` writes graphs and weights, `folder` writes everything that a
reader of the folder needs: graphs, prompts and manifest. Nothing here knows a trunk.
"""
