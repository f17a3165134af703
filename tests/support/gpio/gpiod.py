"""The part of the package gpiod that the drivers use, for a chip that is a socket of ``tests.support.beacon_ports``.

A program whose ``PYTHONPATH`` begins with this folder imports it instead of the package.
"""

import json
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import SimpleNamespace
from typing import Any


class Value(Enum):
    """Level of a line."""

    INACTIVE = 0
    ACTIVE = 1


class Direction(Enum):
    """Of a line."""

    INPUT = 1
    OUTPUT = 2


line = SimpleNamespace(Value=Value, Direction=Direction)


@dataclass
class LineSettings:
    """Settings of a line."""

    direction: Direction
    output_value: Value = Value.INACTIVE


class Request:
    """Requested lines."""

    def __init__(self, chip: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(chip)
        self._answers = self._socket.makefile("rb")

    def _ask(self, message: object) -> Any:
        self._socket.sendall(json.dumps(message).encode() + b"\n")
        return json.loads(self._answers.readline())

    def set_values(self, values: Mapping[int, Value]) -> None:
        self._ask({number: value is Value.ACTIVE for number, value in values.items()})

    def get_value(self, number: int) -> Value:
        return Value(self._ask(number))

    def release(self) -> None:
        self._answers.close()
        self._socket.close()


def request_lines(chip: str, consumer: str, config: Mapping[int, LineSettings]) -> Request:
    """Lines of a chip."""
    request = Request(chip)
    outputs = {n: one.output_value for n, one in config.items() if one.direction is Direction.OUTPUT}
    if outputs:
        request.set_values(outputs)
    return request
