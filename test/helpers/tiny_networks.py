# SPDX-License-Identifier: Apache-2.0
"""Network files of a few layers, ONNX and TFLite, whose outputs follow from the input in a known way.

Each output is a constant times one number: the mean of the input's values, each times a factor of its colour. What a
network sees of an image thus shows in what it says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

type Colours = tuple[float, float, float]

FLOAT, INT64 = 1, 7  # of ONNX's types
INT_ATTRIBUTE, INTS_ATTRIBUTE = 2, 7
OPSET = 13


def write_onnx(size: tuple[int, int], outputs: Mapping[str, np.ndarray], colours: Colours = (1, 1, 1)) -> bytes:
    """Return an ONNX file for inputs (1, 3, height, width); `size` is (width, height), `outputs` by name in order.

    The layers of the outputs stand in the file in the order of their names, not in that of the outputs.
    """
    shape = (1, 3, size[1], size[0])
    nodes = [
        _node("Reshape", ["image", "rows"], "pixels"),
        _node("Mul", ["pixels", "colours"], "coloured"),
        _node("ReduceMean", ["coloured"], "mean", {"axes": [1, 2], "keepdims": 0}),
        *(_node("Mul", [f"{name}_constant", "mean"], name) for name in sorted(outputs)),
    ]
    tensors = {"rows": np.array([1, 3, size[0] * size[1]]), "colours": np.reshape(colours, (1, 3, 1)) * 1.0}
    tensors |= {f"{name}_constant": values for name, values in outputs.items()}
    graph = b"".join(
        [
            *(_field(1, node) for node in nodes),
            _field(2, b"tiny"),
            *(_field(5, _tensor(name, values)) for name, values in tensors.items()),
            _field(11, _value("image", shape)),
            *(_field(12, _value(name, values.shape)) for name, values in outputs.items()),
        ]
    )
    return _field(1, 8) + _field(7, graph) + _field(8, _field(1, b"") + _field(2, OPSET))


def _node(
    kind: str, inputs: Sequence[str], output: str, attributes: Mapping[str, int | list[int]] | None = None
) -> bytes:
    data = b"".join(_field(1, name.encode()) for name in inputs)
    data += _field(2, output.encode()) + _field(3, f"make_{output}".encode()) + _field(4, kind.encode())
    for name, value in (attributes or {}).items():
        values = value if isinstance(value, list) else [value]
        number, type_ = (8, INTS_ATTRIBUTE) if isinstance(value, list) else (3, INT_ATTRIBUTE)
        told = b"".join(_field(number, one) for one in values)
        data += _field(5, _field(1, name.encode()) + told + _field(20, type_))
    return data


def _tensor(name: str, values: np.ndarray) -> bytes:
    whole = np.issubdtype(values.dtype, np.integer)
    raw = np.ascontiguousarray(values, "<i8" if whole else "<f4").tobytes()
    dimensions = b"".join(_field(1, side) for side in values.shape)
    return dimensions + _field(2, INT64 if whole else FLOAT) + _field(8, name.encode()) + _field(9, raw)


def _value(name: str, shape: Sequence[int]) -> bytes:
    sides = b"".join(_field(1, _field(1, side)) for side in shape)
    return _field(1, name.encode()) + _field(2, _field(1, _field(1, FLOAT) + _field(2, sides)))


def _field(number: int, value: int | bytes) -> bytes:
    """Encode a field of a protocol buffer: a whole number, or bytes with their length."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    parts = []
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*parts, value])


def write_tflite(
    size: tuple[int, int], outputs: Mapping[str, np.ndarray], colours: Colours = (1, 1, 1), whole: bool = False
) -> bytes:
    """Return a TFLite file for inputs (1, height, width, 3), float32 or `whole` numbers (uint8); see `write_onnx`."""
    import flatbuffers  # type: ignore[import-untyped]
    from ai_edge_litert import schema_py_generated as schema

    buffers, tensors, operators = [schema.BufferT()], [], []

    def add(name: str, shape: Sequence[int], values: np.ndarray | None = None, kind: int = 0) -> int:
        tensor = schema.TensorT()
        tensor.name, tensor.shape, tensor.type, tensor.buffer = name, list(shape), kind, 0
        if values is not None:
            buffer = schema.BufferT()
            buffer.data = np.frombuffer(values.tobytes(), np.uint8)
            tensor.buffer = len(buffers)
            buffers.append(buffer)
        tensors.append(tensor)
        return len(tensors) - 1

    def operate(code: int, inputs: list[int], output: int, options_type: int, options: Any) -> None:
        operator = schema.OperatorT()
        operator.opcodeIndex, operator.inputs, operator.outputs = code, inputs, [output]
        operator.builtinOptionsType, operator.builtinOptions = options_type, options
        operators.append(operator)

    shape = (1, size[1], size[0], 3)
    given = pixels = add("image", shape, kind=schema.TensorType.UINT8 if whole else schema.TensorType.FLOAT32)
    if whole:
        pixels = add("pixels", shape)
        operate(2, [given], pixels, schema.BuiltinOptions.CastOptions, schema.CastOptionsT())
    factors = add("colours", (1, 1, 1, 3), np.reshape(np.asarray(colours, "<f4"), (1, 1, 1, 3)))
    axes = add("axes", (3,), np.array([1, 2, 3], "<i4"), schema.TensorType.INT32)
    coloured, mean = add("coloured", shape), add("mean", (1,))
    multiply = schema.BuiltinOptions.MulOptions
    operate(0, [pixels, factors], coloured, multiply, schema.MulOptionsT())
    operate(1, [coloured, axes], mean, schema.BuiltinOptions.ReducerOptions, schema.ReducerOptionsT())
    results = {}
    for name in sorted(outputs):
        constant = add(f"{name}_constant", outputs[name].shape, np.asarray(outputs[name], "<f4"))
        results[name] = add(name, outputs[name].shape)
        operate(0, [constant, mean], results[name], multiply, schema.MulOptionsT())

    graph, model = schema.SubGraphT(), schema.ModelT()
    graph.name, graph.tensors, graph.operators = "tiny", tensors, operators
    graph.inputs, graph.outputs = [given], [results[name] for name in outputs]
    model.version, model.subgraphs, model.buffers, model.operatorCodes = 3, [graph], buffers, []
    for builtin in (schema.BuiltinOperator.MUL, schema.BuiltinOperator.MEAN, schema.BuiltinOperator.CAST):
        code = schema.OperatorCodeT()
        code.builtinCode, code.deprecatedBuiltinCode, code.version = builtin, builtin, 1
        model.operatorCodes.append(code)
    builder = flatbuffers.Builder(1024)
    builder.Finish(model.Pack(builder), file_identifier=b"TFL3")
    return bytes(builder.Output())
