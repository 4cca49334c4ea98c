"""Checks without a reference: they hold for the C engine, each finds a fault of its own kind, and the command reports both."""

import numpy as np
import pytest

from bench.cli import main
from bench.engines import conformance, table
from bench.engines.conformance import metamorphic
from bench.experiment import by_name
from bench.model import compose

pytest.importorskip("mujoco")
from bench.plugins.backends import mjx
from bench.plugins.engines.mujoco_conformance import Model

from bench.plugins import mjcf

LOOP = conformance.runner.FOLDER / "connect_fast.xml"
CHAIN = conformance.runner.FOLDER / "sparse_chain.xml"
ALL = tuple(metamorphic.PROPERTIES)


@pytest.mark.parametrize(
    "path", [LOOP, CHAIN, *(conformance.runner.FOLDER / f"{name}.xml" for name in ("rk4", "weld"))]
)
def test_all_properties_hold_for_the_c_engine(path):
    rows = list(metamorphic.check(Model, path, steps=12))
    assert [row["property"] for row in rows] == list(ALL)
    assert not [row for row in rows if row["holds"] is False]
    assert sum(row["holds"] is True for row in rows) >= 7


def changed(method, change, **others):
    """Return the C engine's class with one method whose result is ``change(own, *arguments)`` of the class's own."""

    def method_of(self, *arguments):
        return change(getattr(super(faulty, self), method), *arguments)

    faulty = type("Faulty", (Model,), {method: method_of, **others})
    return faulty


def scaled(word):
    """Return a class whose accelerations are a thousandth larger in models whose MJCF has a word."""

    def make(mjcf):
        return changed("acceleration", lambda own, *at: own(*at) * (1.001 if word in mjcf else 1.0))(mjcf)

    return make


def reference(self, q, v, u):
    return Model.acceleration(self, q, v, 1.01 * u)


FAULTS = (
    *map(scaled, ('jacobian="sparse"', 'island="disable"', 'solver="CG"')),
    changed("acceleration", lambda own, *at: own(*at) * (1 + 1e-4 * (np.arange(3) == 0))),
    changed("steps", lambda own, *at: [1.0001 * part for part in own(*at)]),
    changed("rollout", lambda own, q, v, controls: own(q, v, [controls[0]] * len(controls))),
    changed("acceleration", lambda own, q, v, u: own(q, 0 * v, u)),
    changed("acceleration", lambda own, q, v, u: own(q, v, u) * (1.0 if q[0] % 2e-3 < 1e-3 else 1.1)),
    changed("jacobian", lambda own, q, v, u: own(q, 0 * v, u)),
    changed("force", lambda own, q: own(q) + 0.01 * np.roll(q, 1)),
    changed("at", lambda own, *at: own(*at), reference=reference, remarks=("other bodies",)),
)


@pytest.mark.parametrize(("property", "engine"), list(zip(ALL, FAULTS, strict=True)), ids=ALL)
def test_a_planted_fault_breaks_its_property(property, engine):
    (row,) = metamorphic.check(engine, LOOP, property)
    assert row["holds"] is False
    assert row["worst"] > row["tolerance"]
    q, v, u = row["state"]
    assert (len(q), len(v), len(u)) == (3, 3, 1)
    assert row["reason"] == ("other bodies" if "reference" in property else "")


def test_what_a_model_or_an_engine_lacks_is_not_checked():
    class Bare:
        def __init__(self, mjcf):
            own = Model(mjcf)
            self.start, self.step, self.acceleration = own.start, own.step, own.acceleration

    rows = {row["property"]: row for row in metamorphic.check(Bare, CHAIN, steps=3)}
    assert rows["closed loops stay closed"]["holds"] is None
    assert "Model has no steps(q, v, u)" in rows["batch = single"]["reason"]
    assert rows["dense = sparse"]["holds"] is True
    assert rows["dense = sparse"]["states"] == 3


def test_files_that_a_model_includes_and_its_meshes_are_read(tmp_path):
    (tmp_path / "mesh").mkdir()
    (tmp_path / "mesh" / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    (tmp_path / "options.xml").write_text('<mujoco><compiler meshdir="mesh"/><option gravity="0 0 -2"/></mujoco>')
    (tmp_path / "model.xml").write_text(
        '<mujoco><include file="options.xml"/><asset><mesh name="a" file="a.obj"/></asset><worldbody>'
        '<body><joint axis="0 1 0"/><geom type="mesh" mesh="a"/></body></worldbody></mujoco>'
    )
    subject = metamorphic.Subject(Model, tmp_path / "model.xml", steps=2)
    assert subject.model.model.opt.gravity[2] == -2
    assert subject.model.model.nmesh == 1


def test_the_command_prints_each_property_and_fails_where_one_is_broken(capsys):
    assert main(["engines", "metamorphic", str(LOOP), "steps=6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("dense = sparse                     holds   ")


BALL = '<mujoco><worldbody><body><joint name="a" type="{}"/><geom size="1"/></body></worldbody>{}</mujoco>'
FILTER = '<actuator><general joint="a" dyntype="filter"/></actuator>'


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<mujoco><worldbody><body><geom", "unclosed token"),
        ('<robot name="a"><link name="b"/></robot>', "the file has no worldbody with joints"),
        ('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>', "the file has no worldbody with joints"),
        (BALL.format("hinje", ""), "invalid keyword: 'hinje'"),
        (BALL.format("hinge", FILTER), "actuators with activation states"),
    ],
)
def test_a_model_that_cannot_be_checked_breaks_no_property(text, reason, tmp_path, capsys):
    (tmp_path / "my robot, 1.xml").write_text(text)
    assert main(["engines", "metamorphic", str(tmp_path / "my robot, 1.xml")]) == 2
    assert reason in capsys.readouterr().err


def test_joints_that_the_engine_makes_break_no_property(tmp_path):
    """Their places among the positions are not in the file. A ground may be in a worldbody of its own."""
    text = BALL.format("free", "").replace("<mujoco>", "<mujoco><worldbody/>")
    twice = text.replace("<body>", '<replicate count="2"><body>').replace("</body>", "</body></replicate>")
    for copies, n_decided in ((text, 7), (twice, 5)):
        (tmp_path / "model.xml").write_text(copies)
        rows = list(metamorphic.check(Model, tmp_path / "model.xml", steps=3))
        assert not [row for row in rows if row["holds"] is False]
        assert sum(row["holds"] is True for row in rows) == n_decided


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("box_on_edge", ["corners within 1 mm"]),
        ("connect", ["velocity product J-dot v"]),
        ("weld", ["velocity product J-dot v"]),
        ("sparse_chain", ["corners within 1 mm", "friction pyramid of a capsule"]),
        ("stacked", []),
        ("joint_equality", []),
    ],
)
def test_what_mjx_lacks_is_remarked_from_the_model(case, words):
    import mujoco

    remarks = mjcf.mjx_remarks(mujoco.MjModel.from_xml_path(str(conformance.runner.FOLDER / f"{case}.xml")))
    assert len(remarks) == len(words)
    assert all(word in remark for word, remark in zip(words, remarks, strict=True))


def test_remarks_are_printed_once_before_anything_runs(capsys):
    """The cube's box is on a plane."""
    backend = by_name.make("backends", "mjx[iterations=20]")
    scene = by_name.make("scenes", "mjcf[file=cube.xml,theta=velocity,noise=parameter]")
    program = compose(scene, by_name.make("contacts", "penalty"), by_name.make("integrators", "semi_implicit_euler"))
    mjx._REMARKED.clear()
    assert [backend.refusal(program) for _ in range(2)] == [None, None]
    (line,) = capsys.readouterr().err.splitlines()
    assert "mjcf: MJX is not the C engine: boxes and meshes on planes touch only with corners within 1 mm" in line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("property", "text"),
    [
        ("closed loops stay closed", LOOP.read_text()),
        (
            "accelerations are continuous",
            '<mujoco><worldbody><geom type="plane" size="5 5 1"/><body pos="0 0 .0985"><freejoint/><geom type="box" '
            'size=".2 .15 .1"/></body></worldbody></mujoco>',
        ),
    ],
)
def test_what_mjx_lacks_is_found_without_a_reference(property, text, tmp_path):
    """The velocity product J-dot v, and contacts of corners above 1 mm over the deepest: were they repaired, the documentation would be wrong."""
    pytest.importorskip("mujoco.mjx")
    (tmp_path / "model.xml").write_text(text)
    (row,) = table.Engine("mjx").rows(metamorphic, str(tmp_path / "model.xml"), property)
    assert row["holds"] is False
    assert row["worst"] > 0.1
    assert "MJX is not the C engine: " in row["reason"]
