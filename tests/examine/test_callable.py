"""A user's file as a problem: scene and backend `callable` on the command line, in Python and in stored keys."""

import numpy as np
import pytest

import bench
from bench.errors import UserError
from bench.experiment.keys import fingerprint
from bench.model import registry

MADE = """
import numpy as np
theta = {"mass": 2.0, "gain": 0.5}
def cost(p): return p["mass"] ** 2 * p["gain"] + (p["mass"] > 2.1)
def gradient(p): return {"mass": 2 * p["mass"] * p["gain"], "gain": p["mass"] ** 2}
def noisy(p, w): return cost(p) + w[0] * p["mass"]
def noisy_gradient(p, w): return {"mass": gradient(p)["mass"] + w[0], "gain": gradient(p)["gain"]}
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "made.py"
    path.write_text(MADE)
    return path


def scene(**values):
    return registry.make("scenes", "callable", values)


def test_own_noise_comes_after_that_of_theta(file):
    values = dict(cost=f"{file}:noisy", grad="noisy_gradient", own_noise=1, sigma=0.1)
    problem = bench.plugin.compose(scene(**values))
    assert (problem.dim, problem.n_noise) == (2, 3)
    made = registry.make("backends", "callable").compile(problem)
    w = np.array([[0.0], [0.0], [3.0]])
    np.testing.assert_allclose(made.value(problem.theta0, w), [2.0 + 3.0 * 2.0])
    np.testing.assert_allclose(made.grad(problem.theta0, w)[:, 0], [2.0 + 3.0, 4.0])
    np.testing.assert_allclose(made.score(problem.theta0, w), np.zeros((2, 1)))


def test_without_a_gradient_differences_are_taken(file):
    problem = bench.plugin.compose(scene(cost=f"{file}:cost", grad=""))
    made = registry.make("backends", "callable").compile(problem)
    np.testing.assert_allclose(made.grad(problem.theta0, np.zeros((2, 1)))[:, 0], [2.0, 4.0], rtol=1e-8)
    assert made.usage.rollouts == 4


def test_a_changed_file_has_another_key(file):
    before = fingerprint(scene(cost=f"{file}:cost"))
    other = file.with_name("other.py")
    other.write_text(MADE.replace("2 * p", "3 * p"))
    assert fingerprint(scene(cost=f"{other}:cost")) != before
    assert fingerprint(scene(cost=f"{file}:cost")) == before


def test_other_backends_refuse_it_and_it_refuses_other_scenes(file):
    with pytest.raises(bench.Unsupported, match="runs on callable only"):
        bench.problem(f"callable[cost={file}:cost]", backend="numpy")
    with pytest.raises(bench.Unsupported, match="not a user's own simulator"):
        bench.problem("heaviside", backend="callable")


def test_a_missing_name_is_bad_input(file):
    with pytest.raises(UserError, match="did you mean 'cost'"):
        bench.problem(f"callable[cost={file}:costs]", backend="callable")
