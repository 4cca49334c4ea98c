"""Claims: their verdicts can fail, their results are kept, and those of other packages are found."""

import json
import sys
from dataclasses import replace

import numpy as np
import planted_claims
import pytest
from trees import ROOT

from bench import cli
from bench.claims import Claim, Figure, Outcome, discovery, results
from bench.claims.claim import NOT_REPRODUCED, REPRODUCED, RESERVED, UNDECIDED, last_digit, verdict

STANDARD = ROOT / "results" / "standard" / "claims"
BLIND = {"C2": 6, "C8": 1, "C10": 1, "C14": 2, "C16": 6, "C17": 12}
"""Number of figures that cannot detect an error of 5%, since the published number is less precise. It must not grow."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "L4" else pytest.mark.slow if claim.quick else pytest.mark.full)
        for name, claim in discovery.claims().items()
    ],
)
def test_a_claim_is_reproduced_again_with_the_stored_figures(name):
    claim = discovery.claims()[name]
    again, stored = results.measure(claim), results.read(STANDARD, claim)
    assert again.verdict == stored.verdict
    for figure, before in zip(again.figures, stored.figures, strict=True):
        assert figure.measured == pytest.approx(before.measured, rel=1e-6, abs=1e-9 + 3 * figure.error), figure.what


def planted(figure):
    """The same figure with a wrong published number: off by 5%, by its sign, by a square."""
    value = figure.value
    wrongs = [value**2] if not 0.5 < abs(value) < 2 and figure.factor == 0 else []
    if figure.is_sensitive:
        wrongs += [1.05 * value, 0.95 * value]
    # a wrong number is printed as coarsely as the right one
    coarse = figure.spread + last_digit(figure.published) / 2
    return [replace(figure, published=f"{wrong:.9e}", spread=coarse) for wrong in [*wrongs, -value]]


def unnoticed(result):
    """The wrong numbers among a result's figures that leave the verdict as it was."""
    missed = []
    for i, figure in enumerate(result.figures):
        for wrong in planted(figure) if figure.value else [replace(figure, published="1.0")]:
            figures = [*result.figures[:i], wrong, *result.figures[i + 1 :]]
            if verdict(figures, result.remark) != NOT_REPRODUCED:
                missed.append(f"{result.name}: {figure.what} {figure.published} as {wrong.published}")
    return missed


@pytest.mark.parametrize("name", list(discovery.claims()))
def test_every_claim_holds_and_would_fail_with_a_wrong_figure(name):
    """By its stored result, which today's revisions would give."""
    result = results.read(STANDARD, discovery.claims()[name])
    assert result.verdict in (REPRODUCED, RESERVED), (result.remark, [f for f in result.figures if not f.agrees])
    assert unnoticed(result) == []
    assert sum(not figure.is_sensitive for figure in result.figures) == BLIND.get(name, 0)


@pytest.mark.parametrize(
    "bug",
    [
        pytest.param(bug, marks=pytest.mark.slow if bug == "kappa halved" else pytest.mark.full)
        for bug in planted_claims.BUGS
    ],
)
def test_a_planted_bug_fails_every_claim_about_it(bug):
    ((_, claims, failed),) = planted_claims.failing([bug])
    assert failed == claims


def test_a_figure_that_cannot_detect_5_percent_says_so_and_why():
    assert Figure("x", "1.00", 1.0, spread=0.02).is_sensitive
    for figure, why in (
        (Figure("x", "7", 7.0), "the printed digits"),
        (Figure("x", "1.00", 1.0, spread=0.1), "the source's own spread"),
        (Figure("x", "1.00", 1.0, error=0.02), "the measurement's error"),
        (Figure("x", "1e10", 2e10, factor=10.0), "heavy tails, compared by a factor of 10"),
    ):
        assert not figure.is_sensitive
        assert figure.limitation == why
        # and so it is with a number that is wrong by 5%
        assert replace(figure, published=f"{1.05 * figure.value:g}", spread=figure.spread + figure.tolerance).agrees
    assert not Figure("x", "0.00", 0.0).limitation


def test_a_claim_none_of_whose_figures_detects_5_percent_is_reserved_and_says_why(toy, tmp_path, monkeypatch):
    coarse = [Figure("one", "1.0", 1.0, spread=0.2), Figure("seven", "7", 7.0)]
    assert verdict(coarse) == RESERVED
    assert verdict([*coarse, Figure("fine", "2.000", 2.0)]) == REPRODUCED
    monkeypatch.setattr(toy, "measure", lambda self: Outcome(coarse))
    assert cli.main(["claims", f"results_dir={tmp_path}"]) == 0
    for name in ("claims.md", "claims.html", "claims.csv"):
        assert "the printed digits" in (tmp_path / "claims" / name).read_text()


def test_a_figure_agrees_within_its_digits_its_spread_and_its_errors():
    assert Figure("x", "34.085", 34.0854).agrees
    assert not Figure("x", "34.085", 34.0857).agrees
    assert Figure("x", "34.085", 34.09, error=0.002).agrees
    assert Figure("x", "0.494", 0.4965, spread=0.003).agrees
    assert Figure("x", "1e10", 3e9, factor=4.0).agrees
    assert not Figure("x", "1e10", -1e10, factor=4.0).agrees
    assert not Figure("x", "1.0", float("nan"), error=float("inf")).agrees


def test_what_cannot_fail_is_not_decidable():
    loose = Figure("x", "1.0", 1.1, error=1.0)
    assert verdict([loose]) == UNDECIDED
    assert verdict([loose, Figure("y", "2.0", 2.0)]) == REPRODUCED
    assert verdict([loose, Figure("y", "2.0", 2.0)], "but") == RESERVED
    assert verdict([loose, Figure("y", "2.0", 2.2)], "but") == NOT_REPRODUCED


class Toy(Claim):
    """A claim that counts how often it is measured."""

    name, lesson, statement, source, learned = "T1", "Tests", "one is one", "here", "that it is"
    calls = 0
    value = 1.0

    def measure(self):
        type(self).calls += 1
        if self.value is None:
            raise ValueError("no value")
        return Outcome([Figure("one", "1.00", self.value)], series={"x": [0, 1], "y": [0, 1]})


@pytest.fixture
def toy(monkeypatch):
    monkeypatch.setattr(discovery, "claims", lambda: {"T1": Toy})
    monkeypatch.setattr(Toy, "calls", 0)
    return Toy


def test_results_are_kept_and_measured_again_when_asked(toy, tmp_path, capsys):
    words = ["claims", "t1", f"results_dir={tmp_path}"]
    assert cli.main(words) == 0
    assert cli.main(words) == 0
    assert toy.calls == 1
    assert "as stored" in capsys.readouterr().out
    assert cli.main([*words, "--again"]) == 0
    assert toy.calls == 2
    names = {path.name for path in (tmp_path / "claims").iterdir()}
    assert {"T1.json", "T1.png", "claims.md", "claims.csv", "claims.html"} <= names
    assert "one is one" in (tmp_path / "claims" / "claims.html").read_text()


def test_a_spoilt_file_or_other_code_is_measured_again(toy, tmp_path):
    words = ["claims", f"results_dir={tmp_path}"]
    cli.main(words)
    path = tmp_path / "claims" / "T1.json"
    path.write_text(path.read_text()[:50])
    cli.main(words)
    assert toy.calls == 2
    path.write_text(json.dumps(json.loads(path.read_text()) | {"key": "of other code"}))
    cli.main(words)
    assert toy.calls == 3


def test_a_wrong_claim_and_a_broken_one_give_exit_status_1(toy, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(toy, "value", 1.05)
    assert cli.main(["claims", f"results_dir={tmp_path}"]) == 1
    assert "published 1.00, measured 1.05" in capsys.readouterr().out
    monkeypatch.setattr(toy, "value", None)
    assert cli.main(["claims", "--again", f"results_dir={tmp_path}"]) == 1
    assert "ValueError: no value" in capsys.readouterr().out
    assert "no value" in (tmp_path / "claims" / "claims.html").read_text()


def test_names_options_and_folders_are_checked(capsys):
    for words, said in (
        (["C33"], "'C3'"),
        (["--fast"], "--quick"),
        (["folder=x"], "results_dir"),
        (["results_dir="], "results_dir"),
    ):
        assert cli.main(["claims", *words]) == 2
        assert said in capsys.readouterr().err
    assert cli.main(["claims", "--list", "--quick"]) == 0
    assert "C19" in capsys.readouterr().out


OF_ANOTHER = """
from bench.claims import Claim, Figure, Outcome


class Mine(Claim):
    name, lesson, statement, source, learned = "M1", "My lesson", "two is two", "my package", "that it is"

    def measure(self):
        return Outcome([Figure("two", "2.00", 2.0)], series={"x": [0, 1], "y": [0, 1]})
"""


def test_a_claim_in_a_plugin_folder_is_found(tmp_path, capsys):
    """Directly in the folder, or in its folder ``claims``; what is broken there is reported and hides nothing."""
    own = tmp_path / "own"
    (own / "claims").mkdir(parents=True)
    (own / "claims" / "mine.py").write_text(OF_ANOTHER)
    (own / "also.py").write_text(OF_ANOTHER.replace("M1", "M2"))
    (own / "broken.py").write_text("import no_such_module")
    (own / "bare.py").write_text(OF_ANOTHER.replace('"M1", "My lesson"', '"M3", None'))
    (own / "again.py").write_text(OF_ANOTHER.replace("M1", "C1"))
    place = [f"plugins={own}", f"results_dir={tmp_path}"]
    assert cli.main(["claims", "m1", "M2", *place]) == 0
    printed = capsys.readouterr()
    assert printed.out.count("two is two") == 2
    assert "'broken' cannot be used: import failed: ModuleNotFoundError" in printed.err
    assert "claim 'M3' does not define lesson" in printed.err
    assert "'C1' cannot be used: the name is taken by bench.plugins.claims.step" in printed.err
    assert cli.main(["claims", "M1", *place]) == 0
    assert "as stored" in capsys.readouterr().out
    assert cli.main(["claims", "--list", *place]) == 0
    assert "My lesson" in capsys.readouterr().out


def test_an_installed_package_brings_claims_by_its_entry_points_and_a_broken_one_hides_no_other(
    tmp_path, monkeypatch, capsys
):
    """An entry point names a module of claims, or a claim."""
    made = tmp_path / "mine-1.0.dist-info"
    made.mkdir()
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    names = "mine = claims_of_mine\nother = claims_of_other:Mine\nbad = no_such_module\nodd = builtins:int"
    (made / "entry_points.txt").write_text(f"[bench.claims]\n{names}\n")
    for name, claim in (("mine", "M1"), ("other", "M2")):
        (tmp_path / f"claims_of_{name}.py").write_text(OF_ANOTHER.replace("M1", claim))
        monkeypatch.delitem(sys.modules, f"claims_of_{name}", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    assert cli.main(["claims", "M1", "M2", f"results_dir={tmp_path}"]) == 0
    printed = capsys.readouterr()
    assert printed.out.count("two is two") == 2
    assert "My lesson" in (tmp_path / "claims" / "claims.html").read_text()
    assert list(discovery.claims())[-2:] == ["M1", "M2"], "lessons of others follow those of the course"
    assert "'bad' cannot be used: import failed: ModuleNotFoundError: No module named 'no_such_module'" in printed.err
    assert "'odd' cannot be used: import failed: TypeError: builtins:int is not a plugin class" in printed.err


def test_every_claim_says_what_where_and_why():
    for name, claim in discovery.claims().items():
        assert claim.lesson in discovery.LESSONS, name
        assert all((claim.statement, claim.source, claim.learned, claim.quantity)), name


def test_measured_intervals_of_sampled_moments_cover():
    from bench.claims.toolkit import spread

    draw = np.random.default_rng(0)
    z = []
    for _ in range(200):
        variance, error = spread(draw.standard_normal((2000, 2)))
        z.append((variance - 2.0) / error)
    assert np.std(z) == pytest.approx(1.0, abs=0.2)  # 0.2: 200 draws, Student with 49 degrees
