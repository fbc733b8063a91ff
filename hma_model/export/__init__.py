"""Export a checkpoint as ONNX graphs, with a page that drives them in a browser without a server.

`graphs` states what a graph computes, `files` writes graphs and weights, `starts` takes frames to start from,
`page` copies the page, and `folder` writes everything with a manifest. Nothing here knows a trunk.
"""

from hma_data.errors import MissingDependencyError, install_command


def require_onnx() -> None:
    """Raise MissingDependencyError unless the packages that write ONNX are installed."""
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as fault:
        remedy = install_command("export")
        raise MissingDependencyError("hma export", f"needs {fault.name}", remedy) from fault
