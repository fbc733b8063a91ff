"""Convolutions that are rewritten or padded before a graph is written compute the same."""

from itertools import pairwise

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import helper, numpy_helper

from hma_model.export.files import _pad
from hma_model.export.winograd import rewrite


def model_of(
    kernel: np.ndarray, sides: tuple[int, int], *, bias: bool = True, times: int = 1, **given: object
) -> onnx.ModelProto:
    """Convolutions in a row that share their weights."""
    weights = {"kernel": kernel}
    if bias:
        weights["bias"] = np.linspace(-1, 1, len(kernel), dtype=np.float32)
    names, how = ["image", *(f"out{i}" for i in range(times))], {"pads": [1] * 4} | given
    nodes = [helper.make_node("Conv", [one, *weights], [other], **how) for one, other in pairwise(names)]
    shape = [1, kernel.shape[1] * int(str(given.get("group", 1))), *sides]
    graph = helper.make_graph(
        nodes,
        "one",
        [helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info(names[-1], onnx.TensorProto.FLOAT, [None] * 4)],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
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


def test_convolutions_that_share_a_weight_compute_the_same() -> None:
    model = model_of(KERNEL, (8, 8), bias=False, times=2)
    before = run(model, IMAGE)
    _pad(model)
    onnx.checker.check_model(model, full_check=True)
    shapes = [numpy_helper.to_array(one).shape for one in model.graph.initializer if one.data_type == 1]
    assert shapes == [(6, 8, 3, 3)]  # the unpadded weight is gone
    np.testing.assert_allclose(run(model, IMAGE), before, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("kernel", "group"), [(KERNEL[:, :, :1, :1], 1), (KERNEL[:, :3], 2), (KERNEL[:, :1], 6)]
)
def test_what_is_computed_rightly_stays(kernel: np.ndarray, group: int) -> None:
    model = model_of(kernel, (8, 8), bias=False, group=group)
    before = model.SerializeToString()
    _pad(model)
    assert model.SerializeToString() == before
