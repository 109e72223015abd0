"""A model as an ONNX graph from features to a prediction, in double precision, with standard operators only."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import __version__
from cgid.errors import optional
from cgid.export.c99 import channels_text, require_small
from cgid.identification.model.families import Network, Standardiser
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import FLOOR, STANDARDISER

#: Version of the operators and of the format: old enough for runtimes of several years.
_OPSET, _IR = 17, 8


class _Graph:
    """Nodes and constants in the order of the calculation; each method returns the name of a result."""

    def __init__(self, helper: Any, numpy_helper: Any) -> None:
        self._helper, self._numpy_helper = helper, numpy_helper
        self.nodes: list[Any] = []
        self.constants: dict[str, Any] = {}

    def constant(self, values: Any, kind: type[np.generic] = np.float64) -> str:
        """Return the name of a constant; equal ones are stored once."""
        array = np.ascontiguousarray(values, kind)
        name = f"c_{hashlib.sha256(str((array.dtype, array.shape)).encode() + array.tobytes()).hexdigest()[:16]}"
        self.constants[name] = self._numpy_helper.from_array(array, name)
        return name

    def __call__(self, operator: str, *inputs: str | NDArray[Any] | float, name: str = "", **attributes: Any) -> str:
        """Add a node; numbers among its inputs become constants."""
        result = name or f"{operator.lower()}_{len(self.nodes)}"
        names = [one if isinstance(one, str) else self.constant(one) for one in inputs]
        self.nodes.append(self._helper.make_node(operator, names, [result], **attributes))
        return result

    def integer(self, values: Any) -> str:
        """Return the name of a constant of integers."""
        return self.constant(values, np.int64)

    def columns(self, values: str, numbers: Iterable[int]) -> str:
        return self("Gather", values, self.integer(list(numbers)), axis=1)

    def sums(self, values: str) -> str:
        """Return the sum of each row, (n, 1)."""
        return self("ReduceSum", values, self.integer([1]), keepdims=1)


def onnx_bytes(model: StoredModel) -> bytes:
    """Return an ONNX file that predicts like the model; its metadata are labels, names, unit, digest and channels."""
    # Input: `values`, float64 (n, n_values), the inputs of the model, then its guards. Outputs: `probabilities` (n,
    # n_labels), `novelty` (n,) and `label`, int64 (n,), the number of the label, or -1 for unknown.
    optional("onnx", "ONNX needs", "onnx")
    from onnx import TensorProto, checker, helper, numpy_helper

    require_small(model)
    graph = _Graph(helper, numpy_helper)
    _answer(graph, model)
    names = [*model.inputs, *model.guards]
    double, rows = TensorProto.DOUBLE, "n"
    made = helper.make_graph(
        graph.nodes,
        "cgid",
        [helper.make_tensor_value_info("values", double, [rows, len(names)])],
        [
            helper.make_tensor_value_info("probabilities", double, [rows, len(model.labels)]),
            helper.make_tensor_value_info("novelty", double, [rows]),
            helper.make_tensor_value_info("label", TensorProto.INT64, [rows]),
        ],
        list(graph.constants.values()),
    )
    file = helper.make_model(made, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
    file.producer_name, file.producer_version = "cgid", __version__
    digest = hashlib.sha256(model.to_bytes()).hexdigest()
    about = {"labels": model.labels, "values": names, "unit": model.unit, "model_sha256": digest}
    about |= {"channels": text} if (text := channels_text(model)) else {}
    helper.set_model_props(
        file, {name: text if isinstance(text, str) else json.dumps(text) for name, text in about.items()}
    )
    checker.check_model(file)
    return bytes(file.SerializeToString(deterministic=True))


def _answer(graph: _Graph, model: StoredModel) -> None:
    """Add probabilities, novelty and label."""
    inputs, values = graph.columns("values", range(len(model.inputs))), "values"
    if FLOOR in model.arrays:
        inputs = graph("Max", inputs, model.arrays[FLOOR])
        guards = [graph.columns("values", range(len(model.inputs), len(model.inputs) + len(model.guards)))]
        values = graph("Concat", inputs, *guards * bool(model.guards), axis=1)
    x = _standardised(graph, inputs, Standardiser.from_arrays(model.arrays, STANDARDISER))
    scores = graph("Div", _SCORES[model.family](graph, x, model), model.temperature)
    if len(model.labels) == 2:
        scores = graph("Concat", graph("Mul", scores, 0.0), scores, axis=1)
    probabilities = graph("Softmax", scores, axis=1, name="probabilities")
    novelty = _novelty(graph, model, x, values)
    # Infinity times zero is nan, too.
    sums = graph.sums(graph("Concat", "values", probabilities, axis=1))
    finite = graph("Not", graph("IsNaN", graph("Mul", sums, 0.0)))
    is_known = graph("And", graph("Squeeze", finite, graph.integer([1])), graph("LessOrEqual", novelty, 1.0))
    best = graph("ArgMax", probabilities, axis=1, keepdims=0)
    graph("Where", is_known, best, graph.integer(-1), name="label")


def _standardised(graph: _Graph, values: str, standardiser: Standardiser) -> str:
    logarithms = graph("Log", graph("Max", values, standardiser.floor))
    scaled = graph("Where", graph.constant(standardiser.logarithmic, np.bool_), logarithms, values)
    return graph("Div", graph("Sub", scaled, standardiser.mean), standardiser.scale)


def _novelty(graph: _Graph, model: StoredModel, x: str, values: str) -> str:
    """Add the novelty (n,): infinite where infinities cancel, as in `Model`."""
    centres, whitening = model.arrays["neighbourhood.centres"], model.arrays["neighbourhood.whitening"]
    squares = []
    for k, centre in enumerate(centres):
        white = graph("MatMul", graph("Sub", x, centre), whitening[k % len(whitening)].T)
        squares.append(graph.sums(graph("Mul", white, white)))
    every = graph("Concat", *squares, axis=1)
    nearest = graph("Sqrt", graph("ReduceMin", every, axes=[1], keepdims=1))
    parts = [graph("Div", nearest, model.neighbourhood_limit)]
    doubtful = [graph.sums(every)]
    n = len(model.inputs)
    if model.guards:
        guards = graph.columns("values", range(n, n + len(model.guards)))
        parts.append(graph("ReduceMax", graph("Div", guards, np.array(model.guard_limits)), axes=[1], keepdims=1))
    if model.contrast is not None:
        contrast = model.contrast
        measured = graph.columns(values, [*range(len(model.features)), *range(n, n + len(model.guards))])
        standardised, arrays = _standardised(graph, measured, contrast.standardiser), contrast.scorer.arrays
        by_network = isinstance(contrast.scorer, Network)
        score = _layers(graph, standardised, arrays) if by_network else _line(graph, standardised, arrays)
        parts.append(
            graph("Exp", graph("Min", graph("Div", graph("Sub", score, contrast.limit), contrast.SCALE), 100.0))
        )
        doubtful.append(parts[-1])
    # Runtimes differ in the maximum of numbers and nan.
    odd = graph("IsNaN", graph("Sum", *doubtful) if len(doubtful) > 1 else doubtful[0])
    largest = graph("Max", *parts) if len(parts) > 1 else parts[0]
    return graph("Squeeze", graph("Where", odd, np.inf, largest), graph.integer([1]), name="novelty")


# -- the scores of the families, (n, n_scores) ------------------------------------------------------------


def _linear(graph: _Graph, x: str, model: StoredModel) -> str:
    return _line(graph, x, _arrays(model))


def _logistic(graph: _Graph, x: str, model: StoredModel) -> str:
    rows, columns = np.triu_indices(len(model.inputs))
    products = graph("Mul", graph.columns(x, rows), graph.columns(x, columns))
    return _linear(graph, graph("Concat", x, products, axis=1), model)


def _network(graph: _Graph, x: str, model: StoredModel) -> str:
    return _layers(graph, x, _arrays(model))


def _arrays(model: StoredModel) -> dict[str, NDArray[Any]]:
    return {name.removeprefix("family."): array for name, array in model.arrays.items()}


def _line(graph: _Graph, x: str, arrays: Mapping[str, NDArray[Any]]) -> str:
    return graph("Add", graph("MatMul", x, arrays["coefficients"].T), arrays["intercepts"])


def _layers(graph: _Graph, x: str, arrays: Mapping[str, NDArray[Any]]) -> str:
    for k in (1, 2, 3):
        x = graph("Add", graph("MatMul", x, arrays[f"weights_{k}"]), arrays[f"biases_{k}"])
        x = graph("Tanh", x) if k < 3 else x
    return x


_SCORES = {"linear": _linear, "logistic": _logistic, "network": _network}
