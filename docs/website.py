"""Build the site: sources from the documents, the standard results and the docstrings, then HTML by Sphinx."""

from __future__ import annotations

import inspect
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import pandas as pd
from bench.plugins.studies.bias_variance.comparisons import FAILS, OPEN

import bench
import bench.plugin
from bench.errors import UserError
from bench.host.parameters import parameters
from bench.model import registry
from bench.report.tables import escape_markdown
from bench.report.text import number
from docs.figures import without_marks
from docs.results import ROOT, STANDARD, Entry, comparison, entries_of

DOCS = ROOT / "docs"

PAGES: Mapping[str, str] = {
    "start": "README.md",
    "contributing": "CONTRIBUTING.md",
    "changelog": "CHANGELOG.md",
    "cost-of-error": "examples/cost_of_error/README.md",
    "atlas": "examples/atlas/README.md",
    **{path.stem: f"docs/{path.name}" for path in sorted(DOCS.glob("*.md"))},
}
"""The site's page of each document, and its path in the repository."""
SECTIONS: Mapping[str, Sequence[str]] = {
    "start": ("reading-results", "python"),
    "trust": ("gradcheck", "examine", "watch", "conformance", "atlas"),
    "results": (
        "experiment/*",
        "estimators",
        "methods",
        "claims",
        "controller",
        "dose-response",
        "cost-of-error",
        "training",
        "engines",
        "speed",
    ),
    "extending": ("architecture", "contributing"),
    "reference": (
        "commands",
        "experiments",
        "columns",
        "api",
        "machines",
        "ci",
        "glossary",
        "peers",
        "validation",
        "sources",
        "changelog",
    ),
}
"""The five entries of the site and the pages below each."""
TITLES = {"start": "Start", "trust": "Is my gradient right?", "results": "Results", "extending": "Extend"}
"""Titles of the entries in the navigation where they differ from their page's heading."""
MODULES = bench, bench.plugin
EXAMPLES = "python", "examine", "extending", "training", "claims"
"""The modules with public names, and the documents that show them in use."""


def build(out: Path, results: Path = STANDARD) -> Path:
    """Build the site into ``out/html`` and return its first page; raises :class:`UserError` if Sphinx has warnings."""
    source = out / "source"
    shutil.rmtree(out, ignore_errors=True)
    source.mkdir(parents=True)
    (source / "repo").symlink_to(ROOT)
    (source / "data").symlink_to(results.resolve())
    for name, text in sources(results).items():
        path = source / f"{name}.md"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    words = ["-b", "html", "-c", DOCS, "-W", "--keep-going", "-q", "-j", "2", source, out / "html"]
    if subprocess.run([sys.executable, "-m", "sphinx", *map(str, words)], cwd=ROOT).returncode:
        raise UserError("the site has warnings: see above")
    return out / "html" / "index.html"


def sources(results: Path = STANDARD) -> dict[str, str]:
    """Return the Markdown text of every page of the site, by its name without suffix."""
    found = [entry for entry in entries_of(results) if entry.has_results]
    pages = {name: localise(without_marks((ROOT / path).read_text()), Path(path)) for name, path in PAGES.items()}
    pages |= {entry.page: experiment_page(entry) for entry in found}
    pages |= {f"estimator/{name}": text for name, text in estimator_pages(results).items()}
    pages |= claim_pages(results)
    pages["estimators"] = estimators_page(results)
    pages |= api_pages()
    pages["reference"] = "# Reference\n"
    pages["index"] = home_page()
    for parent, children in SECTIONS.items():
        names = [name for child in children for name in expand(child, pages)]
        pages[parent] += toctree(names, hidden=parent != "reference")
    pages["estimators"] += toctree(expand("estimator/*", pages))
    pages["claims"] += toctree(expand("claim/*", pages))
    pages["api"] += toctree(expand("api/*", pages))
    pages["index"] += toctree([f"{TITLES[name]} <{name}>" if name in TITLES else name for name in SECTIONS])
    return pages


def expand(name: str, pages: Iterable[str]) -> list[str]:
    """Return the pages that a name stands for: itself, or for ``folder/*`` all pages of the folder."""
    natural = [page for page in pages if name.endswith("*") and page.startswith(name[:-1])]
    return sorted(natural, key=lambda page: (re.sub(r"\d+", "", page), len(page), page)) or [name] * (name[-1] != "*")


def toctree(names: Sequence[str], hidden: bool = True) -> str:
    """Return a table of contents of other pages, which Sphinx also uses for the navigation."""
    options = "\n".join([":hidden:"] * hidden + [":maxdepth: 1"])
    return "\n\n```{toctree}\n" + options + "\n\n" + "\n".join(names) + "\n```\n"


# ------------------------------------------------------------------------------------------------------------ links


def localise(text: str, page: Path) -> str:
    """Return a document with links to files of the repository turned into links of the site.

    ``page`` is the document's path in the repository. A link to a document leads to its page, and a link to another
    file to a copy of that file. A link to the folder of an experiment leads to its page, and one to another folder becomes plain text.
    """
    names = {(ROOT / path).resolve(): name for name, path in PAGES.items()}

    def link(match: re.Match[str]) -> str:
        mark, label, target = match.groups()
        address, _, anchor = target.partition("#")
        path = (ROOT / page).parent.joinpath(address).resolve()
        if not address or ":" in address:
            return match[0]
        if path in names:
            return f"{mark}[{label}]({names[path]}.md{'#' * bool(anchor)}{anchor})"
        if path.is_dir():
            return f"[page and data](experiment/{path.name}.md)" if path.parent == STANDARD else label
        file = f"/repo/{path.relative_to(ROOT)}"
        return f"![{label}]({file})" if mark else download(label, file)

    pattern = re.compile(r"(!?)\[([^\[\]]*)\]\(([^)\s]+)\)")
    parts = re.split(r"(^```.*?^```$)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if part.startswith("```") else pattern.sub(link, part) for part in parts)


def download(label: str, file: str) -> str:
    """Return a link to a copy of a file, a path from the root of the sources."""
    return f"{{download}}`{label.replace('`', '')} <{file}>`"


# ------------------------------------------------------------------------------------------------------------ pages


def home_page() -> str:
    """Return the first page: the opening of the README, the five entries, and the results by question."""
    readme = without_marks((ROOT / PAGES["start"]).read_text())
    opening = readme.partition("\n## ")[0].strip()
    lines = [
        "- [Start](start.md): install, run, read the main result",
        "- [Is my gradient right?](trust.md) When to trust a gradient, and how to check your own",
        "- [Results](results.md): what each experiment found, with its chart, command and data",
        "- [Extend](extending.md): add an estimator, a scene, a backend or a study",
        "- [Reference](reference.md): commands, columns, Python interface, validation",
    ]
    index = (ROOT / PAGES["results"]).read_text().partition("\n## ")[0]
    questions = [line.replace("](#", "](results.md#") for line in index.splitlines() if line.startswith("|")]
    return "\n".join(
        [localise(opening, Path("README.md")), "", *lines, "", "## Results by question", "", *questions, ""]
    )


def experiment_page(entry: Entry) -> str:
    """Return the page of one experiment: question, answer, chart, command, tables and links to its data."""
    folder = f"/data/{entry.folder.name}"
    parts = [f"# {entry.name}", escape_markdown(entry.question)]
    if entry.answer:
        parts.append(f"{{.finding}}\n{escape_markdown(entry.answer)}")
    if entry.chart:
        parts.append(picture(entry.chart, entry.question))
    parts += ["## Run it", f"    {entry.command}", "Or write its page from the stored rows:"]
    parts += [f"    {entry.command.replace('bench', 'bench report', 1)} results_dir=results/standard", entry.made]
    for path in entry.tables:
        table = short_tables(path.read_text())
        parts.append(f"## {path.stem.replace('_', ' ').capitalize()}\n\n{table}" if table else "")
    if more := [path for path in entry.charts if path != entry.chart]:
        parts.append("## More charts")
        parts += [f"### {path.stem.replace('_', ' ')}\n\n{picture(path, path.stem)}" for path in more]
    parts += [
        "## Data",
        "\n".join(f"- {download(path.name, f'{folder}/{path.name}')}: {text}" for path, text in entry.data()),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def picture(path: Path, description: str) -> str:
    """Return a chart of an experiment."""
    return f"![{escape_markdown(description)}](/data/{path.parent.name}/{path.name})"


LONGEST = 30
"""Most rows of a table that a page shows."""


def short_tables(text: str) -> str:
    """Return the tables and notes of a Markdown file without its title.

    Headings become bold lines, and of a table with more than :data:`LONGEST` rows the first ones are shown.
    """
    text = re.sub(r"\A# .*\n", "", text)
    lines: list[str] = []
    count = 0
    for line in text.splitlines():
        count = count + 1 if line.startswith("|") else 0
        if line.startswith("#"):
            lines.append(f"**{line.lstrip('# ')}**")
        elif count <= LONGEST + 2:
            lines.append(line)
        elif count == LONGEST + 3:
            lines += ["", "The file has further rows.", ""]
    return "\n".join(lines).strip()


def claim_pages(results: Path) -> dict[str, str]:
    """Return a page per published claim with a stored result: statement, verdict, figures, chart and command."""
    path = results / "claims" / "claims.md"
    sections = re.split(r"^##+ ", path.read_text() if path.exists() else "", flags=re.MULTILINE)
    pages = {}
    for section in sections:
        name = section.partition(":")[0]
        if (picture := path.with_name(f"{name}.png")).exists():
            title, _, text = section.partition("\n")
            image = f"![The chart of {name}](/data/claims/{picture.name})"
            data = f"Data: {download(f'{name}.json', f'/data/claims/{name}.json')}"
            pages[f"claim/{name}"] = "\n\n".join([f"# {title}", text.strip(), image, data]) + "\n"
    return pages


# ------------------------------------------------------------------------------------------------------- estimators


def estimator_pages(results: Path) -> dict[str, str]:
    """Return a page per estimator: what it is, its parameters, and where it is best and where it fails."""
    table = comparison(results)
    pages = {}
    for name, entry in sorted(registry.entries()["estimators"].items()):
        if entry.plugin is not None:
            pages[name] = estimator_page(name, entry.plugin, table[table["estimator"] == name])
    return pages


def estimator_page(name: str, plugin: Any, table: pd.DataFrame) -> str:
    """Return the page of one estimator."""
    parts = [f"# {name}", markdown(plugin.__doc__ or ""), facts(plugin)]
    if sources := cited(plugin.__doc__ or ""):
        parts.append("## Source\n\n" + "\n".join(f"- {source}" for source in sources))
    if parameters := registry_parameters(plugin):
        head = "| parameter | default | meaning |\n|---|---|---|\n"
        parts.append("## Parameters\n\n" + head + "\n".join(parameters))
    if table.empty:
        parts.append(
            "## Where it wins and fails\n\nIt is not in the experiment [estimators](../experiment/estimators.md)."
        )
    else:
        parts += ["## Where it wins and fails", summary(table), comparison_table(table)]
        parts.append(
            "Relative RMSE of one estimate with its 95% interval, as measured in the experiment "
            "[estimators](../experiment/estimators.md). *best*: at equal rollouts not distinguishable from the lowest of all "
            "settings of all estimators on that problem. *works* or *fails*: the whole interval is below or above 1, the error of the zero estimate. *open*: "
            "the interval contains 1. *biased*: more than half of the squared error is bias. Evaluations are costs and "
            "gradients per sample."
        )
    return "\n\n".join(parts) + "\n"


def facts(plugin: Any) -> str:
    """Return what an estimator needs and whether it is unbiased, as declared and verified by the conformance kit."""
    words = {"value": "costs", "grad": "gradients", "score": "scores"}
    needs = ", ".join(words.get(need, need) for need in ("value", "grad", "score") if need in plugin().needs)
    jumps = "also for costs with jumps" if plugin.unbiased_at_discontinuities else "for costs without jumps"
    unbiased = f"unbiased, {jumps}" if plugin.unbiased else "biased"
    return f"- Needs: {needs}\n- Declared: {unbiased}\n- Check: `python -m bench check {plugin.name}`"


def registry_parameters(plugin: Any) -> list[str]:
    """Return a Markdown table row per parameter of a plugin."""
    return [
        f"| `{p.name}` | `{'null' if p.default is None else p.default}` | {cell(p.doc)}{f' [{p.unit}]' if p.unit else ''} |"
        for p in parameters(plugin).values()
    ]


def cell(text: str) -> str:
    """Return text on one line for a cell of a Markdown table."""
    return escape_markdown(" ".join(text.split()))


def summary(table: pd.DataFrame) -> str:
    """Return where an estimator is best, fails or is open at its best setting, as sentences."""
    lowest = at_best_setting(table)
    groups = {"Best or level with the best": lowest["best"], "Fails at every setting": lowest["verdict"] == FAILS}
    groups |= {"Open": lowest["verdict"] == OPEN}
    names = {words: "; ".join(map(cell, lowest["problem"][keep])) or "nowhere" for words, keep in groups.items()}
    return " ".join(f"{words}: {problems}." for words, problems in names.items())


def at_best_setting(table: pd.DataFrame) -> pd.DataFrame:
    """Return one row per estimator and problem, that with the lowest error; without rows that have no error."""
    good = table[table["rmse_rel"].notna()]
    return good.loc[good.groupby(["estimator", "problem"], sort=False)["rmse_rel"].idxmin()]


def comparison_table(table: pd.DataFrame) -> str:
    """Return an estimator's errors as Markdown, one row per problem and setting, the lowest error of a problem first."""
    lines = ["| problem | setting | relative RMSE | verdict | evaluations |", "|---|---|--:|---|--:|"]
    for problem, part in table.groupby("problem", sort=False):
        for row in part.sort_values("rmse_rel").to_dict("records"):
            setting = cell(row["estimator_params"].replace(",", ", ")) or "default"
            error = f"{number(row['rmse_rel'])} [{number(row['low'])}, {number(row['high'])}]"
            error = f"< {number(row['rmse_rel'])}" if row.get("error_is_limit") else error
            verdict = ", ".join(filter(None, ["best" * row["best"], row["verdict"], "biased" * row["biased"]]))
            texts = [error, verdict, number(row["evaluations"])] if row["status"] == "ok" else ["", row["status"], ""]
            lines.append(f"| {cell(str(problem))} | " + " | ".join([setting, *texts]) + " |")
    return "\n".join(lines)


def cited(text: str) -> list[str]:
    """Return the entries of docs/sources.md whose first author and year a docstring names."""
    entries = re.findall(r"^- (.+)$", (DOCS / "sources.md").read_text(), re.MULTILINE)
    found = []
    for entry in entries:
        match = re.match(r"([\w-]+).*?(\d{4})", entry)
        if match and re.search(rf"{match[1]}\b[^()]*?{match[2]}", " ".join(text.split())):
            found.append(entry)
    return found


def estimators_page(results: Path) -> str:
    """Return the table of all estimators: what each needs, and its worst case."""
    table = comparison(results)
    lines = ["| estimator | what it is | needs | best on | fails on |", "|---|---|---|--:|--:|"]
    for name, entry in sorted(registry.entries()["estimators"].items()):
        if entry.plugin is None:
            continue
        plugin = cast(Any, entry.plugin)
        lowest = at_best_setting(table[table["estimator"] == name])
        counts = [f"{keep.sum()} of {len(lowest)}" for keep in (lowest["best"], lowest["verdict"] == FAILS)]
        what = " ".join(markdown((plugin.__doc__ or "").partition("\n\n")[0]).replace("|", "\\|").split())
        lines.append(
            f"| [{name}](estimator/{name}.md) | {what} | {', '.join(sorted(plugin().needs))} | "
            + " | ".join(counts)
            + " |"
        )
    return (
        "# Estimators\n\nEach estimator at its best setting, on one problem of each class, from the experiment "
        "[estimators](experiment/estimators.md).\n\n" + "\n".join(lines) + "\n"
    )


# ------------------------------------------------------------------------------------------------------------- API


def api_pages() -> dict[str, str]:
    """Return the page of the Python interface and one per public name, which Sphinx writes from its docstring."""
    pages = {
        "api": "# Python interface\n\nA page per public name. [Python](python.md) shows the functions in use, and "
        "[Extend](extending.md) the contracts.\n\nArrays are component-first and batch-last: B is the batch, d the length of "
        "theta, n_w the length of a sample's noise, R the number of estimates and N the samples in each.\n"
    }
    public = [(f"{module.__name__}.{name}", getattr(module, name)) for module in MODULES for name in names_of(module)]
    returned = {value for name in names_of(bench) for value in annotated_classes(getattr(bench, name))}
    public += sorted((f"{value.__module__}.{value.__qualname__}", value) for value in returned)
    seen: set[int] = set()
    for name, value in public:
        entry = directive(name, value)
        if entry and id(value) not in seen:
            last = name.rpartition(".")[2]
            doc = attribute_doc(last) if entry.startswith(".. py:data") else (value.__doc__ or "").partition("\n\n")[0]
            uses = [
                f"[{page}](../{page}.md)"
                for page in EXAMPLES
                if re.search(rf"\b{last}\b", (DOCS / f"{page}.md").read_text())
            ]
            shown = f"\nShown in {', '.join(uses)}.\n" if uses else ""
            pages[f"api/{name}"] = f"# {last}\n\n```{{eval-rst}}\n{entry}```\n{shown}"
            pages["api"] += f"\n- [{name}](api/{name}.md): {' '.join(markdown(doc).split())}"
        seen.add(id(value))
    return pages


def names_of(module: ModuleType) -> list[str]:
    """Return the public names of a module, functions first, then classes."""
    names = {name for name in (*module.__all__, *dir(module)) if not name.startswith("_")}
    names = {name for name in names if name in module.__all__ or inspect.isroutine(getattr(module, name))}
    return sorted(names, key=lambda name: (isinstance(getattr(module, name), type), name.lower()))


def annotated_classes(value: Any) -> set[type]:
    """Return the classes of this package that the annotations of a function name, also those imported for types only."""
    names = set(re.findall(r"\b[A-Z]\w+", " ".join(map(str, getattr(value, "__annotations__", {}).values()))))
    modules = [vars(module) for name, module in sorted(sys.modules.items()) if name.partition(".")[0] == "bench"]
    found = (module.get(name) for module in modules for name in names)
    return {item for item in found if isinstance(item, type) and item.__module__.partition(".")[0] == "bench"}


def directive(name: str, value: Any) -> str:
    """Return the reStructuredText directive that documents a public name; empty for a module."""
    if isinstance(value, type):
        kind = "exception" if issubclass(value, BaseException) else "class"
        return f".. auto{kind}:: {name}\n   :members:\n   :undoc-members:\n   :show-inheritance:\n"
    if inspect.isroutine(value):
        return f".. autofunction:: {name}\n"
    doc = attribute_doc(name.rpartition(".")[2])
    return "" if isinstance(value, ModuleType) else f".. py:data:: {name}\n\n   {doc}\n"


def attribute_doc(name: str) -> str:
    """Return the string after the assignment of a public name that is neither a class nor a function, on one line."""
    from sphinx.pycode import ModuleAnalyzer

    for module in sorted(module for module in sys.modules if module.startswith("bench.")):
        if name in vars(sys.modules[module]):
            analyzer = ModuleAnalyzer.for_module(module)
            analyzer.analyze()
            if lines := analyzer.attr_docs.get(("", name)):
                return " ".join(" ".join(lines).split())
    return ""


def markdown(text: str) -> str:
    """Return a docstring with its roles and double backticks as Markdown code."""
    text = inspect.cleandoc(text)
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`")
