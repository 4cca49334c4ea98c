"""A Tesseract's cost and vector-Jacobian product, of a server in another process and of a client object."""

import subprocess
import sys

import numpy as np
import pytest

import bench
from bench.engines.tesseract import Tesseract
from bench.errors import UserError

SERVER = """
import base64, json, sys
from http.server import BaseHTTPRequestHandler, HTTPServer
import numpy as np

def array(value):
    data = {"buffer": base64.b64encode(value.tobytes()).decode(), "encoding": "base64"}
    if value.ndim == 0:
        data = {"buffer": float(value), "encoding": "json"}
    return {"object_type": "array", "shape": list(value.shape), "dtype": "float64", "data": data}

class Handler(BaseHTTPRequestHandler):
    def do_POST(self):
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        given = request["inputs"]["state"]["x"]
        x = np.frombuffer(base64.b64decode(given["data"]["buffer"])).reshape(given["shape"])
        k = request["inputs"]["k"]
        if self.path == "/apply":
            answer = {"out": {"energy": array(np.asarray(k * (x**2).sum()))}, "other": 1}
        elif k < 0:
            self.send_error(422, "negative stiffness")
            return
        else:
            assert request["vjp_inputs"] == ["state.x"] and request["vjp_outputs"] == ["out.energy"]
            answer = {"state.x": array(FACTOR * k * x)}
        self.send_response(200)
        self.end_headers()
        self.wfile.write(json.dumps(answer).encode())
    def log_message(self, *a): pass

FACTOR = float(sys.argv[1])
server = HTTPServer(("127.0.0.1", 0), Handler)
print(server.server_port, flush=True)
server.serve_forever()
"""


@pytest.fixture
def address(request):
    words = [sys.executable, "-c", SERVER, str(getattr(request, "param", 2.0))]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        yield f"http://127.0.0.1:{server.stdout.readline().strip()}"
        server.kill()


def tesseract(address, **inputs):
    return Tesseract(address, theta="state.x", cost="out.energy", inputs={"k": 3.0, **inputs})


def test_cost_and_gradient_of_a_server(address):
    x = np.array([1.0, -2.0])
    assert tesseract(address).cost(x) == 15.0
    np.testing.assert_array_equal(tesseract(address).gradient(x), [6.0, -12.0])


@pytest.mark.parametrize(("address", "trusted"), [(2.0, True), (2.5, False)], indirect=["address"])
def test_a_tesseract_is_examined(address, trusted):
    t = tesseract(address)
    report = bench.examine(t.functions()[0], np.array([1.0, -2.0]), grad=t.functions()[1], calls=200, progress=False)
    assert report.derivative == ("right" if trusted else "wrong")


def test_a_client_object_and_other_inputs_are_accepted():
    class Client:
        def apply(self, inputs):
            return {"out": {"energy": inputs["k"] * np.sum(inputs["state"]["x"] ** 2)}}

        def vector_jacobian_product(self, inputs, vjp_inputs, vjp_outputs, cotangent_vector):
            return {"state.x": 2 * inputs["k"] * inputs["state"]["x"] * cotangent_vector["out.energy"]}

    given = {"state": {"y": 1.0}}
    t = tesseract(Client(), **given)
    assert t.cost(np.ones(2)) == 6.0
    np.testing.assert_array_equal(t.gradient(np.ones(2)), [6.0, 6.0])
    assert given == {"state": {"y": 1.0}}


def test_errors_name_the_place(address):
    with pytest.raises(UserError, match=r"cost=out\.power is not an output of the Tesseract: it has energy"):
        Tesseract(address, "state.x", "out.power", {"k": 1.0}).cost(np.ones(1))
    with pytest.raises(RuntimeError, match="vector_jacobian_product: status 422"):
        tesseract(address, k=-1.0).gradient(np.ones(1))
    with pytest.raises(RuntimeError, match="does not answer"):
        tesseract("http://127.0.0.1:9").cost(np.ones(1))
    with pytest.raises(UserError, match="has no method apply"):
        tesseract(object())
