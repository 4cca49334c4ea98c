"""Planted faults are caught, and right gradients pass; `python validation/simulators.py` prints the whole table."""

import pytest
import simulators

SLOW = (
    "contact", "missing contact term", "last step forgotten", "gradient elsewhere", "noise reused shifted",
)  # fmt: skip
"""Cases whose rollouts take long in Python; the quick tests have others of their kind."""
UNNAMED = ("rounded",)
"""A fault that is caught, and called `unsettled` where the budget ends before a staircase is looked for."""


def judge(case):
    report = simulators.examined(case)
    assert bool(report.status) == bool(case.causes), f"{case.name}: {report.cause}\n{report}"
    if case.causes and case.name not in UNNAMED:
        assert report.cause in case.causes, case.name
    assert not case.warned or any(case.warned in text for text in report.warnings), case.name


@pytest.mark.parametrize("case", [c for c in simulators.numpy_cases() if c.name not in SLOW], ids=lambda c: c.name)
def test_numpy_simulators_are_judged_rightly(case):
    judge(case)


@pytest.mark.parametrize("case", list(simulators.right_cases()), ids=lambda c: c.name)
def test_right_gradients_of_hard_simulators_pass(case):
    judge(case)


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in simulators.numpy_cases() if c.name in SLOW], ids=lambda c: c.name)
def test_longer_numpy_simulators_are_judged_rightly(case):
    judge(case)


@pytest.mark.slow
@pytest.mark.parametrize("library", ["torch", "jax"])
def test_simulators_with_tapes_are_judged_rightly(library):
    for case in simulators.CASES[library]():
        judge(case)
