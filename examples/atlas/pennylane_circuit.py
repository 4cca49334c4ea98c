"""A circuit of two qubits."""

import numpy as np
import pennylane as qml

about = {
    "package": "pennylane",
    "python": "plain",
    "requires": "pennylane autograd",
    "examine": "grad=gradient sigma=0.1 calls=2000",
    "derivative": "right",
    "use": "usable",
    "how": "closed form",
}
theta = np.array([0.4, 1.1])


@qml.qnode(qml.device("default.qubit", wires=2))
def expectation(p):
    """Return the expectation of Z on the second qubit."""
    qml.RX(p[0], 0)
    qml.RY(p[1], 1)
    qml.CNOT([0, 1])
    return qml.expval(qml.PauliZ(1))


cost = lambda p: float(expectation(p))
gradient = lambda p: qml.grad(expectation)(qml.numpy.array(p))


def truth():
    """Return the derivative of cos(a) cos(b)."""
    (a, b), cos, sin = theta, np.cos, np.sin
    return [-sin(a) * cos(b), -cos(a) * sin(b)]
