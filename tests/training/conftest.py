"""Tests of training compute in double precision, except where they say otherwise."""

import pytest

from bench.model import registry


@pytest.fixture(autouse=True)
def double_precision():
    registry.make("backends", "jax").ops()
