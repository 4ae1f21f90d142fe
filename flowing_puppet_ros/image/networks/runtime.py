# SPDX-License-Identifier: Apache-2.0
"""Runs a network's file: TFLite through LiteRT, ONNX through OpenCV, both on one thread."""

from __future__ import annotations

import threading
from typing import Any, Protocol

import cv2
import numpy as np

from flowing_puppet_ros.arrays import Array
from flowing_puppet_ros.errors import InputError
from flowing_puppet_ros.extras import import_extra


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
        self._shape: tuple[int, ...] = ()
        self._lock = threading.Lock()
        try:
            self._interpreter = interpreter(model_content=data, num_threads=1)
            self._input = self._interpreter.get_input_details()[0]
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
                self._prepare(values.shape)
                self._interpreter.set_tensor(self._input["index"], values.astype(self.input_type, copy=False))
                self._interpreter.invoke()
            except (RuntimeError, ValueError) as error:
                raise InputError(
                    f"the network takes inputs of shape {self.input_shape}, -1 where it is free, not {values.shape}:"
                    " check `input` in its description"
                ) from error
            outputs = self._interpreter.get_output_details()
            return [self._interpreter.get_tensor(output["index"]) for output in outputs]

    def _prepare(self, shape: tuple[int, ...]) -> None:
        """Make room for inputs of a shape.

        That takes 2 ms, while an interpreter for every shape would keep weights of its own, 35 MB for MoveNet's.
        """
        if shape != self._shape:
            self._shape = ()
            self._interpreter.resize_tensor_input(self._input["index"], shape, strict=True)
            self._interpreter.allocate_tensors()
            self._shape = shape


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
