"""A policy as an ONNX model, for robots whose controllers run in C++ or on an accelerator."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from onnx import ModelProto, checker, helper, numpy_helper, parser

__all__ = ["onnx_policy"]

_OPSET: Final = 18
_IR: Final = 8  # the oldest that this opset may have, so that older runtimes read it
# Distances by differences: as |z|^2 - 2 z s + |s|^2 they would be lost far from the samples.
_GRAPH: Final = """
policy (double[n, {d}] states) => (double[n, {p}] goals) {{
  centred = Sub(states, centre)
  z = Div(centred, lengthscales)
  rows = Unsqueeze(z, one)
  apart = Sub(rows, samples)
  squares = Mul(apart, apart)
  squared = ReduceSum<keepdims = 0>(squares, two)
  exponent = Mul(squared, minus_half)
  near = Exp(exponent)
  curved = Mul(near, signal_variance)
  columns = Transpose(samples)
  products = MatMul(z, columns)
  straight = Mul(products, linear_weight)
  k = Add(curved, straight)
  weighed = MatMul(k, weights)
  scaled = Mul(weighed, scales)
  free = Add(scaled, prior)
  raised = Max(free, low)
  goals = Min(raised, high)
}}
"""
_NUMBERS: Final = (
    *("centre", "lengthscales", "signal_variance", "linear_weight", "samples", "weights"),
    *("prior", "scales", "low", "high"),
)


def onnx_policy(policy: Mapping[str, Any]) -> ModelProto:
    """The model: states (n, d) -> goals (n, p), both float 64.

    Its metadata has `task`, `version`, and as JSON lists `state_names` and `goal_names`.

    Args:
        policy: The arrays of a policy's file.
    """
    (_, p), d = np.shape(policy["weights"]), len(policy["centre"])
    graph = parser.parse_graph(_GRAPH.format(d=d, p=p))
    constants = {name: np.asarray(policy[name], dtype=np.float64) for name in _NUMBERS}
    constants |= {"minus_half": np.array(-0.5), "one": np.array([1]), "two": np.array([2])}
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
    told = {"task": policy["task"], "version": str(policy["version"])}
    told |= {name: json.dumps(list(policy[name])) for name in ("state_names", "goal_names")}
    helper.set_model_props(model, told)
    checker.check_model(model, full_check=True)
    return model
