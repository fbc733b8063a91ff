"""Convolutions that are rewritten or padded before a graph is written compute the same."""

from itertools import pairwise

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper, numpy_helper

from hma_model.export.files import _pad
from hma_model.export.winograd import rewrite


def model_of(
    kernel: np.ndarray, sides: tuple[int, int], *, bias: bool = True, **given: object
) -> onnx.ModelProto:
    helper = onnx.helper
    inputs = ["image", "kernel", *["bias"] * bias]
    weights = {"kernel": kernel, "bias": np.linspace(-1, 1, len(kernel), dtype=np.float32)}
    node = helper.make_node("Conv", inputs, ["out"], **({"pads": [1] * 4} | given))
    shape = [1, kernel.shape[1] * int(str(given.get("group", 1))), *sides]
    graph = helper.make_graph(
        [node],
        "one",
        [helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("out", onnx.TensorProto.FLOAT, [None] * 4)],
        [onnx.numpy_helper.from_array(weights[name], name) for name in inputs[1:]],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)


def run(model: onnx.ModelProto, image: np.ndarray) -> np.ndarray:
    return ort.InferenceSession(model.SerializeToString()).run(None, {"image": image})[0]


@pytest.mark.parametrize(("out", "into", "sides", "bias"), [(64, 48, (16, 24), True), (5, 80, (4, 4), False)])
def test_a_rewritten_convolution_gives_the_same(out, into, sides, bias) -> None:
    rng = np.random.default_rng(0)
    image = rng.normal(size=(1, into, *sides)).astype(np.float32)
    model = model_of(rng.normal(size=(out, into, 3, 3)).astype(np.float32), sides, bias=bias)
    expected = run(model, image)
    assert rewrite(model) == 1
    onnx.checker.check_model(model)
    assert "Conv" not in [node.op_type for node in model.graph.node if "winograd" not in node.output[0]]
    np.testing.assert_allclose(run(model, image), expected, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("kernel", "sides", "given"),
    [
        ((64, 48, 1, 1), (16, 16), {"pads": [0] * 4}),
        ((64, 16, 3, 3), (16, 16), {}),  # too few channels
        ((64, 48, 3, 3), (16, 18), {}),  # no whole tiles
        ((64, 48, 3, 3), (16, 16), {"pads": [0] * 4}),
        ((64, 48, 3, 3), (16, 16), {"strides": [2, 2]}),
        ((64, 48, 3, 3), (16, 16), {"dilations": [2, 2], "pads": [2] * 4}),
        ((64, 48, 3, 3), (16, 16), {"group": 2}),
    ],
)
def test_other_convolutions_stay(kernel, sides, given) -> None:
    model = model_of(np.ones(kernel, np.float32), sides, **given)
    before = [node.SerializeToString() for node in model.graph.node]
    assert rewrite(model) == 0
    assert [node.SerializeToString() for node in model.graph.node] == before


# -- padding


DRAW = np.random.default_rng(0)
KERNEL = DRAW.normal(size=(6, 6, 3, 3)).astype(np.float32)
IMAGE = DRAW.normal(size=(1, 6, 8, 8)).astype(np.float32)


def graph(kernel: np.ndarray, group: int = 1, times: int = 2) -> onnx.ModelProto:
    """Convolutions in a row that share a weight."""
    names = ["x", *(f"y{i}" for i in range(times))]
    nodes = [
        helper.make_node("Conv", [one, "w"], [other], pads=[1, 1, 1, 1], group=group)
        for one, other in pairwise(names)
    ]
    x, y = (
        helper.make_tensor_value_info(one, TensorProto.FLOAT, IMAGE.shape) for one in (names[0], names[-1])
    )
    made = helper.make_graph(nodes, "g", [x], [y], [numpy_helper.from_array(kernel, "w")])
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)


def made_by(model: onnx.ModelProto) -> np.ndarray:
    onnx.checker.check_model(model, full_check=True)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"x": IMAGE})[0]


def test_convolutions_that_share_a_weight_compute_the_same() -> None:
    model = graph(KERNEL)
    before = made_by(model)
    _pad(model)
    shapes = [numpy_helper.to_array(one).shape for one in model.graph.initializer if one.data_type == 1]
    assert shapes == [(6, 8, 3, 3)]  # the unpadded weight is gone
    np.testing.assert_allclose(made_by(model), before, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("kernel", "group"), [(KERNEL[:, :, :1, :1], 1), (KERNEL[:, :3], 2), (KERNEL[:, :1], 6)]
)
def test_what_is_computed_rightly_stays(kernel: np.ndarray, group: int) -> None:
    model = graph(kernel, group, times=1)
    before = model.SerializeToString()
    _pad(model)
    assert model.SerializeToString() == before
