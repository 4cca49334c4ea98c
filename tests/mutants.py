"""Plants one-line faults in the core and reports which a test kills: `python tests/mutants.py [words of file or fault]`.

Each fault is planted in a copy of the tree, in a process forked after the libraries are loaded, and the tests named beside
it run until one fails. Run by hand: it takes some minutes.
"""

from __future__ import annotations

import os
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

CPU, MEMORY = 40, 6 << 30
"""Seconds and bytes that the tests of one fault may take."""
ROOT = Path(__file__).resolve().parents[1]
COPIED = ("bench", "plugins", "conf", "tests", "docs", "README.md", "CONTRIBUTING.md", "pyproject.toml")


class Fault(NamedTuple):
    """A text in a file, what it becomes, and the tests that should notice."""

    path: str
    old: str
    new: str
    tests: str


R, Q, S = "bench/measure/reference.py", "bench/measure/quadrature.py", "bench/measure/statistics.py"
J, B, N = "bench/measure/jumps.py", "bench/measure/batches.py", "bench/measure/noise.py"
P, E = "bench/model/program.py", "bench/model/estimator.py"
OF_REFERENCE = "tests/measure/test_reference.py"
OF_STATISTICS = "tests/measure/test_statistics.py tests/measure/test_unexplained.py"
OF_SCORES = "tests/model/test_explicit.py"
OF_WEIGHTS = "tests/plugins/test_weights.py"

FAULTS = [
    # quadrature
    Fault(Q, "gradients.append(nodes[:dim] @ (weights * (f - centre)) / problem.sigma)", "gradients.append(nodes[:dim] @ (weights * (f - centre)))", OF_REFERENCE),
    Fault(Q, "inner = [(b - theta[i]) / problem.sigma for b", "inner = [(b - theta[i]) for b", OF_REFERENCE),
    Fault(Q, "inner = [(b - theta[i]) / problem.sigma for b", "inner = [b / problem.sigma + 1e-3 for b", OF_REFERENCE),
    Fault(Q, "max(SAFETY * spread, change)", "spread * 1e-3", OF_REFERENCE),
    Fault(Q, "count >= LEAST[width] and error", "error", OF_REFERENCE),
    Fault(Q, "    error += rounding + (", "    error += 0.0 * (", OF_REFERENCE),
    Fault(Q, "SHIFTS = {1: ((0.0, 0.5, 0.25, 0.75),)", "SHIFTS = {1: ((0.0, 0.0, 0.0, 0.0),)", OF_REFERENCE),
    Fault(Q, "if count > points:", "if False:", OF_REFERENCE),
    Fault(Q, "np.exp(-(nodes**2) / 2) / math.sqrt(2 * math.pi)", "np.exp(-(nodes**2) / 2) / 2.5", OF_REFERENCE),
    Fault(Q, "panels *= 2", "panels *= 1", OF_REFERENCE),
    Fault(Q, "REACH = 9.0", "REACH = 2.5", OF_REFERENCE),
    # sampling
    Fault(R, "w = _draw(problem, \"reference\", BATCHES * size, count)", "w = _draw(problem, \"reference\", BATCHES * size, 0)", OF_REFERENCE),
    Fault(R, "_draw(problem, \"check\", count, 0)", "_draw(problem, \"reference\", count, 0)", OF_REFERENCE),
    Fault(R, "se = math.sqrt(batches.var(axis=0, ddof=1).sum() / BATCHES)", "se = math.sqrt(batches.var(axis=0, ddof=1).sum()) / BATCHES / 2", OF_REFERENCE),
    Fault(R, "count * BATCHES >= LEAST_SAMPLES", "True", OF_REFERENCE),
    Fault(R, "spent = 2 * count * BATCHES > samples", "spent = count * BATCHES > samples", OF_REFERENCE),
    Fault(R, "batches = (batches * count + means * size) / (count + size)", "batches = (batches + means) / 2", OF_REFERENCE),
    Fault(R, "    return share * float(", "    return 0.0 * float(", OF_REFERENCE),
    Fault(R, "depth = -ndtri(0.5 * share * middle)", "depth = -ndtri(0.5 * middle)", OF_REFERENCE),
    Fault(R, "    if jump:\n", "    if False:\n", OF_REFERENCE),
    Fault(R, "    if at[REFUSED]:", "    if False:", OF_REFERENCE),
    Fault(R, "    if doubt and \"zeroth_order\" in pilots:", "    if False:", OF_REFERENCE),
    Fault(R, "2.0 * math.sqrt(trace):.2g}]\"", "2.0 * trace:.2g}]\"", OF_REFERENCE),
    Fault(R, "if program.contact is not None and not program.contact.continuous:", "if False:", OF_REFERENCE),
    Fault(R, "return not program.continuous and not any(program.breakpoints())", "return False", OF_REFERENCE),
    Fault(R, "problem.score(theta, s) + problem.explicit(theta, s) for s", "problem.score(theta, s) for s", OF_SCORES),
    Fault(R, "return np.asarray(sum(terms) / 2)", "return np.asarray(sum(terms))", OF_REFERENCE),
    Fault(R, "closed = None if \"physics\" in provides else", "closed =", OF_REFERENCE),
    Fault(R, "return sampled if 0.0 < sampled", "return sampled if sampled", OF_REFERENCE),
    Fault(R, "return Truth.from_batches(self.batches, self.error)", "return Truth.from_batches(self.batches)", OF_REFERENCE),
    Fault(R, "chosen, doubt = min(spread", "chosen, doubt = max(spread", OF_REFERENCE),
    Fault(R, "reshape(problem.dim, BATCHES, size).mean(axis=2).T", "reshape(problem.dim, size, BATCHES).mean(axis=1).T", OF_REFERENCE),
    # jumps, batches, noise
    Fault(J, "changes[-1] > 0.1 * changes[-2] and", "", OF_REFERENCE),
    Fault(J, "max(NO_JUMP * span, LOUD * noise)", "0.0", OF_REFERENCE),
    Fault(J, "np.argsort(bends, axis=None)[-SUSPECTS:]", "np.argsort(bends, axis=None)[:SUSPECTS]", OF_REFERENCE),
    Fault(B, "[..., :count]", "", OF_REFERENCE),
    Fault(N, "zlib.crc32(stream.encode())", "0", OF_REFERENCE),
    # statistics
    Fault(S, "doubt = sum(error.trace**2 / error.degrees", "doubt = sum(error.trace / error.degrees", OF_STATISTICS),
    Fault(S, "ndtri(probability) if math.isinf(degrees) else stdtrit(degrees, probability)", "ndtri(probability)", OF_STATISTICS),
    Fault(S, "math.sqrt(count * (count - 1)), count - 1)", "math.sqrt(count * count), count - 1)", OF_STATISTICS),
    Fault(S, "math.sqrt(repeats * (repeats - 1)), repeats - 1)", "math.sqrt(repeats * repeats), repeats - 1)", OF_STATISTICS),
    Fault(S, "bias_rel=bias / relative,", "bias_rel=bias / max(norm, float(np.linalg.norm(mean))),", OF_STATISTICS),
    Fault(S, "rmse_rel=rmse / relative,", "rmse_rel=rmse * unit / relative,", OF_STATISTICS),
    Fault(S, "return raw - min(max(unbiased, trace**2 / self.rows.shape[1]), trace**2)", "return 0.0", OF_STATISTICS),
    Fault(S, "scale = (square + 2.0 * along) / (1.0 + 2.0 * power)", "scale = (square + along) / (1.0 + power)", OF_STATISTICS),
    Fault(S, "once = float(image @ image)  # m'Sm", "once = total  # m'Sm", OF_STATISTICS),
    Fault(S, "seen, end = max(total, 1.0), max(end, 1.0) + limit", "seen, end = total, max(end, 1.0) + limit", OF_STATISTICS),
    Fault(S, "h = 1.0 - 2.0 / 3.0 * first * third / second**2", "h = 1.0 / 3.0", OF_STATISTICS),
    Fault(S, "left = total - squares * repeats / max(repeats - 1, 1)", "left = total - squares", OF_STATISTICS),
    Fault(S, "variance = float(np.vdot(deviations, deviations)) / (repeats - 1)", "variance = float(np.vdot(deviations, deviations)) / repeats", OF_STATISTICS),
    Fault(S, "squared_error = float(np.vdot(errors, errors)) / repeats - reference.standard_error**2", "squared_error = float(np.vdot(errors, errors)) / repeats", OF_STATISTICS),
    Fault(S, "bias_low, bias_high = bias_low - rare * size, bias_high + rare * size", "pass", OF_STATISTICS),
    Fault(S, "if unbiased and bias_low > 0.0:", "if bias_low > 0.0:", OF_STATISTICS),
    Fault(S, "CONCENTRATION = 0.75", "CONCENTRATION = 0.2", OF_STATISTICS),
    Fault(S, "value = max(0.0, whole) / (count - 1)", "value = max(0.0, whole) / count", OF_STATISTICS),
    Fault(S, "math.log(count - samples - 1))", "math.log(count - 1))", OF_STATISTICS),
    Fault(S, "bias_interval(difference, sampling, *reference.errors)", "bias_interval(difference, sampling)", OF_STATISTICS),
    Fault(S, "hidden = (Sampling.without_direction(self.unseen, self.mean.size),) if self.unseen else ()", "hidden = ()", OF_STATISTICS),
    Fault(S, "math.isnan(relative):\n        if error == 0.0", "True:\n        if error == 0.0", OF_STATISTICS),
    Fault(S, "norm <= ROUNDING or reference.vanishes()", "norm <= ROUNDING", OF_STATISTICS),
    # scores and weights
    Fault(P, "return self.action_noise and self._moves_start", "return False", OF_SCORES),
    Fault(P, "self.step(ops, moved, u), cost, logp", "self.step(ops, state, u), cost, logp", OF_SCORES),
    Fault(P, "scene.feedback(xp, theta_moved, moved.q, moved.v)):", "scene.feedback(xp, theta_moved, state.q, state.v)):", OF_SCORES),
    Fault(P, "and self._only_controls and not self._moves_start", "and self._only_controls", OF_SCORES),
    Fault(E, "problem.score(theta, w) + problem.explicit(theta, w), noise)", "problem.score(theta, w), noise)", OF_SCORES),
    Fault(E, "if not self.adds_explicit:", "if False:", OF_SCORES),
    Fault("plugins/estimators/inverse_variance.py", "v0 = zeroth.var(axis=1, ddof=1) / zeroth.shape[1]", "v0 = zeroth.var(axis=1, ddof=1)", OF_WEIGHTS),
    Fault("plugins/estimators/inverse_variance.py", "v1 = first.var(axis=1, ddof=1) / first.shape[1]", "v1 = first.var(axis=1) / first.shape[1]", OF_WEIGHTS),
    Fault("plugins/estimators/alpha_order.py", "first.var(axis=1, ddof=1).sum(axis=-1) / first.shape[1]", "first.var(axis=1, ddof=1).sum(axis=-1) / n", OF_WEIGHTS),
    Fault("plugins/estimators/reinforce.py", "* f.shape[1] / (f.shape[1] - 1)", "", OF_WEIGHTS),
]  # fmt: skip
"""Faults one by one; those that change no number, such as a faster search, are left out."""


def killed(fault: Fault, folder: Path) -> bool:
    """Plant the fault in the copy at ``folder`` and run its tests in a forked process; return whether one failed."""
    path = folder / fault.path
    text = path.read_text()
    if text.count(fault.old) != 1:
        raise SystemExit(f"{fault.path} holds {text.count(fault.old)} of: {fault.old}")
    path.write_text(text.replace(fault.old, fault.new))
    child = os.fork()
    if child == 0:
        code = 99
        try:
            import pytest

            # a fault may loop or fill the memory: that is noticed too
            resource.setrlimit(resource.RLIMIT_CPU, (CPU, CPU))
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            os.chdir(folder)
            sys.path.insert(0, str(folder))
            sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
            code = int(pytest.main(["-x", "-n", "0", "-q", "-p", "no:cacheprovider", *fault.tests.split()]))
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    path.write_text(text)
    code = os.waitstatus_to_exitcode(status)
    if code > 2:
        print(f"  tests of {fault.path} ended with {code}")
    return code != 0


def main(words: list[str]) -> int:
    """Run all faults whose text holds one of the words; return 1 if any survives."""
    # loaded once, before forking
    import pandas  # noqa: F401
    import pytest  # noqa: F401
    import scipy.special
    import scipy.stats  # noqa: F401

    chosen = [fault for fault in FAULTS if not words or any(word in f"{fault.path} {fault.old}" for word in words)]
    survivors = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in COPIED:
            source = ROOT / part
            ignored = shutil.ignore_patterns("__pycache__")
            if source.is_dir():
                shutil.copytree(source, folder / part, ignore=ignored)
            else:
                shutil.copy(source, folder / part)
        sys.path[:] = [path for path in sys.path if Path(path or ".").resolve() not in (ROOT, ROOT / "tests")]
        sys.dont_write_bytecode = True
        for tests in dict.fromkeys(fault.tests for fault in chosen):
            if killed(Fault(R, "BATCHES = 64", "BATCHES = 64", tests), folder):
                raise SystemExit(f"{tests} fails without any fault: mend that first")
        for fault in chosen:
            started = time.perf_counter()
            found = killed(fault, folder)
            survivors += [] if found else [fault]
            told = f"{fault.path}: {fault.old.strip()[:70]} -> {fault.new.strip()[:50]}"
            print(f"{'killed  ' if found else 'SURVIVED'} {time.perf_counter() - started:5.1f}s  {told}", flush=True)
    print(f"{len(chosen) - len(survivors)} of {len(chosen)} faults killed")
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
