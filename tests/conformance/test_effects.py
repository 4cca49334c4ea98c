"""The kit finds parameters without effect, and declarations that costs contradict."""

from dataclasses import dataclass

import pytest
from classes import Cubic, FrictionBlock, Impulse, Penalty

from bench.conformance import Failed, effects
from bench.conformance.effects import ignored_parameters_are_declared, parameters_have_an_effect
from bench.model import param


@dataclass(frozen=True)
class Spare(Cubic):
    spare: float = param(1.0, "used nowhere")


class Declared(Spare):
    def without_effect(self, contact):
        return ("spare",)


class Silent(Impulse):
    ignores = ()


class Boastful(Impulse):
    ignores = (*Impulse.ignores, "restitution")


@dataclass(frozen=True)
class Idle(Penalty):
    extra: float = param(1.0, "used nowhere")


def test_a_parameter_without_effect_is_found_and_can_be_declared():
    with pytest.raises(Failed, match="spare without effect: declare it"):
        parameters_have_an_effect(Spare())
    assert parameters_have_an_effect(Declared())


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (Silent(), "friction, slip_speed without effect"),
        (Boastful(), "restitution declared without effect, and costs depend on it"),
        (Idle(), "extra without effect"),
    ],
)
def test_a_law_declares_what_it_ignores_and_only_that(law, words, monkeypatch):
    monkeypatch.setattr(effects, "sound_scenes", lambda: [FrictionBlock()])
    with pytest.raises(Failed, match=words):
        ignored_parameters_are_declared(law)
    assert ignored_parameters_are_declared(Impulse())
