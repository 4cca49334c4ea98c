"""If a backend cannot run a program, the next one computes the reference; a scene may name its backends."""

import numpy as np
import pytest
from classes import Cubic, Heaviside, Jax, Numpy
from helpers import loaded

from bench.experiment.session import Problems
from bench.measure.reference import Reference
from bench.model import compose
from bench.run import references
from bench.run.references import References


@pytest.fixture
def made(tmp_path):
    experiment, cells = loaded("scenes=[cubic]", "backends=[numpy]", "estimators=[fobg]", f"results_dir={tmp_path}")
    return References(experiment, Problems()), cells[0]


def failing(names, monkeypatch):
    """Let certifying fail on the backends of these names."""
    plain, tried = references.reference.certify, []

    def certify(problem, *given):
        name = type(problem).__name__.removesuffix("Problem").lower()
        tried.append(name)
        if name in names:
            raise TypeError(f"{name} cannot branch on a traced value")
        return plain(problem, *given)

    monkeypatch.setattr(references.reference, "certify", certify)
    return tried


def test_next_backend_computes_the_reference(made, monkeypatch):
    found, cell = made
    tried = failing({"jax"}, monkeypatch)
    reference = found.of(cell)
    assert len(tried) > 1
    assert np.isfinite(reference.gradient).all()
    assert "after a failure of" in reference.note
    assert "TypeError" in reference.note
    # and what was stored is the same
    assert found._load(cell.reference_key).note == reference.note


def test_first_error_is_raised_where_none_can(made, monkeypatch):
    found, cell = made
    failing({"jax", "torch", "numpy", "implicit", "fused"}, monkeypatch)
    with pytest.raises(TypeError, match="jax cannot branch"):
        found.of(cell)
    assert not found.stored(cell)


def test_stored_reference_is_the_same(made):
    found, _ = made
    batches = np.random.default_rng(0).standard_normal((64, 3))
    reference = Reference(batches, "sampling[n=64]", 0.1, np.ones(3), np.zeros(3), "a note", 0.04, 64)
    found._shared.save("r", vars(reference))
    again = found._load("r")
    assert np.array_equal(again.batches, batches)
    numbers = (again.method, again.error, again.note, again.spacing, again.samples)
    assert numbers == ("sampling[n=64]", 0.1, "a note", 0.04, 64)
    assert again.known().standard_error == reference.known().standard_error > 0.1
    assert again.model_error == reference.model_error == pytest.approx(3**0.5)


def test_a_reference_that_is_not_a_number_is_read_as_one(made):
    """Other workers and later runs read the file."""
    found, _ = made
    found._shared.save("r", vars(Reference(np.full((1, 2), np.nan), "sampling[failed: costs]", np.nan)))
    assert not found._load("r").is_finite


def test_a_damaged_reference_is_computed_again(made):
    found, _ = made
    found._shared.save("r", {"batches": [["a"]]})
    assert found._load("r") is None


def test_scene_names_its_backends():
    class Plain(Cubic):
        backends = ("numpy", "torch")

    program = compose(Plain())
    assert Numpy().refusal(program) is None
    assert Jax().refusal(program) == "scene cubic runs on numpy and torch only"
    assert Jax().refusal(compose(Heaviside())) is None
