"""Convolutions rewritten by Winograd's method compute what onnxruntime computes of those of before."""

import numpy as np
import pytest

from hma_model.export.winograd import rewrite

onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")


def model_of(
    kernel: np.ndarray, sides: tuple[int, int], *, bias: bool = True, **given: object
) -> "onnx.ModelProto":
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


def run(model: "onnx.ModelProto", image: np.ndarray) -> np.ndarray:
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
