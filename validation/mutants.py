"""Plants one-line faults in the core and reports which of them a test detects: `python validation/mutants.py [WORD ...]`.

Each fault whose file or text contains a word is planted in a copy of the tree. Its tests run until one fails, in a process
forked after the libraries are loaded. Run by hand: all faults take half an hour.
"""

from __future__ import annotations

import os
import resource
import shlex
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

CPU, MEMORY = 40, 6 << 30
"""Limits for the tests of one fault: CPU seconds, and bytes of address space."""
ROOT = Path(__file__).resolve().parents[1]
COPIED = ("bench", "plugins", "conf", "tests", "validation", "docs", "README.md", "CONTRIBUTING.md", "pyproject.toml")


class Fault(NamedTuple):
    """A source line, its faulty replacement, and the tests that should fail."""

    path: str
    old: str
    new: str
    tests: str


R, Q, S = "bench/measure/reference.py", "bench/measure/quadrature.py", "bench/measure/statistics.py"
J, B, N = "bench/measure/jumps.py", "bench/measure/batches.py", "bench/measure/noise.py"
P, E = "bench/model/program.py", "bench/model/estimator.py"
OF_REFERENCE = "tests/measure/test_reference.py"
OF_STATISTICS = "tests/measure/test_statistics.py tests/measure/test_unexplained.py"
OF_SCORES = "tests/model/test_scores.py"
OF_WEIGHTS = "tests/plugins/test_weights.py"
T, ST = "bench/measure/timing.py", "bench/run/store.py"
GC, GD, GF, GK, GR, GS, GV = (
    f"bench/measure/gradcheck/{name}.py"
    for name in ("check", "direction", "few", "causes", "roughness", "sampling", "verdicts")
)
X = "plugins/estimators/"
OF_TIMING = "tests/studies/test_flat.py tests/speed/test_speed.py::test_timing_repeats_fast_calls_and_keeps_the_results_asked_for tests/speed/test_speed.py::test_slow_calls_are_made_once_each tests/measure/test_timing.py"
OF_STORE = "-m not\\ slow tests/run/test_store.py tests/run/test_nothing_lost.py"
OF_CHECKS = "tests/measure/test_direction.py tests/measure/test_check.py"
EL, EF, EX, ES, EG = (
    f"bench/examine/{name}.py" for name in ("lines", "findings", "examination", "smoothing", "gradient")
)
OF_PLAN, OF_MECHANISMS = "tests/examine/test_budget.py", "tests/examine/test_mechanisms.py"
OF_UNRESOLVED = "tests/examine/test_unresolved.py"
OF_GROUPS = "tests/examine/test_mechanisms.py -k 10_000\\ or\\ may_hide"
OF_EXAMINE = "-m not\\ slow tests/examine/test_examine.py --deselect tests/examine/test_examine.py::test_python_number_from_torch_is_disconnected_in_double_precision"
OF_ESTIMATORS = "tests/plugins/test_weights.py tests/plugins/test_estimators.py"
OF_VARIANCE = "tests/plugins/test_variance_reduction.py"
OF_EVENTS = "tests/plugins/test_events.py"

FAULTS = [
    # quadrature
    Fault(Q, "gradients.append(nodes[:dim] @ (weights * (f - centre)) / problem.sigma)", "gradients.append(nodes[:dim] @ (weights * (f - centre)))", OF_REFERENCE),
    Fault(Q, "inner = [(b - theta[i]) / problem.sigma for b", "inner = [(b - theta[i]) for b", OF_REFERENCE),
    Fault(Q, "inner = [(b - theta[i]) / problem.sigma for b", "inner = [b / problem.sigma + 1e-3 for b", OF_REFERENCE),
    Fault(Q, "max(SAFETY * spread, change)", "spread * 1e-3", OF_REFERENCE),
    Fault(Q, "    error += beyond + rounding + (", "    error += 0.0 * (", OF_REFERENCE),
    Fault(Q, "SHIFTS = {1: ((0.0, 0.5, 0.25, 0.75),)", "SHIFTS = {1: ((0.0, 0.0, 0.0, 0.0),)", OF_REFERENCE),
    Fault(Q, "if count > points:", "if False:", OF_REFERENCE),
    Fault(Q, "np.exp(-(nodes**2) / 2) / math.sqrt(2 * math.pi)", "np.exp(-(nodes**2) / 2) / 2.5", OF_REFERENCE),
    Fault(Q, "panels *= 2", "panels *= 1", OF_REFERENCE),
    Fault(Q, "VANISHED = 1e-18", "VANISHED = 1.0", OF_REFERENCE),
    # sampling
    Fault(R, "w = draw_columns(problem, stream, BATCHES * size, count)", "w = draw_columns(problem, stream, BATCHES * size, 0)", OF_REFERENCE),
    Fault(R, "draw_columns(problem, \"check\", columns, block)", "draw_columns(problem, \"reference\", columns, block)", OF_REFERENCE),
    Fault(R, "se = math.sqrt(batches.var(axis=0, ddof=1).sum() / BATCHES)", "se = math.sqrt(batches.var(axis=0, ddof=1).sum()) / BATCHES / 2", OF_REFERENCE),
    Fault(R, "count * BATCHES >= LEAST_SAMPLES", "True", OF_REFERENCE),
    Fault(R, "spent = 2 * count * BATCHES > samples", "spent = count * BATCHES > samples", OF_REFERENCE),
    Fault(R, "batches = (batches * count + means * size) / (count + size)", "batches = (batches + means) / 2", OF_REFERENCE),
    Fault(R, "error, note = share * float(", "error, note = 0.0 * float(", OF_REFERENCE),
    Fault(R, "depth = -ndtri(0.5 * share * middle)", "depth = -ndtri(0.5 * middle)", OF_REFERENCE),
    Fault(R, "    if jump:\n", "    if False:\n", OF_REFERENCE),
    Fault(R, "    if at[REFUSED]:", "    if False:", OF_REFERENCE),
    Fault(R, "    if doubt and \"zeroth_order\" in pilots:", "    if False:", OF_REFERENCE),
    Fault(R, "resolved = 2.0 * math.sqrt(trace)", "resolved = 2.0 * trace", OF_REFERENCE),
    Fault(R, "if program.contact is not None and not program.contact.continuous:", "if False:", OF_REFERENCE),
    Fault(R, "return not program.continuous and not any(program.breakpoints())", "return False", OF_REFERENCE),
    Fault(R, "if problem.program.has_score_gradient:", "if True:", OF_SCORES),
    Fault(R, "mean = np.asarray(sum(terms) / 2)", "mean = np.asarray(sum(terms))", OF_REFERENCE),
    Fault(R, "closed = None if \"physics\" in provides else", "closed =", OF_REFERENCE),
    Fault(R, "if not sampled.note and 0.0 < error < quadrature.error:", "if 0.0 < error < quadrature.error:", OF_REFERENCE),
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
    Fault(S, "return float(raw - min(max(unbiased, trace**2 / self.rows.shape[1]), trace**2))", "return 0.0", OF_STATISTICS),
    Fault(S, "scale = (square + 2.0 * along) / (1.0 + 2.0 * power)", "scale = (square + along) / (1.0 + power)", OF_STATISTICS),
    Fault(S, "once = float(image @ image) + equal * total  # m'Sm", "once = total  # m'Sm", OF_STATISTICS),
    Fault(S, "seen, end = max(total, 1.0), max(end, 1.0) + limit", "seen, end = total, max(end, 1.0) + limit", OF_STATISTICS),
    Fault(S, "h = 1.0 - 2.0 / 3.0 * first * third / second**2", "h = 1.0 / 3.0", OF_STATISTICS),
    Fault(S, "left = total - squares * repeats / max(repeats - 1, 1)", "left = total - squares", OF_STATISTICS),
    Fault(S, "variance = float(np.vdot(deviations, deviations)) / (repeats - 1)", "variance = float(np.vdot(deviations, deviations)) / repeats", OF_STATISTICS),
    Fault(S, "squared_error = float(np.vdot(errors, errors)) / repeats - reference.standard_error**2", "squared_error = float(np.vdot(errors, errors)) / repeats", OF_STATISTICS),
    Fault(S, "bias_low, bias_high = bias_low - rare * size, bias_high + rare * size", "pass", OF_STATISTICS),
    Fault(S, "if unbiased and bias_low > 0.0:", "if bias_low > 0.0:", OF_STATISTICS),
    Fault(S, "CONCENTRATION = 0.75", "CONCENTRATION = 0.2", OF_STATISTICS),
    Fault(S, "value = max(0.0, whole) / (count - 1)", "value = max(0.0, whole) / count", OF_STATISTICS),
    Fault(S, "math.log(count - samples - 1), level)", "math.log(count - 1), level)", OF_STATISTICS),
    Fault(S, "bias_interval(difference, sampling, *reference.errors)", "bias_interval(difference, sampling)", OF_STATISTICS),
    Fault(S, "hidden = (Sampling.without_direction(self.unseen, self.mean.size),) if self.unseen else ()", "hidden = ()", OF_STATISTICS),
    Fault(S, "math.isnan(relative):\n        if error == 0.0", "True:\n        if error == 0.0", OF_STATISTICS),
    Fault(S, "norm <= ROUNDING or reference.vanishes()", "norm <= ROUNDING", OF_STATISTICS),
    # scores and weights
    Fault(P, "return not (self.action_noise and self._moves_start)", "return True", OF_SCORES),
    Fault(P, "and self._only_controls and not self._moves_start", "and self._only_controls", OF_SCORES),
    Fault("plugins/estimators/inverse_variance.py", "v0 = zeroth.var(axis=1, ddof=1) / zeroth.shape[1]", "v0 = zeroth.var(axis=1, ddof=1)", OF_WEIGHTS),
    Fault("plugins/estimators/inverse_variance.py", "v1 = first.var(axis=1, ddof=1) / first.shape[1]", "v1 = first.var(axis=1) / first.shape[1]", OF_WEIGHTS),
    Fault("plugins/estimators/alpha_order.py", "first.var(axis=1, ddof=1).sum(axis=-1) / first.shape[1]", "first.var(axis=1, ddof=1).sum(axis=-1) / n", OF_WEIGHTS),
    Fault("plugins/estimators/reinforce.py", "* f.shape[1] / (f.shape[1] - 1)", "", OF_WEIGHTS),
    # what came with later defects
    Fault(S, "up = max(reach, 3.0 / skewness", "up = max(reach, 0.3 / skewness", OF_STATISTICS),
    Fault(S, "if skewness > SYMMETRIC:", "if False:", OF_STATISTICS),
    Fault(S, "skewness = repeats / (repeats - 2) *", "skewness = 1.0 *", OF_STATISTICS),
    Fault(S, "pseudo = repeats * whole - (repeats - 1) * without", "pseudo = repeats * whole - repeats * without", OF_STATISTICS),
    Fault(S, "reach * spread, whole)), _exp(", "reach * spread, whole)), whole + _exp(", OF_STATISTICS),
    Fault(S, "agree = np.sign(estimates[:, nonzero]) == np.sign(reference[nonzero])", "agree = np.sign(estimates) == np.sign(reference)", OF_STATISTICS),
    Fault(S, "return float(squares.max()) / total", "return float(squares.mean()) / total", OF_STATISTICS),
    Fault(S, "(deviations @ difference)[:, None], \" along", "deviations, \" along", OF_STATISTICS),
    Fault(S, "FEW_REPEATS = 8", "FEW_REPEATS = 3", OF_STATISTICS),
    Fault(S, "THREE = 3.0", "THREE = 1.0", OF_STATISTICS),
    Fault(S, "if error > VAGUE * norm:", "if error > norm:", OF_STATISTICS),
    Fault(S, "math.hypot(shown, self.unseen)", "shown", OF_STATISTICS),
    # noise
    Fault(N, "zlib.crc32(scene.encode()), repeat]", "0, repeat]", "tests/measure/test_noise.py"),
    Fault(N, "zlib.crc32(scene.encode()), repeat]", "zlib.crc32(scene.encode()), 0]", "tests/measure/test_noise.py"),
    Fault(N, "SeedSequence([seed, ", "SeedSequence([0, ", "tests/measure/test_noise.py"),
    Fault(N, "standard_normal((samples, width)).T", "standard_normal((width, samples))", "tests/measure/test_noise.py"),
    Fault(N, "block.setflags(write=False)", "pass", "tests/measure/test_noise.py"),
    Fault(N, "min(columns, samples - start)", "columns", "tests/measure/test_noise.py"),
    # timing
    Fault(T, "seconds.append(time.perf_counter() - start - (pause.seconds - paused))", "seconds.append(time.perf_counter() - start)", OF_TIMING),
    Fault(T, "np.percentile(seconds, [25, 50, 75])\n    return results", "(*np.percentile(seconds, [25]), np.mean(seconds), max(seconds))\n    return results", OF_TIMING),
    Fault(T, "float(high - low), tuple(seconds)", "float(high), tuple(seconds)", OF_TIMING),
    Fault(T, "    call(0)\n", "", OF_TIMING),
    Fault(T, "call(len(seconds) % count)", "call(0)", OF_TIMING),
    Fault(T, "if len(results) < count:", "if True:", OF_TIMING),
    Fault(T, "len(seconds) < most * count and", "", OF_TIMING),
    Fault(T, "if total < least_s:", "if total > least_s:", OF_TIMING),
    Fault(T, "if total >= settle_s:", "if False:", OF_TIMING),
    Fault(T, "high - low > STEADY * median", "high - low > 10 * median", OF_TIMING),
    Fault(T, "return len(self.samples_s) + 1", "return len(self.samples_s)", OF_TIMING),
    Fault(T, "return self.iqr_s / self.median_s", "return self.median_s / self.iqr_s", OF_TIMING),
    Fault(T, "self.seconds += time.perf_counter() - self._since", "self.seconds = time.perf_counter() - self._since", OF_TIMING),
    Fault(T, ".split()[0]) / 1024", ".split()[0]) / 1000000", OF_TIMING),
    Fault(T, 'write_text("5")', 'write_text("4")', OF_TIMING),
    # store
    Fault(ST, "self._sequence += 1", "pass", OF_STORE),
    Fault(ST, "duplicated(keep=\"last\")", "duplicated(keep=\"first\")", OF_STORE),
    Fault(ST, "na_position=\"first\"", "na_position=\"last\"", OF_STORE),
    Fault(ST, "[\"sequence\", \"stored_at\"], kind", "[\"stored_at\", \"sequence\"], kind", OF_STORE),
    Fault(ST, "between(0, MAX_SEQUENCE), 0.0)", "notna(), 0.0)", OF_STORE),
    Fault(ST, "return table[~is_older].reset_index(drop=True) if is_older.any() else table", "return table", OF_STORE),
    Fault(ST, "        if self._sequence is None:\n            self.load()\n        assert self._sequence is not None", "        self._sequence = self._sequence or 0", OF_STORE),
    Fault(ST, "self._sequence = max(self._sequence or 0, int(sequence.max()))", "self._sequence = self._sequence or 0", OF_STORE),
    Fault(ST, "            path.unlink(missing_ok=True)\n        self._spoilt.clear()", "            pass", OF_STORE),
    Fault(ST, "                write_whole(other, path.read_bytes())\n", "", OF_STORE),
    Fault(ST, "fcntl.LOCK_EX", "fcntl.LOCK_SH", OF_STORE),
    Fault(ST, "[*(self._pending / name for name in names), self._table]", "[self._table, *(self._pending / name for name in names)]", OF_STORE),
    Fault(ST, "sorted(set(studies) - {\"\", self._study}) if self._study else []", "[]", OF_STORE),
    Fault(ST, "position.argsort(kind=\"stable\")", "position.argsort(kind=\"stable\")[::-1]", OF_STORE),
    Fault(ST, "lambda key: place.get(key, -1)", "lambda key: place.get(key, len(place))", OF_STORE),
    Fault(ST, "typed[name].isna().sum() >", "False and typed[name].isna().sum() >", OF_STORE),
    # gradient checks
    Fault(GC, "repeats(first, again, self.unit).all()", "np.allclose(first, again, equal_nan=True)", OF_CHECKS),
    Fault(GS, "LAST_DIGITS = 8", "LAST_DIGITS = 1e5", OF_CHECKS),
    Fault(GC, "again = self.gradient(theta)", "again = first", OF_CHECKS),
    Fault(GC, "causes += [part.verdict for part in draws if part.verdict in FAULTS]", "pass", OF_CHECKS),
    Fault(GC, "cause=most_severe(causes)", "cause=causes[0]", OF_CHECKS),
    Fault(GC, "share[dim - (most - most // 2) :]", "share[: most // 2]", OF_CHECKS),
    Fault(GC, "vectors * gradients, 0.0).sum(axis=0) / lengths", "vectors * gradients, 0.0).sum(axis=0)", OF_CHECKS),
    Fault(GC, "random *= self.scale[:, None] / np.linalg.norm(random, axis=0)", "random /= np.linalg.norm(random, axis=0)", OF_CHECKS),
    Fault(GC, "np.where(program != 0.0, np.sqrt(self.unit) * whole.max(axis=0) / lengths, 0.0)", "np.sqrt(self.unit) * whole.max(axis=0) / lengths", OF_CHECKS),
    Fault(GC, "doubts = np.where(program != 0.0,", "doubts = 0.0 * np.where(program != 0.0,", OF_CHECKS),
    Fault(GC, '"precision" if coarse.verdict in TRUSTED', '"precision" if True', OF_CHECKS),
    Fault(GD, "apart <= min(tolerance, alike + rounding + sample.doubt)", "apart <= tolerance", OF_CHECKS),
    Fault(GC, "if still and at_draws[0].any() and not here:", "if False:", OF_CHECKS),
    Fault(GC, "least = 1e-14 * max(1.0,", "least = 1e-2 * max(1.0,", OF_CHECKS),
    Fault(GC, "8.0 * self.unit * float(np.abs(row).max())", "1e-3 * float(np.abs(row).max())", OF_CHECKS),
    Fault(GD, "tolerance = 10.0 * spread +", "tolerance = 100.0 * spread +", OF_CHECKS),
    Fault(GD, "(self.plus - self.minus) / (2.0 * self.step)", "(self.plus - self.minus) / self.step", OF_CHECKS),
    Fault(GD, "ALIKE = 0.1", "ALIKE = 1.0", OF_CHECKS),
    Fault(GD, "DECADES = 3.0", "DECADES = 0.5", OF_CHECKS),
    Fault(GD, "MIN_STEPS = 7", "MIN_STEPS = 16", OF_CHECKS + " tests/measure/test_gradcheck.py"),
    Fault(GD, "GUARD = 64.0", "GUARD = 64e4", OF_CHECKS),
    Fault(GD, "MEASURED = 8.0", "MEASURED = 0.8", OF_CHECKS),
    Fault(GD, "MEASURED = 8.0", "MEASURED = 800.0", OF_CHECKS),
    Fault(GD, "(np.triu(apart > allowed, 1)).any(axis=1)", "np.zeros(spread.size, bool)", OF_CHECKS),
    Fault(GD, "worth = spread + noise", "worth = spread", OF_CHECKS),
    Fault(GD, "    if not sample.repeatable:\n        return Finding(\"nondeterministic\", float(sample.step[0]))", "    pass", OF_CHECKS),
    Fault(GD, "low <= sample.derivative <= high", "True", OF_CHECKS),
    Fault(GD, "middle > 2.0 * error.max()", "middle > 2e6 * error.max()", OF_CHECKS),
    Fault(GD, "\"disconnected\" if sample.derivative == 0.0", "\"disconnected\" if False", OF_CHECKS),
    Fault(GD, "sample.derivative == 0.0 and still[-MIN_STEPS:].all()", "False", OF_CHECKS),
    Fault(GK, "CONSTANT = 1e-3", "CONSTANT = 1.0", OF_CHECKS),
    Fault(GK, "ENOUGH = 3", "ENOUGH = 30", OF_CHECKS),
    Fault(GK, "0.0 < value < 2.0", "0.0 < value < 0.1", OF_CHECKS),
    Fault(GR, "APART = 3.0", "APART = 0.0", OF_CHECKS),
    Fault(GR, "factorial(order) ** 2 / factorial(2 * order)", "1.0", OF_CHECKS),
    Fault(GR, "EDGES = 3", "EDGES = 1", OF_CHECKS),
    Fault(GS, "[-eps, eps, [0.0], offsets", "[-eps, 2 * eps, [0.0], offsets", OF_CHECKS),
    Fault(GS, "eps * lengths[m], minus", "eps, minus", OF_CHECKS),
    Fault(GS, "max(measured, scatter(sample.step, sample.differences))", "0.0", OF_CHECKS),
    Fault(GS, "sign * sample.step * sample.derivative", "sample.step * sample.derivative", OF_CHECKS),
    Fault(GV, "return min(verdicts, key=VERDICTS.index)", "return max(verdicts, key=VERDICTS.index)", OF_CHECKS),
    Fault(GV, "TRUSTED = of_kind(\"right\")", "TRUSTED = of_kind(\"right\") + of_kind(\"broken\")", OF_CHECKS),
    # newer lines of the checks, and of what examines a user's simulator
    Fault(GK, "FINEST = 1e-5", "FINEST = 1e-2", OF_CHECKS),
    Fault(GK, "FINEST = 1e-5", "FINEST = 1e-12", OF_CHECKS),
    Fault(GK, "min(abs(middle), abs(middle - 1.0))", "abs(middle)", OF_CHECKS),
    Fault(GK, "KNOWN = 10.0", "KNOWN = 0.1", OF_CHECKS),
    Fault(GK, "KNOWN = 10.0", "KNOWN = 1e4", OF_CHECKS),
    Fault(GK, "MOSTLY = 0.8", "MOSTLY = 1.0", OF_CHECKS),
    Fault(GK, "MOSTLY = 0.8", "MOSTLY = 0.3", OF_CHECKS),
    Fault(GK, "some_right = some_right or right_elsewhere", "pass", OF_CHECKS),
    Fault(GK, "elif \"missing_term\" in causes.values():", "elif False:", OF_CHECKS),
    Fault(GK, "if len(components) > 1 and _constant(every):", "if False:", OF_CHECKS),
    Fault(GK, "return \"missing_term\" if some_right or partly else \"wrong_adjoint\"", "return \"missing_term\"", OF_CHECKS),
    Fault(GK, "causes[None] = max(kinds, key=kinds.count)", "causes[None] = min(kinds, key=kinds.count)", OF_CHECKS),
    Fault(GC, "if \"wrong_adjoint\" in cause.values() and self._is_right_far_away():", "if False:", OF_CHECKS),
    Fault(GC, "return bool(right)", "return True", OF_CHECKS),
    Fault(GC, "for _ in range(2):", "for _ in range(1):", OF_CHECKS),
    Fault(GC, " and part.program != 0.0\n", "\n", OF_CHECKS),
    Fault(GC, "sample.derivative == 0.0 and sample.differences.any())", "False)", OF_CHECKS),
    Fault(GC, "GUARD * float(self.unit) * abs(sample.centre) >= tread", "False", OF_CHECKS),
    Fault(GC, "noise=max(sample.noise, tread)", "noise=sample.noise", OF_CHECKS),
    Fault(GC, "abs(self.ratio) * self.uncertainty / size if size > 0.0 else 0.0", "0.0", OF_CHECKS),
    Fault(GC, "part.verdict in (\"wrong_adjoint\", *TRUSTED):", "part.verdict == \"smooth\":", OF_CHECKS),
    Fault(GC, "part.verdict in TRUSTED and part.verdict != \"zero\" for part", "False for part", OF_CHECKS),
    Fault(GC, "FAR = (1.0, 3.0)", "FAR = (0.01, 0.01)", OF_CHECKS),
    Fault(GC, "self.cost(at[:, ::-1])[::-1]", "self.cost(at)", OF_CHECKS),
    Fault(GC, "theta + 4.0 * self.unit * self.scale", "theta", OF_CHECKS),
    Fault(GC, "ELSEWHERE = 4", "ELSEWHERE = 0", OF_CHECKS),
    Fault(GD, "and resolved:", ":", OF_CHECKS),
    Fault(GD, "return bool(plain and abs(", "return bool(abs(", OF_CHECKS),
    Fault(GD, "> 2.0 * tolerance)", "> 2e6 * tolerance)", OF_CHECKS),
    Fault(GD, "slopes = np.maximum(np.abs(self.left), np.abs(self.right))", "slopes = 0.0", "tests/examine/test_bank.py -k right_gradients"),
    Fault(GD, "costs = costs + float(np.finfo(np.float64).tiny) / unit", "pass", OF_CHECKS),
    Fault(GD, "SHORT_WINDOW = 4", "SHORT_WINDOW = 2", OF_CHECKS),
    Fault(GD, "RISE = 0.01", "RISE = 1e3", OF_CHECKS),
    Fault(EL, "TREADS = 4", "TREADS = 3", OF_EXAMINE),
    Fault(EL, "ALIKE = 0.01", "ALIKE = 10.0", OF_EXAMINE),
    Fault(EL, "EVEN = 0.02", "EVEN = 0.6", OF_EXAMINE),
    Fault(EL, "np.diff(at) / np.diff(at).min()", "np.diff(at)", OF_EXAMINE),
    Fault(EL, "return float(heights.mean()) if", "return 1.0 if", OF_EXAMINE),
    Fault(EL, "GUARD = 64.0", "GUARD = 0.0", OF_EXAMINE),
    Fault(EL, "if order < 0.5:", "if order < -0.5:", OF_EXAMINE),
    Fault(EL, "elif order < 1.5:", "elif order < 2.5:", OF_EXAMINE),
    Fault(EL, "float(bends[end][k])", "float(bends[0][k])", OF_EXAMINE),
    Fault(EL, "(np.abs(level) <= noise).mean() > 0.5", "True", OF_EXAMINE),
    Fault(EF, "return any(line.steps for line in self.lines)", "return False", OF_EXAMINE),
    Fault(EF, "is_still = not self.moves_around", "is_still = True", OF_EXAMINE),
    Fault(EF, "return max(treads) if min(treads) > (1 - ALIKE) * max(treads) else 0.0", "return max(treads)", OF_EXAMINE),
    Fault(EF, "        elif self.misses_jumps:", "        elif False:", OF_EXAMINE),
    Fault(EF, "return self.missed > (SEEN if self.tread else TARGET_ERROR) and not self.is_measured", "return self.missed > (SEEN if self.tread else TARGET_ERROR)", OF_UNRESOLVED),
    Fault(EF, "return hidden + contradicted", "return hidden", OF_UNRESOLVED),
    Fault(EF, "return hidden + contradicted", "return contradicted", OF_UNRESOLVED),
    Fault(EF, "DIGIT * max(abs(p.difference), _slope_nearby(p.sample))", "DIGIT * abs(p.difference)", OF_UNRESOLVED),
    Fault(EG, "        self._repeat_gradient(other)\n", "", OF_UNRESOLVED),
    Fault(EG, "                        self._check_number(index, part.verdict)", "                        pass", OF_GROUPS),
    Fault(EF, "return min(DEVIATIONS / math.sqrt(self.count), 1.0) * self.allowed", "return self.allowed", OF_GROUPS),
    Fault(EF, "DEVIATIONS = 4.0", "DEVIATIONS = 0.1", OF_GROUPS),
    Fault(EF, "CONTRADICTED * part.uncertainty + part.sample.doubt", "CONTRADICTED * part.uncertainty", OF_GROUPS),
    Fault(EF, "return SEEN_ALONE * error * self.count / self.slope if", "return error / self.slope if", OF_GROUPS),
    Fault(GF, "shrinks = bounds[best] <=", "shrinks = True or bounds[best] <=", OF_UNRESOLVED),
    Fault(EF, "checks = [self.settled, *self.more]", "checks = [self.settled]", OF_EXAMINE),
    Fault(EF, "\"spread\": one.unshown or one.hidden", "\"spread\": one.hidden", OF_EXAMINE),
    Fault(EF, "\"biased\": one.biased", "\"biased\": False", OF_EXAMINE),
    Fault(EF, "{\"open\": 3, \"right\": 0}.get(RULES[self.cause].kind, 1)", "{\"open\": 3, \"right\": 0}.get(RULES[self.cause].kind, 0)", OF_EXAMINE),
    Fault(EX, "doubt < max(0.1 * missed, LEAST_MISSED)", "True", OF_EXAMINE),
    Fault(EG, "(half * weight).ravel()", "(0.0 * half + weight).ravel()", OF_EXAMINE),
    Fault(EX, "replace(line, missed=self._missed_share(line, checked))", "line", OF_EXAMINE),
    Fault(GF, 'return wrong(sample)', 'return "smooth"', OF_PLAN),
    Fault(GF, 'return "smooth" if uncertainty <= ALIKE * size else "unsettled"', 'return "unsettled"', OF_PLAN),
    Fault(EF, "return bool(abs(part.program - part.difference) <= allowed)", "return True", OF_MECHANISMS),
    Fault(EG, "self.repeats.has_state = bool(is_alike and self.repeats.spread > self.repeats.floor)", "self.repeats.has_state = False", OF_MECHANISMS),
    Fault(ES, "return self.known and bool(self.bias_low > TARGET_ERROR * self.norm)", "return bool(self.bias_low > TARGET_ERROR * self.norm)", OF_EXAMINE),
    Fault(ES, "return self.known and bool(self.bias_low > TARGET_ERROR * self.norm)", "return self.known and bool(self.bias_low > 1e9 * self.norm)", OF_EXAMINE),
    Fault(ES, "return self.known and not self.biased and bool(self.bias_high > TARGET_ERROR * self.norm)", "return False", OF_EXAMINE),
    Fault(ES, "float(truth @ truth) - error**2", "float(truth @ truth)", OF_EXAMINE),
    Fault(ES, "_means(slopes) - groups", "_means(slopes)", OF_EXAMINE),
    Fault(ES, "room = TARGET_ERROR**2 - bias**2", "room = TARGET_ERROR**2", OF_EXAMINE),
    Fault(ES, "slope = np.linalg.lstsq(u[:, ~half].T, d[~half], rcond=None)[0]", "slope = np.linalg.lstsq(u[:, half].T, d[half], rcond=None)[0]", OF_EXAMINE),
    Fault(ES, "simulator.costs(down, w)) / 2.0", "simulator.costs(down, w))", OF_EXAMINE),
    Fault(ES, "return Method(name, bias, samples, calls * samples,", "return Method(name, bias, samples, samples,", OF_EXAMINE),
    # estimators
    Fault(X + "alpha_order.py", "np.log((zeroth.shape[2] + 1) / self.delta)", "np.log(1 / self.delta)", OF_ESTIMATORS),
    Fault(X + "alpha_order.py", "2 * largest / (3 * n) * log_term", "largest / (3 * n) * log_term", OF_ESTIMATORS),
    Fault(X + "alpha_order.py", "np.maximum(gamma - eps, 0.0)", "gamma", OF_ESTIMATORS),
    Fault(X + "clipped.py", "if self.by == \"element\"", "if self.by == \"sample\"", OF_ESTIMATORS),
    Fault(X + "clipped.py", "np.minimum(1.0, np.divide", "np.maximum(1.0, np.divide", OF_ESTIMATORS),
    Fault(X + "control_variate.py", "for part in reversed(parts)]", "for part in parts]", OF_ESTIMATORS),
    Fault(X + "control_variate.py", "(control[:, part] - centre)", "control[:, part]", OF_ESTIMATORS),
    Fault(X + "finite_difference.py", "np.stack(rows) / (2 * self.step)", "np.stack(rows) / self.step", OF_ESTIMATORS),
    Fault(X + "guided.py", "np.sqrt(self.share) * (w - inside)", "self.share * (w - inside)", OF_ESTIMATORS),
    Fault(X + "guided.py", "change * shift / (2.0 * s * s)", "change * shift / (2.0 * s)", OF_ESTIMATORS),
    Fault(X + "inverse_variance.py", "weight * first.mean(axis=1) + (1 - weight)", "(1 - weight) * first.mean(axis=1) + weight", OF_ESTIMATORS),
    Fault(X + "measure_valued.py", "np.sqrt(-2.0 * log_ndtr(w))", "np.sqrt(-log_ndtr(w))", OF_ESTIMATORS),
    Fault(X + "measure_valued.py", "np.sqrt(2.0 * np.pi)", "np.pi", OF_ESTIMATORS),
    Fault(X + "optimal_baseline.py", "keepdims=True) - sums for sums", "keepdims=True) for sums", OF_VARIANCE),
    Fault(X + "optimal_baseline.py", "product, square = terms * score, score**2", "product, square = terms / score, score / score", OF_VARIANCE),
    Fault(X + "orthogonal.py", "else np.sqrt(d)", "else 1.0", OF_ESTIMATORS),
    Fault(X + "quadratic_model.py", "/ (1.0 - (q**2).sum(axis=2))", "", OF_VARIANCE),
    Fault(X + "quadratic_model.py", "n * along - np.einsum(\"rnk,rn->rk\", q, errors)", "n * along", OF_VARIANCE),
    Fault(X + "quadratic_model.py", "coefficients[:, 1 : d + 1]", "coefficients[:, :d]", OF_VARIANCE),
    Fault(X + "boundary.py", "problem.value(theta, at_limit - apart) - problem.value(theta, at_limit + apart)", "problem.value(theta, at_limit + apart) - problem.value(theta, at_limit - apart)", OF_EVENTS),
    Fault(X + "boundary.py", "np.exp(-0.5 * limit**2)", "np.exp(-limit**2)", OF_EVENTS),
    Fault(X + "boundary.py", "(limit - direction @ w)", "limit", OF_EVENTS),
    Fault(X + "stochastic_derivative.py", "log_ndtr(side * limit)", "log_ndtr(-side * limit)", OF_EVENTS),
    Fault(X + "stochastic_derivative.py", "np.maximum(0.0, -side * slope)", "np.abs(slope)", OF_EVENTS),
    Fault(X + "stochastic_derivative.py", "(limit + side - number)", "(limit - side - number)", OF_EVENTS),
    Fault("bench/model/scene.py", "repeat(units[:, :, None] / sigma", "repeat(normals[:, :, None] / sigma", OF_EVENTS),
    Fault("bench/model/events.py", "limits / scale, slopes / scale", "limits, slopes", OF_EVENTS),
    Fault(X + "sobol.py", "math.sqrt(count) * noise.mean", "noise.mean", OF_VARIANCE),
    Fault(X + "sobol.py", "change * shift / (2.0 * s * s)", "change * shift / (s * s)", OF_VARIANCE),
    Fault(X + "randomized_smoothing.py", "* direction / (2 * s)", "* direction / s", OF_ESTIMATORS),
    Fault(X + "randomized_smoothing.py", "centre)) * direction / s", "centre)) * direction / (2 * s)", OF_ESTIMATORS),
    Fault(X + "randomized_smoothing.py", "self.radius != program.scene.sigma", "False", "tests/measure/test_unexplained.py"),
    Fault(X + "sphere_smoothing.py", "d * change * u / (2.0 * r)", "change * u / (2.0 * r)", OF_ESTIMATORS),
    Fault(X + "sphere_smoothing.py", "np.sqrt(program.dim + 2.0)", "np.sqrt(program.dim)", OF_ESTIMATORS),
    Fault(X + "total_propagation.py", "part = 1 if self.per == \"control\"", "part = 1 if self.per == \"step\"", OF_ESTIMATORS),
    Fault(X + "total_propagation.py", "variances.reshape(len(variances), -1, part).sum(axis=2)", "variances.reshape(len(variances), part, -1).sum(axis=1)", OF_ESTIMATORS),
    Fault("bench/model/estimator.py", "half = noise.shape[1] // 2", "half = noise.shape[1] // 3", OF_ESTIMATORS),
    Fault("bench/model/estimator.py", "cost = problem.value(theta, w) - problem.value(theta, np.zeros((w.shape[0], 1)))", "cost = problem.value(theta, w)", OF_ESTIMATORS),
    Fault("bench/model/estimator.py", "derivative = program.continuous and not program.surrogate", "derivative = program.continuous", OF_ESTIMATORS + " tests/plugins/test_surrogate.py"),
    Fault("bench/model/estimator.py", "if \"score\" in self.needs and not program.has_score_gradient:", "if False:", OF_SCORES),
]  # fmt: skip
"""The planted faults. Faults that change no number are omitted, such as in code that only speeds up a search, or a quadrature
that may stop below its least number of points: it never stops before the second level, which has that many."""


def killed(fault: Fault, folder: Path) -> bool:
    """Plant the fault in the copy at ``folder``, run its tests in a forked process, and return whether one failed."""
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

            # a fault may loop or fill the memory: the limits make its tests fail
            resource.setrlimit(resource.RLIMIT_CPU, (CPU, CPU))
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            os.chdir(folder)
            sys.path.insert(0, str(folder))
            sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
            code = int(pytest.main(["-x", "-n", "0", "-q", "-p", "no:cacheprovider", *shlex.split(fault.tests)]))
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    path.write_text(text)
    code = os.waitstatus_to_exitcode(status)
    if code > 2:
        print(f"  tests of {fault.path} ended with {code}")
    return code != 0


def stale(faults: list[Fault]) -> list[str]:
    """Return a message per fault that cannot be planted, since the code does not contain its text exactly once."""
    held = {path: (ROOT / path).read_text() for path in {fault.path for fault in faults}}
    return [f"{f.path} does not hold exactly one: {f.old}" for f in faults if held[f.path].count(f.old) != 1]


def main(words: list[str]) -> int:
    """Run the faults whose file or text contains one of the words, or all; return 1 if any survives."""
    chosen = [fault for fault in FAULTS if not words or any(word in f"{fault.path} {fault.old}" for word in words)]
    if lost := stale(chosen):
        raise SystemExit("\n".join(lost))
    # imported once, before forking
    import pandas  # noqa: F401
    import pytest  # noqa: F401
    import scipy.special
    import scipy.stats  # noqa: F401

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
        own = (ROOT, ROOT / "tests", ROOT / "validation")
        sys.path[:] = [path for path in sys.path if Path(path or ".").resolve() not in own]
        sys.dont_write_bytecode = True
        for tests in dict.fromkeys(fault.tests for fault in chosen):
            if killed(Fault(R, "BATCHES = 64", "BATCHES = 64", tests), folder):
                raise SystemExit(f"{tests} fails without any fault: mend that first")
        for fault in chosen:
            started = time.perf_counter()
            is_killed = killed(fault, folder)
            survivors += [] if is_killed else [fault]
            description = f"{fault.path}: {fault.old.strip()[:70]} -> {fault.new.strip()[:50]}"
            verdict = "killed  " if is_killed else "SURVIVED"
            print(f"{verdict} {time.perf_counter() - started:5.1f}s  {description}", flush=True)
    print(f"{len(chosen) - len(survivors)} of {len(chosen)} faults killed")
    return int(bool(survivors))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
