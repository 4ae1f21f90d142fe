# SPDX-License-Identifier: Apache-2.0
"""Runs a network's file: TFLite through LiteRT, ONNX through OpenCV, both on one thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Protocol

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.extras import import_extra

MAX_SHAPES = 3
"""Sizes of input for which a network stays prepared; each takes some ten megabytes."""


class Network(Protocol):
    """A network that takes one array and returns all its outputs."""

    def run(self, values: Array) -> list[Array]:
        """Return the outputs for an input (1, ...)."""
        ...


class LiteRtNetwork:
    """A TFLite network. Two threads may run it; one waits for the other."""

    def __init__(self, data: bytes) -> None:
        """Prepare a network from the contents of its file.

        Raises:
            InputError: when LiteRT is not installed, or `data` is no network.
        """
        interpreter = import_extra("ai_edge_litert.interpreter", "neural", "a keypoint network").Interpreter
        self._make: Callable[[], Any] = lambda: interpreter(model_content=data, num_threads=1)
        self._prepared: dict[tuple[int, ...], Any] = {}
        self._lock = threading.Lock()
        try:
            self._first = self._make()
            self._input = self._first.get_input_details()[0]
        except ValueError as error:
            raise InputError(f"the file is not a TFLite network ({error})") from error

    @property
    def input_shape(self) -> tuple[int, ...]:
        """Shape of the input; -1 where it is free."""
        return tuple(int(side) for side in self._input["shape_signature"])

    @property
    def input_type(self) -> np.dtype[Any]:
        """Type of the input's values."""
        return np.dtype(self._input["dtype"])

    def run(self, values: Array) -> list[Array]:
        """Return the outputs for an input (1, H, W, 3), in the order of the file.

        Raises:
            InputError: when the network takes no input of this shape.
        """
        with self._lock:
            try:
                interpreter = self._prepare(values.shape)
                interpreter.set_tensor(self._input["index"], values.astype(self.input_type, copy=False))
                interpreter.invoke()
            except (RuntimeError, ValueError) as error:
                raise InputError(
                    f"the network takes inputs of shape {self.input_shape}, -1 where it is free, not {values.shape}:"
                    " check `input` in its description"
                ) from error
            return [interpreter.get_tensor(output["index"]) for output in interpreter.get_output_details()]

    def _prepare(self, shape: tuple[int, ...]) -> Any:
        """Return an interpreter for inputs of a shape; the ones used last are kept."""
        interpreter = self._prepared.pop(shape, None)
        if interpreter is None:
            interpreter = self._make()
            interpreter.resize_tensor_input(self._input["index"], shape, strict=True)
            interpreter.allocate_tensors()
            if len(self._prepared) >= MAX_SHAPES:
                del self._prepared[next(iter(self._prepared))]
        self._prepared[shape] = interpreter
        return interpreter


class OnnxNetwork:
    """An ONNX network, run by OpenCV. Two threads may run it; one waits for the other."""

    def __init__(self, data: bytes) -> None:
        """Prepare a network from the contents of its file; InputError when OpenCV cannot read it."""
        self._lock = threading.Lock()
        try:
            self._network = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
        except cv2.error as error:
            raise InputError(f"OpenCV cannot read the ONNX network ({_reason(error)})") from error
        self._names = self._network.getUnconnectedOutLayersNames()

    def run(self, values: Array) -> list[Array]:
        """Return the outputs for an input (1, 3, H, W) float32, in the order of the file.

        Raises:
            InputError: when the network takes no input of this shape.
        """
        with self._lock:
            self._network.setInput(values)
            try:
                return [np.array(output) for output in self._network.forward(self._names)]
            except cv2.error as error:
                raise InputError(
                    f"OpenCV cannot run the network on an input of shape {values.shape} ({_reason(error)}): check"
                    " `input` in its description"
                ) from error


def _reason(error: cv2.error) -> str:
    """Return what OpenCV says, without the place in its code."""
    return " ".join(str(getattr(error, "err", error)).split())
