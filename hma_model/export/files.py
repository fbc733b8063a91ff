"""Write graphs as ONNX files, with their weights in float16 where these lose nothing.

The runtime computes in float32: a weight stored as float16 is followed by a cast, which it computes once when
it loads the graph. `rounded` rounds the weights of a model before the export, so that the files lose nothing.
"""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from hma_data.storage.files import atomic_path, file_sha256
from hma_model.export.graphs import Port, example
from hma_model.export.winograd import rewrite

if TYPE_CHECKING:
    from onnx import ModelProto

OPSET = 20  # of ONNX: the first with Gelu; runtimes of 2024 and later know it
SMALL = 64  # values of a tensor that stays float32


def rounded[M: nn.Module](module: M) -> M:
    """Round the weights of a module to float16, in place; statistics of actions stay."""
    with torch.no_grad():
        for parameter in module.parameters():
            if parameter.numel() >= SMALL:
                parameter.copy_(parameter.half())
    return module


def write_graph(
    path: Path, graph: nn.Module, inputs: Sequence[Port], outputs: Sequence[str]
) -> dict[str, Any]:
    """Write a graph, and return its file's facts: name, bytes and digest."""
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            graph,
            tuple(example(inputs)),
            dynamo=True,
            opset_version=OPSET,
            input_names=[port.name for port in inputs],
            output_names=list(outputs),
            verbose=False,
        )
    assert program is not None
    made = program.model_proto
    _strip(made)
    _pad(made)
    _halve(made)
    with atomic_path(path) as part:
        part.write_bytes(made.SerializeToString())
    return facts(path)


def write_part(
    whole: Path, path: Path, inputs: Sequence[str], outputs: Sequence[str], *, winograd: bool = False
) -> dict[str, Any]:
    """Write the part of a graph that computes some outputs from some inputs, and return its file's facts.

    Args:
        winograd: see `hma_model.export.winograd`.
    """
    from onnx import load
    from onnx.utils import Extractor

    made = Extractor(load(whole)).extract_model(list(inputs), list(outputs))
    if winograd:
        rewrite(made)
    with atomic_path(path) as part:
        part.write_bytes(made.SerializeToString())
    return facts(path)


def facts(path: Path) -> dict[str, Any]:
    """Return name, bytes and SHA-256 of a file."""
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": file_sha256(path)}


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporter's remarks about its own work from the terminal."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _strip(model: "ModelProto") -> None:
    """Remove what the exporter notes of this machine's source files, a quarter of a small graph."""
    graph = model.graph
    del graph.value_info[:]
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.initializer):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")


def _pad(model: "ModelProto") -> None:
    """Pad the inputs of convolutions to a multiple of four channels.

    onnxruntime-web 1.30 computes others wrongly on WebGPU, if their kernel is larger than a pixel.
    """
    from onnx import helper, numpy_helper

    weights = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    nodes: list[Any] = []
    added: dict[str, Any] = {}
    for number, node in enumerate(model.graph.node):
        kernel = weights.get(node.input[1]) if node.op_type == "Conv" else None
        missing = 0 if kernel is None else -kernel.shape[1] % 4
        grouped = any(one.name == "group" and one.i > 1 for one in node.attribute)
        if kernel is not None and missing and not grouped and max(kernel.shape[2:]) > 1:
            sides = kernel.ndim - 2
            padded = np.pad(kernel, ((0, 0), (0, missing), *[(0, 0)] * sides))
            ends = np.array([0] * (kernel.ndim + 1) + [missing] + [0] * sides)
            weight, pads, channels = f"{node.input[1]}_padded", f"pads_{number}", f"padded_{number}"
            added |= {weight: padded, pads: ends}  # convolutions may share a weight
            nodes.append(helper.make_node("Pad", [node.input[0], pads], [channels]))
            node.input[0], node.input[1] = channels, weight
        nodes.append(node)
    used = {name for node in nodes for name in node.input}
    kept = [tensor for tensor in model.graph.initializer if tensor.name in used]
    kept += [numpy_helper.from_array(values, name) for name, values in added.items()]
    del model.graph.initializer[:]
    model.graph.initializer.extend(kept)
    del model.graph.node[:]
    model.graph.node.extend(nodes)


def _halve(model: "ModelProto") -> None:
    """Store each weight as float16 that float16 holds exactly, with a cast behind it."""
    from onnx import TensorProto, helper, numpy_helper

    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type != TensorProto.FLOAT:
            continue
        values = numpy_helper.to_array(tensor)
        with np.errstate(over="ignore"):
            half = values.astype(np.float16)
        if values.size < SMALL or not np.array_equal(half.astype(np.float32), values):
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(half, f"{name}_half"))
        casts.append(helper.make_node("Cast", [f"{name}_half"], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
