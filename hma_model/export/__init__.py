"""Export a checkpoint as ONNX graphs, with a page that drives them in a browser without a server.

`graphs` states what a graph computes, `files` writes graphs and weights, `starts` takes frames to start from,
`page` copies the page, and `folder` writes everything with a manifest. Nothing here knows a trunk.
"""
