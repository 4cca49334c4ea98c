"""A published Tesseract as a simulator that `examine` and sweeps take: its cost and its vector-Jacobian product.

A file for the command line is three lines::

    tesseract = Tesseract("http://127.0.0.1:8000", theta="height", cost="distance", inputs={"mass": 1.0})
    theta, sigma = np.array([1.0]), 0.1
    cost, gradient = tesseract.functions()
"""

from __future__ import annotations

import base64
import json
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bench.errors import UserError, printable


class Tesseract:
    """A scalar output of a Tesseract as a function of one input array.

    ``client`` is the address of a server, or an object with ``apply`` and ``vector_jacobian_product``, such as
    ``tesseract_core.Tesseract``. ``theta`` and ``cost`` are paths of an input and of an output, such as ``state.height``;
    ``inputs`` contains the values of all other inputs. ``timeout`` is that of a call [s].
    """

    def __init__(
        self, client: Any, theta: str, cost: str, inputs: Mapping[str, Any] | None = None, timeout: float = 60.0
    ) -> None:
        self._client = _Server(client, timeout) if isinstance(client, str) else client
        if lacking := [name for name in ("apply", "vector_jacobian_product") if not hasattr(self._client, name)]:
            raise UserError(f"{client!r} is not the address of a Tesseract, and has no method {lacking[0]}")
        self._theta, self._cost, self._inputs = theta, cost, dict(inputs or {})

    def cost(self, theta: np.ndarray) -> float:
        """Return the output at an input array."""
        outputs: Any = self._client.apply(self._filled(theta))
        for name in self._cost.split("."):
            if not isinstance(outputs, Mapping) or name not in outputs:
                raise UserError(f"cost={self._cost} is not an output of the Tesseract: {_names(outputs)}")
            outputs = outputs[name]
        value = np.asarray(outputs)
        if value.size != 1:
            raise UserError(f"cost={self._cost} has shape {value.shape}: a cost is one number")
        return float(value.reshape(()))

    def gradient(self, theta: np.ndarray) -> np.ndarray:
        """Return the derivative of the output by the input array, with that array's shape."""
        slopes = self._client.vector_jacobian_product(
            self._filled(theta), [self._theta], [self._cost], {self._cost: np.ones(())}
        )
        if not isinstance(slopes, Mapping) or self._theta not in slopes:
            raise UserError(f"theta={self._theta} is not a differentiable input of the Tesseract: {_names(slopes)}")
        return np.asarray(slopes[self._theta], dtype=np.float64)

    def functions(self) -> tuple[Callable[[np.ndarray], float], Callable[[np.ndarray], np.ndarray]]:
        """Return the functions :meth:`cost` and :meth:`gradient`, for a simulator's file."""
        return self.cost, self.gradient

    def _filled(self, theta: np.ndarray) -> dict[str, Any]:
        inputs = dict(self._inputs)
        *parents, last = self._theta.split(".")
        place = inputs
        for name in parents:
            place[name] = dict(place.get(name, {}))
            place = place[name]
        place[last] = np.asarray(theta, dtype=np.float64)
        return inputs


class _Server:
    """A Tesseract's HTTP server. Arrays travel in base64."""

    def __init__(self, address: str, timeout: float) -> None:
        self._address, self._timeout = address.rstrip("/"), timeout

    def apply(self, inputs: Mapping[str, Any]) -> Any:
        """Return all outputs at the inputs."""
        return self._post("apply", {"inputs": inputs})

    def vector_jacobian_product(
        self,
        inputs: Mapping[str, Any],
        vjp_inputs: list[str],
        vjp_outputs: list[str],
        cotangent_vector: Mapping[str, Any],
    ) -> Any:
        """Return the derivatives of a weighted sum of outputs, by path of the input."""
        return self._post("vector_jacobian_product", {
            "inputs": inputs, "vjp_inputs": vjp_inputs, "vjp_outputs": vjp_outputs, "cotangent_vector": cotangent_vector,
        })  # fmt: skip

    def _post(self, endpoint: str, content: Any) -> Any:
        request = urllib.request.Request(
            f"{self._address}/{endpoint}", json.dumps(_encode(content)).encode(), {"Content-Type": "application/json"}
        )
        try:
            with urllib.request.urlopen(request, timeout=self._timeout) as answer:
                return _decode(json.load(answer))
        except urllib.error.HTTPError as error:
            detail = printable(error.read().decode(errors="replace"))[:300]
            raise RuntimeError(f"Tesseract {self._address}/{endpoint}: status {error.code}: {detail}") from error
        except OSError as error:
            raise RuntimeError(f"Tesseract {self._address}/{endpoint} does not answer: {error}") from error


def _encode(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _encode(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_encode(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        data = {"buffer": base64.b64encode(array.tobytes()).decode(), "encoding": "base64"}
        return {"object_type": "array", "shape": array.shape, "dtype": array.dtype.name, "data": data}
    return value


def _decode(value: Any) -> Any:
    if isinstance(value, list):
        return [_decode(part) for part in value]
    if not isinstance(value, Mapping):
        return value
    if value.get("object_type") != "array":
        return {name: _decode(part) for name, part in value.items()}
    data, dtype = value["data"], np.dtype(value["dtype"])
    if data["encoding"] == "base64":
        return np.frombuffer(base64.b64decode(data["buffer"]), dtype).reshape(value["shape"])
    if data["encoding"] == "json":
        return np.array(data["buffer"], dtype).reshape(value["shape"])
    raise RuntimeError(f"the Tesseract answers with arrays in {data['encoding']}: serve it with json or json+base64")


def _names(values: Any) -> str:
    return f"it has {', '.join(values)}" if isinstance(values, Mapping) else f"it is {type(values).__name__}"
