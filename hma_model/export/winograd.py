"""Rewrite 3×3 convolutions of a graph so that they need a quarter of the multiplications.

This is Winograd's F(4×4, 3×3) (Lavin and Gray, arXiv 1509.09308). An image is cut into overlapping tiles of
6×6. Each tile and each kernel is transformed, the channels are multiplied at each of the 36 places, and the
product is transformed to tiles of 4×4. ONNX Runtime has no such kernels for processors. In WebAssembly, where
a thread computes about 20 GFLOP/s, the decoder then takes 0.6 times as long. Results differ in the last bits.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from onnx import ModelProto

TILE = 4  # side of a tile of the output
LEAST = 48  # channels from which it pays
_INPUT = [  # the transform of a tile along one side
    [4, 0, -5, 0, 1, 0],
    [0, -4, -4, 1, 1, 0],
    [0, 4, -4, -1, 1, 0],
    [0, -2, -1, 2, 1, 0],
    [0, 2, -1, -2, 1, 0],
    [0, 4, 0, -5, 0, 1],
]
_KERNEL: list[list[float]] = [
    [1 / 4, 0, 0],
    [-1 / 6, -1 / 6, -1 / 6],
    [-1 / 6, 1 / 6, -1 / 6],
    [1 / 24, 1 / 12, 1 / 6],
    [1 / 24, -1 / 12, 1 / 6],
    [0, 0, 1],
]
_OUTPUT = [[1, 1, 1, 1, 1, 0], [0, 1, -1, 2, -2, 0], [0, 1, 1, 4, 4, 0], [0, 1, -1, 8, -8, 1]]


def rewrite(model: "ModelProto") -> int:
    """Rewrite the convolutions for which it pays, in place; return their number."""
    from onnx import numpy_helper, shape_inference

    graph, inferred = model.graph, shape_inference.infer_shapes(model).graph
    shapes = {one.name: _shape(one) for one in (*inferred.input, *inferred.value_info)}
    shapes |= {one.name: list(one.dims) for one in graph.initializer}
    constants = {
        "winograd_kernel": _both(_KERNEL).reshape(36, 9),
        "winograd_cut": _both(_INPUT).reshape(36, 1, 6, 6),
        "winograd_join": _both(_OUTPUT).transpose(2, 3, 0, 1).reshape(36, 1, TILE, TILE),
    }
    nodes: list[Any] = []
    count = 0
    for node in graph.node:
        taken, kernel = (shapes.get(name, []) for name in [*node.input, "", ""][:2])
        if _suits(node, kernel, taken):
            count += 1
            nodes += _rewritten(node, kernel, taken[2:], f"winograd_{count}_", constants)
        else:
            nodes.append(node)
    del graph.node[:]
    graph.node.extend(nodes)
    graph.initializer.extend(numpy_helper.from_array(values, name) for name, values in constants.items())
    return count


def _rewritten(
    node: Any, kernel: list[int], sides: list[int], own: str, constants: dict[str, Any]
) -> list[Any]:
    """Return what computes a convolution of an image of these sides; `own` begins the names that it adds."""
    from onnx import helper

    nodes: list[Any] = []

    def add(kind: str, name: str, *inputs: str, shape: Sequence[int] = (), **attributes: Any) -> str:
        if shape:
            constants[own + name + "_shape"] = np.array(shape, np.int64)
            inputs = (*inputs, own + name + "_shape")
        nodes.append(helper.make_node(kind, inputs, [own + name], **attributes))
        return own + name

    (out, into), tiles = kernel[:2], [side // TILE for side in sides]
    # Of constants alone: a runtime computes these once, when it loads the graph.
    flat = add(
        "Transpose", "columns", add("Reshape", "rows", node.input[1], shape=[out * into, 9]), perm=[1, 0]
    )
    product = add("MatMul", "transformed", "winograd_kernel", flat)
    weight = add("Reshape", "weight", product, shape=[36, out, into])
    cut = add("Tile", "cut", "winograd_cut", shape=[into, 1, 1, 1])
    join = add("Tile", "join", "winograd_join", shape=[out, 1, 1, 1])

    step: dict[str, Any] = {"strides": [TILE, TILE]}
    image = add("Conv", "tiles", node.input[0], cut, group=into, pads=[1] * 4, kernel_shape=[6, 6], **step)
    image = add("Reshape", "apart", image, shape=[into, 36, tiles[0] * tiles[1]])
    image = add("MatMul", "product", weight, add("Transpose", "places", image, perm=[1, 0, 2]))
    image = add("Transpose", "channels", image, perm=[1, 0, 2])
    image = add("Reshape", "joined", image, shape=[1, out * 36, *tiles])
    inputs, outputs = [image, join, *node.input[2:]], list(node.output)
    nodes.append(
        helper.make_node("ConvTranspose", inputs, outputs, group=out, kernel_shape=[TILE, TILE], **step)
    )
    return nodes


def _both(matrix: Sequence[Sequence[float]]) -> Any:
    """Return the transform (o, o, i, i) of a tile whose rows and columns a matrix (o, i) transforms."""
    return np.einsum("ia,jb->ijab", matrix, matrix).astype(np.float32)


def _suits(node: Any, kernel: list[int], taken: list[int]) -> bool:
    if node.op_type != "Conv" or kernel[2:] != [3, 3] or len(taken) != 4 or kernel[1] < LEAST:
        return False
    stated = {"pads": [0] * 4, "strides": [1, 1], "dilations": [1, 1], "group": 1}
    stated |= {one.name: list(one.ints) or one.i for one in node.attribute}
    plain = stated["pads"] == [1] * 4 and stated["strides"] == stated["dilations"] == [1, 1]
    return plain and stated["group"] == 1 and all(side and side % TILE == 0 for side in taken[2:])


def _shape(value: Any) -> list[int]:
    return [side.dim_value for side in value.type.tensor_type.shape.dim]
