"""The generated pages of the documents are up to date, and an experiment without rows keeps its gallery entry."""

import importlib
from pathlib import Path

import pytest

from bench import cli
from bench.errors import UserError
from bench.experiment import config

ROOT = Path(__file__).resolve().parent.parent
RUN = (
    "name=mine", "scenes=[heaviside]", "backends=[numpy]", "estimators=[fobg,randomized_smoothing]",
    "sweep.sigma=[0.05,0.1]", "samples=8", "repeats=4", "reference.samples=4096",
)  # fmt: skip


@pytest.fixture(scope="module")
def build():
    """The module ``docs/build.py``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "docs")
        return importlib.import_module("build")


@pytest.mark.parametrize("name", ["columns", "api"])
def test_page_is_up_to_date(build, name):
    file, generate = build.PAGES[name]
    assert (ROOT / "docs" / file).read_text() == generate(), f"run: python docs/build.py {name}"


def test_gallery_has_the_finding_and_keeps_entries_without_rows(build, tmp_path, monkeypatch):
    assert cli.main([*RUN, f"results_dir={tmp_path}"]) == 0
    words = {"experiment=absent": ["name=absent"], "experiment=mine": RUN}
    monkeypatch.setattr(config, "experiments", lambda: ["absent", "mine"])
    monkeypatch.setattr(config, "load", lambda given, load=config.load: load([*words[given[0]], given[1]]))
    page = tmp_path / "gallery.md"
    page.write_text(f"before {build.MARKS[0]}\n\n### `absent`\n\nkept\n{build.MARKS[1]} after")
    text = build.gallery_page(page, tmp_path)
    assert text.startswith("before ")
    assert text.endswith(" after")
    assert "### `absent`\n\nkept\n" in text
    assert "at equal rollouts" in text
    assert "![mine](mine/bias_variance_sigma.png)" in text
    page.write_text(text)
    assert build.gallery_page(page, tmp_path) == text


def test_gallery_needs_its_marks(build, tmp_path):
    page = tmp_path / "gallery.md"
    page.write_text("no marks")
    with pytest.raises(UserError, match="has no place for the gallery"):
        build.gallery_page(page, tmp_path)


def test_unknown_page_is_refused(build):
    with pytest.raises(UserError, match="unknown page 'pages' \\(allowed: gallery, columns, api, all\\)"):
        build.main(["pages"])
