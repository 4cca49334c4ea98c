"""Plants one-line faults in the core and reports which of them a test detects: `python validation/mutants.py [WORD ...]`.

Each fault whose file or text contains a word is planted in a copy of the tree. Its tests run until one fails, in a process
forked after the libraries are loaded. Run by hand: all faults take half an hour.
"""

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
    f"bench/gradient/{name}.py" for name in ("check", "direction", "few", "causes", "roughness", "sampling", "rules")
)
X = "plugins/estimators/"
OF_TIMING = "tests/studies/test_flat.py tests/measure/test_timing.py"
OF_STORE = "tests/run/test_rows.py tests/run/test_store.py tests/run/test_nothing_lost.py"
OF_CHECKS = "tests/gradient/test_direction.py tests/gradient/test_check.py"
EL, EG = "bench/gradient/lines.py", "bench/gradient/stages.py"
EF, EX, ES = (f"bench/examine/{name}.py" for name in ("findings", "examination", "smoothing"))
OF_PLAN, OF_MECHANISMS = "tests/examine/test_budget.py", "tests/examine/test_mechanisms.py"
OF_UNRESOLVED = "tests/examine/test_unresolved.py"
OF_HOLD = "tests/examine/test_verdicts_hold.py"
OF_GROUPS = "-m not\\ full tests/examine/test_mechanisms.py -k 10_000\\ or\\ may_hide"
OF_EXAMINE = "tests/examine/test_examine.py --deselect tests/examine/test_examine.py::test_python_number_from_torch_is_disconnected_in_double_precision"
OF_ESTIMATORS = "tests/plugins/test_weights.py tests/plugins/test_estimators.py"
OF_VARIANCE = "tests/plugins/test_variance_reduction.py"
OF_EVENTS = "tests/plugins/test_events.py"
OF_KIT = "tests/conformance/test_registered.py -k "

GROUPS: dict[tuple[str, str], list[tuple[str, str]]] = {
    (Q, OF_REFERENCE): [
        ("gradients.append(nodes[:dim] @ (weights * (f - centre)) / problem.sigma)", "gradients.append(nodes[:dim] @ (weights * (f - centre)))"),
        ("inner = [(b - theta[i]) / problem.sigma for b", "inner = [(b - theta[i]) for b"),
        ("inner = [(b - theta[i]) / problem.sigma for b", "inner = [b / problem.sigma + 1e-3 for b"),
        ("max(SAFETY * spread, change)", "spread * 1e-3"),
        ("    error += beyond + rounding + (", "    error += 0.0 * ("),
        ("SHIFTS = {1: ((0.0, 0.5, 0.25, 0.75),)", "SHIFTS = {1: ((0.0, 0.0, 0.0, 0.0),)"),
        ("if count > points:", "if False:"),
        ("np.exp(-(nodes**2) / 2) / math.sqrt(2 * math.pi)", "np.exp(-(nodes**2) / 2) / 2.5"),
        ("panels *= 2", "panels *= 1"),
        ("VANISHED = 1e-18", "VANISHED = 1.0"),
    ],
    (R, OF_REFERENCE): [
        ("w = draw_columns(problem, stream, BATCHES * size, count)", "w = draw_columns(problem, stream, BATCHES * size, 0)"),
        ("draw_columns(problem, \"check\", columns, block)", "draw_columns(problem, \"reference\", columns, block)"),
        ("se = math.sqrt(batches.var(axis=0, ddof=1).sum() / BATCHES)", "se = math.sqrt(batches.var(axis=0, ddof=1).sum()) / BATCHES / 2"),
        ("count * BATCHES >= LEAST_SAMPLES", "True"),
        ("spent = 2 * count * BATCHES > samples", "spent = count * BATCHES > samples"),
        ("batches = (batches * count + means * size) / (count + size)", "batches = (batches + means) / 2"),
        ("error, note = share * float(", "error, note = 0.0 * float("),
        ("depth = -ndtri(0.5 * share * middle)", "depth = -ndtri(0.5 * middle)"),
        ("    if jump:\n", "    if False:\n"),
        ("    if at[REFUSED]:", "    if False:"),
        ("    if doubt and \"zeroth_order\" in pilots:", "    if False:"),
        ("resolved = 2.0 * math.sqrt(trace)", "resolved = 2.0 * trace"),
        ("if program.contact is not None and not program.contact.continuous:", "if False:"),
        ("return not program.continuous and not any(program.breakpoints())", "return False"),
        ("mean = sum(terms) / 2", "mean = sum(terms)"),
        ("closed = None if \"physics\" in provides else", "closed ="),
        ("if not sampled.note and 0.0 < error < quadrature.error:", "if 0.0 < error < quadrature.error:"),
        ("return Truth.from_batches(self.batches, self.error)", "return Truth.from_batches(self.batches)"),
        ("chosen, doubt = min(spread", "chosen, doubt = max(spread"),
        ("reshape(problem.dim, BATCHES, size).mean(axis=2).T", "reshape(problem.dim, size, BATCHES).mean(axis=1).T"),
    ],
    (R, OF_SCORES): [
        ("if not problem.program.score_refusal:", "if True:"),
    ],
    (J, OF_REFERENCE): [
        ("changes[-1] > 0.1 * changes[-2] and", ""),
        ("max(NO_JUMP * span, LOUD * noise)", "0.0"),
        ("np.argsort(bends, axis=None)[-SUSPECTS:]", "np.argsort(bends, axis=None)[:SUSPECTS]"),
    ],
    (B, OF_REFERENCE): [
        ("[..., :count]", ""),
    ],
    (S, OF_STATISTICS): [
        ("doubt = sum(error.trace**2 / error.degrees", "doubt = sum(error.trace / error.degrees"),
        ("ndtri(probability) if math.isinf(degrees) else stdtrit(degrees, probability)", "ndtri(probability)"),
        ("math.sqrt(count * (count - 1)), count - 1)", "math.sqrt(count * count), count - 1)"),
        ("math.sqrt(repeats * (repeats - 1)), repeats - 1)", "math.sqrt(repeats * repeats), repeats - 1)"),
        ("bias_rel=bias[0] / relative,", "bias_rel=bias[0] / max(norm, grad_norm),"),
        ("rmse_rel=rmse / relative,", "rmse_rel=rmse * unit / relative,"),
        ("return float(raw - min(max(unbiased, trace**2 / self.rows.shape[1]), trace**2))", "return 0.0"),
        ("scale = (square + 2.0 * along) / (1.0 + 2.0 * power)", "scale = (square + along) / (1.0 + power)"),
        ("once = float(image @ image) + equal * total  # m'Sm", "once = total  # m'Sm"),
        ("seen, end = max(total, 1.0), max(end, 1.0) + limit", "seen, end = total, max(end, 1.0) + limit"),
        ("h = 1.0 - 2.0 / 3.0 * first * third / second**2", "h = 1.0 / 3.0"),
        ("left = total - squares * repeats / max(repeats - 1, 1)", "left = total - squares"),
        ("variance = float(np.vdot(deviations, deviations)) / (repeats - 1)", "variance = float(np.vdot(deviations, deviations)) / repeats"),
        ("squared_error = float(np.vdot(errors, errors)) / repeats - reference.standard_error**2", "squared_error = float(np.vdot(errors, errors)) / repeats"),
        ("low, high = low - rare * size, high + rare * size", "pass"),
        ("if unbiased and bias[1] > 0.0:", "if bias[1] > 0.0:"),
        ("CONCENTRATION = 0.75", "CONCENTRATION = 0.2"),
        ("value = max(0.0, whole) / (count - 1)", "value = max(0.0, whole) / count"),
        ("math.log(count - samples - 1), level)", "math.log(count - 1), level)"),
        ("bias_interval(mean - reference.mean, sampling, *reference.errors)", "bias_interval(mean - reference.mean, sampling)"),
        ("hidden = (Sampling.without_direction(self.unseen, self.mean.size),) if self.unseen else ()", "hidden = ()"),
        ("math.isnan(relative):\n        if error == 0.0", "True:\n        if error == 0.0"),
        ("norm <= ROUNDING or reference.vanishes()", "norm <= ROUNDING"),
        ("up = max(reach, 3.0 / skewness", "up = max(reach, 0.3 / skewness"),
        ("if skewness > SYMMETRIC:", "if False:"),
        ("skewness = repeats / (repeats - 2) *", "skewness = 1.0 *"),
        ("pseudo = repeats * whole - (repeats - 1) * without", "pseudo = repeats * whole - repeats * without"),
        ("reach * spread, whole)), _exp(", "reach * spread, whole)), whole + _exp("),
        ("agree = np.sign(estimates[:, nonzero]) == np.sign(reference[nonzero])", "agree = np.sign(estimates) == np.sign(reference)"),
        ("return float(squares.max()) / total", "return float(squares.mean()) / total"),
        ("(deviations @ difference)[:, None], \" along", "deviations, \" along"),
        ("FEW_REPEATS = 8", "FEW_REPEATS = 3"),
        ("THREE = 3.0", "THREE = 1.0"),
        ("if error > VAGUE * norm:", "if error > norm:"),
        ("math.hypot(shown, self.unseen)", "shown"),
    ],
    (P, OF_SCORES): [
        ("if not (self.action_noise and self._moves_start):", "if True:"),
        ("and self._only_controls and not self._moves_start", "and self._only_controls"),
    ],
    ("plugins/estimators/inverse_variance.py", OF_WEIGHTS): [
        ("v0 = zeroth.var(axis=1, ddof=1) / zeroth.shape[1]", "v0 = zeroth.var(axis=1, ddof=1)"),
        ("v1 = first.var(axis=1, ddof=1) / first.shape[1]", "v1 = first.var(axis=1) / first.shape[1]"),
    ],
    ("plugins/estimators/alpha_order.py", OF_WEIGHTS): [
        ("first.var(axis=1, ddof=1).sum(axis=-1) / first.shape[1]", "first.var(axis=1, ddof=1).sum(axis=-1) / n"),
    ],
    ("plugins/estimators/reinforce.py", OF_WEIGHTS): [
        ("* f.shape[1] / (f.shape[1] - 1)", ""),
    ],
    (N, "tests/measure/test_noise.py"): [
        ("zlib.crc32(stream.encode())", "0"),
        ("zlib.crc32(scene.encode()), repeat]", "0, repeat]"),
        ("zlib.crc32(scene.encode()), repeat]", "zlib.crc32(scene.encode()), 0]"),
        ("SeedSequence([seed, ", "SeedSequence([0, "),
        ("standard_normal((samples, width)).T", "standard_normal((width, samples))"),
        ("block.setflags(write=False)", "pass"),
        ("min(columns, samples - start)", "columns"),
    ],
    (T, OF_TIMING): [
        ("seconds.append(time.perf_counter() - start - (pause.seconds - paused))", "seconds.append(time.perf_counter() - start)"),
        ("np.percentile(seconds, [25, 50, 75])\n    return results", "(*np.percentile(seconds, [25]), np.mean(seconds), max(seconds))\n    return results"),
        ("float(high - low), tuple(seconds)", "float(high), tuple(seconds)"),
        ("    call(0)\n", ""),
        ("call(len(seconds) % count)", "call(0)"),
        ("if len(results) < count:", "if True:"),
        ("len(seconds) < most * count and", ""),
        ("if total < least_s:", "if total > least_s:"),
        ("if total >= settle_s:", "if False:"),
        ("high - low > STEADY * median", "high - low > 10 * median"),
        ("return len(self.samples_s) + 1", "return len(self.samples_s)"),
        ("return self.iqr_s / self.median_s", "return self.median_s / self.iqr_s"),
        ("self.seconds += time.perf_counter() - self._since", "self.seconds = time.perf_counter() - self._since"),
        (".split()[0]) / 1024", ".split()[0]) / 1000000"),
        ('write_text("5")', 'write_text("4")'),
    ],
    (ST, OF_STORE): [
        ("self._sequence += 1", "pass"),
        ("duplicated(keep=\"last\")", "duplicated(keep=\"first\")"),
        ("sequence.sort_values(", "sequence.sort_values(ascending=False, "),
        ("between(0, MAX_SEQUENCE), 0.0)", "notna(), 0.0)"),
        ("return table[~is_older].reset_index(drop=True) if is_older.any() else table", "return table"),
        ("        if self._sequence is None:\n            self.load()\n        assert self._sequence is not None", "        self._sequence = self._sequence or 0"),
        ("self._sequence = max(self._sequence, int(sequence.max()))", "pass"),
        ("            for path in small:\n                path.unlink(missing_ok=True)", "            pass"),
        ("                write_whole(kept, path.read_bytes())\n", ""),
        ("fcntl.LOCK_EX", "fcntl.LOCK_SH"),
        ("with suppress(FileNotFoundError):", "with suppress():"),
        ("sorted(set(studies) - {\"\", self._study}) if self._study else []", "[]"),
        ("position.argsort(kind=\"stable\")", "position.argsort(kind=\"stable\")[::-1]"),
        ("lambda key: place.get(key, -1)", "lambda key: place.get(key, len(place))"),
    ],
    (GC, OF_CHECKS): [
        ("repeats(first, again, self.unit).all()", "np.allclose(first, again, equal_nan=True)"),
        ("again = self.gradient(theta)", "again = first"),
        ("causes += [part.verdict for part in draws if part.verdict in FAULTS]", "pass"),
        ("cause=most_severe(causes)", "cause=causes[0]"),
        ("order[order.size - (most - most // 2) :]", "order[: most // 2]"),
        ("vectors * gradients, 0.0).sum(axis=0) / lengths", "vectors * gradients, 0.0).sum(axis=0)"),
        ("random *= self.scale[:, None] / np.linalg.norm(random, axis=0)", "random /= np.linalg.norm(random, axis=0)"),
        ("np.where(program != 0.0, np.sqrt(self.unit) * whole.max(axis=0) / lengths, 0.0)", "np.sqrt(self.unit) * whole.max(axis=0) / lengths"),
        ("doubts = np.where(program != 0.0,", "doubts = 0.0 * np.where(program != 0.0,"),
        ('"precision" if coarse.verdict in TRUSTED', '"precision" if True'),
        ("if still and at_draws[0].any() and not here:", "if False:"),
        ("least = 1e-14 * max(1.0,", "least = 1e-2 * max(1.0,"),
        ("8.0 * self.unit * float(np.abs(row).max())", "1e-3 * float(np.abs(row).max())"),
        ("if \"wrong_adjoint\" in cause.values() and self._is_right_far_away():", "if False:"),
        ("return bool(right)", "return True"),
        ("for _ in range(2):", "for _ in range(1):"),
        (" and part.program != 0.0\n", "\n"),
        ("sample.derivative == 0.0 and sample.differences.any())", "False)"),
        ("GUARD * float(self.unit) * abs(sample.centre) >= tread", "False"),
        ("noise=max(sample.noise, tread)", "noise=sample.noise"),
        ("abs(self.ratio) * self.uncertainty / size if size > 0.0 else 0.0", "0.0"),
        ("part.verdict in (\"wrong_adjoint\", *TRUSTED):", "part.verdict == \"smooth\":"),
        ("part.verdict in TRUSTED and part.verdict != \"zero\" for part", "False for part"),
        ("FAR = (1.0, 3.0)", "FAR = (0.01, 0.01)"),
        ("theta + 4.0 * self.unit * self.scale", "theta"),
        ("ELSEWHERE = 4", "ELSEWHERE = 0"),
    ],
    (GS, OF_CHECKS): [
        ("LAST_DIGITS = 8", "LAST_DIGITS = 1e5"),
        ("cost(at[:, ::-1])[::-1]", "cost(at)"),
        ("[-eps, eps, [0.0], offsets", "[-eps, 2 * eps, [0.0], offsets"),
        ("eps * lengths[m], row", "eps, row"),
        ("max(measured, scatter(sample.step, sample.differences))", "0.0"),
        ("sign * sample.step * sample.derivative", "sample.step * sample.derivative"),
    ],
    (GD, OF_CHECKS): [
        ("apart <= min(tolerance, alike + rounding + sample.doubt)", "apart <= tolerance"),
        ("tolerance = CHANCE * spread +", "tolerance = 100.0 * spread +"),
        ("(self.plus - self.minus) / (2.0 * self.step)", "(self.plus - self.minus) / self.step"),
        ("ALIKE = 0.1", "ALIKE = 1.0"),
        ("DECADES = 3.0", "DECADES = 0.5"),
        ("GUARD = 64.0", "GUARD = 64e4"),
        ("MEASURED = 8.0", "MEASURED = 0.8"),
        ("MEASURED = 8.0", "MEASURED = 800.0"),
        ("(np.triu(apart > allowed, 1)).any(axis=1)", "np.zeros(spread.size, bool)"),
        ("worth = spread + noise", "worth = spread"),
        ("    if not sample.repeatable:\n        return Finding(\"nondeterministic\", float(sample.step[0]))", "    pass"),
        ("low <= sample.derivative <= high", "True"),
        ("middle > 2.0 * error.max()", "middle > 2e6 * error.max()"),
        ("\"disconnected\" if sample.derivative == 0.0", "\"disconnected\" if False"),
        ("sample.derivative == 0.0 and still[-MIN_STEPS:].all()", "False"),
        ("and resolved:", ":"),
        ("return bool(plain and abs(", "return bool(abs("),
        ("> 2.0 * tolerance)", "> 2e6 * tolerance)"),
        ("costs = costs + float(np.finfo(np.float64).tiny) / unit", "pass"),
        ("SHORT_WINDOW = 4", "SHORT_WINDOW = 2"),
        ("RISE = 0.01", "RISE = 1e3"),
    ],
    (GD, OF_CHECKS + " tests/gradient/test_gradcheck.py"): [
        ("MIN_STEPS = 7", "MIN_STEPS = 16"),
    ],
    (GK, OF_CHECKS): [
        ("CONSTANT = 1e-3", "CONSTANT = 1.0"),
        ("ENOUGH = 3", "ENOUGH = 30"),
        ("0.0 < value < 2.0", "0.0 < value < 0.1"),
        ("FINEST = 1e-5", "FINEST = 1e-2"),
        ("FINEST = 1e-5", "FINEST = 1e-12"),
        ("min(abs(middle), abs(middle - 1.0))", "abs(middle)"),
        ("KNOWN = 10.0", "KNOWN = 0.1"),
        ("KNOWN = 10.0", "KNOWN = 1e4"),
        ("MOSTLY = 0.8", "MOSTLY = 1.0"),
        ("MOSTLY = 0.8", "MOSTLY = 0.3"),
        ("some_right = some_right or right_elsewhere", "pass"),
        ("elif \"missing_term\" in causes.values():", "elif False:"),
        ("if len(components) > 1 and _constant(every):", "if False:"),
        ("return \"missing_term\" if some_right or partly else \"wrong_adjoint\"", "return \"missing_term\""),
        ("causes[None] = max(kinds, key=kinds.count)", "causes[None] = min(kinds, key=kinds.count)"),
    ],
    (GR, OF_CHECKS): [
        ("APART = 3.0", "APART = 0.0"),
        ("factorial(order) ** 2 / factorial(2 * order)", "1.0"),
        ("EDGES = 3", "EDGES = 1"),
    ],
    (GV, OF_CHECKS): [
        ("return min(verdicts, key=VERDICTS.index)", "return max(verdicts, key=VERDICTS.index)"),
        ("TRUSTED = of_kind(\"right\")", "TRUSTED = of_kind(\"right\") + of_kind(\"broken\")"),
    ],
    (GD, "tests/examine/test_bank.py -k right_gradients"): [
        ("slopes = np.maximum(np.abs(self.left), np.abs(self.right))", "slopes = 0.0"),
    ],
    (EL, OF_EXAMINE): [
        ("TREADS = 4", "TREADS = 3"),
        ("ALIKE = 0.01", "ALIKE = 10.0"),
        ("EVEN = 0.02", "EVEN = 0.6"),
        ("np.diff(at) / np.diff(at).min()", "np.diff(at)"),
        ("return float(heights.mean()) if", "return 1.0 if"),
        ("GUARD = 64.0", "GUARD = 0.0"),
        ("if order < 0.5:", "if order < -0.5:"),
        ("elif order < 1.5:", "elif order < 2.5:"),
        ("float(bends[end][k])", "float(bends[0][k])"),
        ("(np.abs(level) <= noise).mean() > 0.5", "True"),
    ],
    (EF, OF_EXAMINE): [
        ("return any(line.steps for line in self.lines)", "return False"),
        ("return self.missed > (SEEN if self.tread else TARGET_ERROR) and not self.is_measured", "return self.missed > (SEEN if self.tread else TARGET_ERROR)"),
        ("return max(treads) if min(treads) > (1 - ALIKE) * max(treads) else 0.0", "return max(treads)"),
        ("        elif self.misses_jumps:", "        elif False:"),
        ("checks = [self.settled, *self.more]", "checks = [self.settled]"),
        ("[(one.cause, one)] if one.cause else []", "[]"),
        ("return STATUS[RULES[self.cause].kind]", "return 3 * (RULES[self.cause].kind == \"open\")"),
    ],
    (EF, OF_HOLD): [
        ("is_still = not self.moves_around", "is_still = True"),
    ],
    (EF, OF_UNRESOLVED): [
        ("return hidden + contradicted", "return hidden"),
        ("return hidden + contradicted", "return contradicted"),
        ("DIGIT * max(abs(p.difference), _slope_nearby(p.sample))", "DIGIT * abs(p.difference)"),
    ],
    (EG, OF_UNRESOLVED): [
        ("        self._repeat_gradient(other)\n", ""),
    ],
    (EG, OF_GROUPS): [
        ("                        self._check_number(index, part.verdict)", "                        pass"),
    ],
    (EF, OF_GROUPS): [
        ("return min(DEVIATIONS / math.sqrt(self.count), 1.0) * self.allowed", "return self.allowed"),
        ("DEVIATIONS = 4.0", "DEVIATIONS = 0.1"),
        ("CONTRADICTED * part.uncertainty + part.sample.doubt", "CONTRADICTED * part.uncertainty"),
        ("return SEEN_ALONE * error * self.count / self.slope if", "return error / self.slope if"),
    ],
    (GF, OF_UNRESOLVED): [
        ("shrinks = bounds[best] <=", "shrinks = True or bounds[best] <="),
    ],
    (EX, OF_EXAMINE): [
        ("doubt < max(0.1 * missed, LEAST_MISSED)", "True"),
        ("replace(line, missed=self._missed_share(line, checked))", "line"),
    ],
    (EG, OF_EXAMINE): [
        ("(half * weight).ravel()", "(0.0 * half + weight).ravel()"),
    ],
    (GF, OF_PLAN): [
        ("return wrong(sample)", 'return "smooth"'),
        ('return "smooth" if uncertainty <= ALIKE * size else "unsettled"', 'return "unsettled"'),
    ],
    (EF, OF_MECHANISMS): [
        ("return bool(abs(part.program - part.difference) <= allowed)", "return True"),
    ],
    (EG, OF_MECHANISMS): [
        ("self.repeats.has_state = bool(is_alike and self.repeats.spread > self.repeats.floor)", "self.repeats.has_state = False"),
    ],
    (ES, OF_EXAMINE): [
        ("if self.known and self.bias_low > edge:", "if self.bias_low > edge:"),
        ("if self.known and self.bias_low > edge:", "if False:"),
        ("(self.bias_high > edge if self.known else self.error > 0.0)", "not self.known"),
        ("(self.bias_high > edge if self.known else self.error > 0.0)", "self.bias_high > edge"),
        ("float(truth @ truth) - error**2", "float(truth @ truth)"),
        ("_means(slopes) - groups", "_means(slopes)"),
        ("room = TARGET_ERROR**2 - bias**2", "room = TARGET_ERROR**2"),
        ("slope = np.linalg.lstsq(u[:, ~half].T, d[~half], rcond=None)[0]", "slope = np.linalg.lstsq(u[:, half].T, d[half], rcond=None)[0]"),
        ("simulator.costs(down, w)) / 2.0", "simulator.costs(down, w))"),
        ("return Method(name, bias, samples, calls * samples,", "return Method(name, bias, samples, samples,"),
    ],
    (X + "alpha_order.py", OF_ESTIMATORS): [
        ("np.log((zeroth.shape[2] + 1) / self.delta)", "np.log(1 / self.delta)"),
        ("2 * largest / (3 * n) * log_term", "largest / (3 * n) * log_term"),
        ("np.maximum(gamma - eps, 0.0)", "gamma"),
    ],
    (X + "clipped.py", OF_ESTIMATORS): [
        ("if self.by == \"element\"", "if self.by == \"sample\""),
        ("np.minimum(1.0, np.divide", "np.maximum(1.0, np.divide"),
    ],
    (X + "control_variate.py", OF_ESTIMATORS): [
        ("for part in reversed(parts)]", "for part in parts]"),
        ("(control[:, part] - centre)", "control[:, part]"),
    ],
    (X + "finite_difference.py", OF_ESTIMATORS): [
        ("np.stack(rows) / (2 * self.step)", "np.stack(rows) / self.step"),
    ],
    (X + "guided.py", OF_ESTIMATORS): [
        ("np.sqrt(self.share) * (w - inside)", "self.share * (w - inside)"),
    ],
    (X + "inverse_variance.py", OF_ESTIMATORS): [
        ("weight * first.mean(axis=1) + (1 - weight)", "(1 - weight) * first.mean(axis=1) + weight"),
    ],
    (X + "measure_valued.py", OF_KIT + "measure_valued"): [
        ("np.sqrt(-2.0 * log_ndtr(w))", "np.sqrt(-log_ndtr(w))"),
        ("np.sqrt(2.0 * np.pi)", "np.pi"),
    ],
    (X + "optimal_baseline.py", OF_VARIANCE): [
        ("keepdims=True) - sums for sums", "keepdims=True) for sums"),
        ("product, square = terms * score, score**2", "product, square = terms / score, score / score"),
    ],
    (X + "orthogonal.py", OF_ESTIMATORS): [
        ("else np.sqrt(d)", "else 1.0"),
    ],
    (X + "quadratic_model.py", OF_VARIANCE): [
        ("/ (1.0 - (q**2).sum(axis=2))", ""),
        ("n * along - np.einsum(\"rnk,rn->rk\", q, errors)", "n * along"),
        ("coefficients[:, 1 : d + 1]", "coefficients[:, :d]"),
    ],
    (X + "boundary.py", OF_EVENTS): [
        ("problem.value(theta, at_limit - apart) - problem.value(theta, at_limit + apart)", "problem.value(theta, at_limit + apart) - problem.value(theta, at_limit - apart)"),
        ("np.exp(-0.5 * limit**2)", "np.exp(-limit**2)"),
        ("(limit - direction @ w)", "limit"),
    ],
    (X + "stochastic_derivative.py", OF_EVENTS): [
        ("log_ndtr(side * limit)", "log_ndtr(-side * limit)"),
        ("np.maximum(0.0, -side * slope)", "np.abs(slope)"),
        ("(limit + side - number)", "(limit - side - number)"),
    ],
    ("bench/model/scene.py", OF_EVENTS): [
        ("repeat(units[:, :, None] / sigma", "repeat(normals[:, :, None] / sigma"),
    ],
    ("bench/model/events.py", OF_EVENTS): [
        ("limits / scale, slopes / scale", "limits, slopes"),
    ],
    (X + "sobol.py", OF_VARIANCE): [
        ("math.sqrt(count) * noise.mean", "noise.mean"),
    ],
    (X + "randomized_smoothing.py", OF_ESTIMATORS): [
        ("* direction / (2 * s)", "* direction / s"),
        ("centre)) * direction / s", "centre)) * direction / (2 * s)"),
    ],
    (X + "randomized_smoothing.py", "tests/measure/test_unexplained.py"): [
        ("self.radius != program.scene.sigma", "False"),
    ],
    (X + "sphere_smoothing.py", OF_ESTIMATORS): [
        ("d * change * u / (2.0 * r)", "change * u / (2.0 * r)"),
        ("np.sqrt(program.dim + 2.0)", "np.sqrt(program.dim)"),
    ],
    (X + "total_propagation.py", OF_ESTIMATORS): [
        ("part = 1 if self.per == \"control\"", "part = 1 if self.per == \"step\""),
        ("variances.reshape(len(variances), -1, part).sum(axis=2)", "variances.reshape(len(variances), part, -1).sum(axis=1)"),
    ],
    ("bench/model/estimator.py", OF_ESTIMATORS): [
        ("change * shift / (2.0 * s * s)", "change * shift / (2.0 * s)"),
        ("half = noise.shape[1] // 2", "half = noise.shape[1] // 3"),
        ("cost = problem.value(theta, w) - problem.value(theta, np.zeros((w.shape[0], 1)))", "cost = problem.value(theta, w)"),
    ],
    ("bench/model/estimator.py", OF_ESTIMATORS + " tests/plugins/test_surrogate.py"): [
        ("derivative = program.continuous and not program.surrogate", "derivative = program.continuous"),
    ],
    ("bench/model/estimator.py", OF_SCORES): [
        ("if \"score\" in self.needs and program.score_refusal:", "if False:"),
    ],
}  # fmt: skip
"""File and tests to the lines that are replaced. Faults that change no number are omitted, such as in code that only speeds up a search, or a quadrature
that may stop below its least number of points: it never stops before the second level, which has that many."""
FAULTS = [Fault(path, old, new, tests) for (path, tests), lines in GROUPS.items() for old, new in lines]


def killed(fault, folder):
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


def stale(faults):
    """Return a message per fault that cannot be planted, since the code does not contain its text exactly once."""
    held = {path: (ROOT / path).read_text() for path in {fault.path for fault in faults}}
    return [f"{f.path} does not hold exactly one: {f.old}" for f in faults if held[f.path].count(f.old) != 1]


def main(words):
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
