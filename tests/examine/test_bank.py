"""Planted faults are caught, and right gradients pass."""

import pytest
import simulators

from bench.errors import UserError

UNNAMED = ("rounded",)
"""A fault that is caught, and called `unsettled` where the budget ends before a staircase is looked for."""


def judge(case):
    if case.causes == ("refused",):
        with pytest.raises(UserError, match="cannot differentiate the cost"):
            simulators.examined(case)
        return
    report = simulators.examined(case)
    assert bool(report.status) == bool(case.causes), f"{case.name}: {report.cause}\n{report}"
    if case.causes and case.name not in UNNAMED:
        assert report.cause in case.causes, case.name


RIGHT = {case.name: case for case in simulators.right_cases()}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n == "contact")) for n in RIGHT])
def test_right_gradients_of_hard_simulators_pass(name):
    judge(RIGHT[name])


@pytest.mark.slow
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_simulators_with_tapes_are_judged_rightly(library):
    for case in simulators.CASES[library]():
        judge(case)
